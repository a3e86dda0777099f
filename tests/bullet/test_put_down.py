"""A robot that hung and is put down: what it learned in the air hides no touch."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from adaptive_contact.core.bank import LegGroup
from adaptive_contact.core.leg_learner import ContactLearner

pytest.importorskip("pybullet", reason="extra 'bullet' is not installed")

from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.state import recorded

pytestmark = pytest.mark.slow
SEED = 5


@pytest.mark.parametrize(
    ("air", "ground"),
    [
        ("bullet-light ripple none", "bullet-light tripod-planned rough"),
        ("bullet-hexapod tripod-fast none", "bullet-hexapod tripod-fast rough"),
    ],
)
def test_it_finds_as_many_touches_as_one_that_never_hung(air: str, ground: str) -> None:
    hung, first = recorded(air, 50.0, SEED)
    walk, _ = recorded(ground, 60.0, SEED)
    robot, legs = first.robot, list(walk.legs)
    ticks, half = len(hung.t_ns), len(walk.t_ns) // 2
    shares = []
    for before in (0, ticks):
        group = LegGroup([ContactLearner(robot, leg) for leg in legs])
        streams = []
        for leg in legs:
            stream = list(samples_of(hung, leg))[:before]
            t_ns, seq = (stream[-1].t_ns, stream[-1].seq) if stream else (0, 0)
            streams.append(
                stream
                + [
                    msgspec.structs.replace(s, t_ns=s.t_ns + t_ns + 10**9, seq=s.seq + seq + 1)
                    for s in samples_of(walk, leg)
                ]
            )
        found: dict[str, list[int]] = {leg: [] for leg in legs}
        for k, samples in enumerate(zip(*streams, strict=True)):
            for leg, event in zip(legs, group.advance(samples), strict=True):
                if event is not None and event.contact:
                    found[leg].append(k - before)
        late, share = round(0.3 / robot.period_s), []
        for leg in legs:
            truth = walk.legs[leg].contact
            onsets = np.flatnonzero(truth[1:] & ~truth[:-1]) + 1
            share += [
                any(-3 <= k - onset <= late for k in found[leg]) for onset in onsets[onsets > half]
            ]
        shares.append(np.mean(share))
    alone, after = shares
    assert alone > 0.75
    assert after > alone - 0.05
