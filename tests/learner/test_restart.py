"""A source that restarts with another clock leaves no trace of the restart in the buffer."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.core.detect.stream import RESET_SAMPLES
from adaptive_contact.model import Baseline, stack
from adaptive_contact.robot import Robot

from .conftest import PERIOD, FakeLeg, play, samples, taken

SWING = 28  # ticks, with its stance
# Ticks of the last swing of the first source, which has confirmed its lift and not its descent.
BROKEN_OFF = 15


def source(seed: int, swings: int, first: int) -> tuple[np.ndarray, np.ndarray, list[ServoSample]]:
    measured, desired, swing, _ = FakeLeg(seed=seed).run(
        swings, touch=lambda n: 16 if n % 3 == 0 else None
    )
    return measured[first:], desired[first:], samples(measured, desired, swing)[first:]


# What the second source's clock begins with (the first one's ends at about 10^15), how it counts,
# and how many of its samples are refused before it is believed.
@pytest.mark.parametrize(
    ("run", "t_ns", "seq", "refused"),
    [
        pytest.param(2, 0, 0, 0, id="run-back"),
        pytest.param(2, 10**17, 0, 0, id="run-ahead"),
        pytest.param(None, 0, 0, RESET_SAMPLES - 1, id="back"),
        pytest.param(None, 0, 40 * SWING + BROKEN_OFF, RESET_SAMPLES - 1, id="back-counting-on"),
        pytest.param(None, 10**17, 0, RESET_SAMPLES - 1, id="ahead"),
        pytest.param(None, 10**17, 40 * SWING + BROKEN_OFF, 0, id="ahead-counting-on"),
    ],
)
@pytest.mark.parametrize("begins", [5, 26])  # stance is from 24 on
def test_no_segment_spans_a_restart(
    robot: Robot,
    baseline: Baseline,
    run: int | None,
    t_ns: int,
    seq: int,
    refused: int,
    begins: int,
) -> None:
    learner = ContactLearner(robot, "rf", baseline)
    buffer, rows_taken = learner.lifecycle.adapter.buffer, taken(learner)
    old_measured, old_desired, stream = source(51, 41, 0)
    old = [
        msgspec.structs.replace(s, t_ns=s.t_ns + 10**15, run=None if run is None else 1)
        for s in stream[: 40 * SWING + BROKEN_OFF]
    ]
    play(learner, old)
    before, segments = learner.status.buffer, len(buffer.segments)
    assert min(before.lift_ticks, before.descent_ticks) > 50
    new_measured, new_desired, stream = source(52, 30, begins)
    new = [
        msgspec.structs.replace(s, t_ns=t_ns + k * PERIOD, seq=seq + k, run=run)
        for k, s in enumerate(stream)
    ]
    # Until a window of the new source is full there is nothing to learn, and of the swing that was
    # broken off nothing more ever comes.
    library = learner.model.library
    unready = refused + library.window.length
    play(learner, new[:unready])
    assert learner.status.buffer == before
    assert sum(learner.status.rejects.values()) == refused
    play(learner, new[unready:])
    after = learner.status.buffer
    grown = after.lift_ticks - before.lift_ticks, after.descent_ticks - before.descent_ticks
    assert min(grown) > 0
    assert len(rows_taken) == len(buffer.segments) > segments, "none was evicted"
    # Row by row: of one clock, in order, and predicted from one source's readings alone.
    sources = [
        (old[0].t_ns, len(old), old_measured, old_desired),
        (new[refused].t_ns, len(new) - refused, new_measured[refused:], new_desired[refused:]),
    ]
    regressors: dict[int, np.ndarray] = {}
    for first_ns, count, measured, desired in sources:
        cut = stack(measured[:count], desired[:count], library.window)
        theta = library.evaluate(cut.measured, cut.desired, cut.preview)
        # A row of tick k predicts tick k + 1.
        regressors |= {
            first_ns + (k + 1) * PERIOD: row
            for k, row in zip(cut.tick.tolist(), theta, strict=True)
        }
    for rows in rows_taken:
        times = rows.t_ns.tolist()
        assert (np.diff(times) == PERIOD).all()
        np.testing.assert_allclose(rows.theta, [regressors[t_ns] for t_ns in times], atol=1e-12)
