"""A robot that is put down, or lifted: what it learned before hides no touch, and makes none."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import numpy as np
import pytest

from adaptive_contact import ServoSample
from adaptive_contact.core.bank import LearnerBank

pytest.importorskip("pybullet", reason="extra 'bullet' is not installed")

from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.state import recorded

pytestmark = pytest.mark.slow
SEED = 5


def joined(first: list[ServoSample], second: Iterable[ServoSample]) -> list[ServoSample]:
    """Two recordings of a leg, one a second after the other."""
    t_ns, seq = (first[-1].t_ns, first[-1].seq) if first else (0, 0)
    return first + [
        msgspec.structs.replace(s, t_ns=s.t_ns + t_ns + 10**9, seq=s.seq + seq + 1) for s in second
    ]


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
        bank = LearnerBank(robot)
        streams = [
            joined(list(samples_of(hung, leg))[:before], samples_of(walk, leg)) for leg in legs
        ]
        found: dict[str, list[int]] = {leg: [] for leg in legs}
        for k, samples in enumerate(zip(*streams, strict=True)):
            for event in bank.update(dict(zip(legs, samples, strict=True))):
                if event.contact:
                    found[event.leg].append(k - before)
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


@pytest.mark.parametrize("motion", ["hexapod tripod-fast", "geared tripod", "quadruped trot"])
def test_a_walking_robot_that_is_lifted_reports_no_contacts_for_long(motion: str) -> None:
    walk, first = recorded(f"bullet-{motion} rough", 50.0, SEED)
    hung, _ = recorded(f"bullet-{motion} none", 40.0, SEED)
    bank, legs = LearnerBank(first.robot), list(walk.legs)
    streams = [joined(list(samples_of(walk, leg)), samples_of(hung, leg)) for leg in legs]
    early = late = 0
    for k, samples in enumerate(zip(*streams, strict=True)):
        for event in bank.update(dict(zip(legs, samples, strict=True))):
            if k >= len(walk.t_ns) and event.contact:
                soon = k < len(walk.t_ns) + len(hung.t_ns) // 3
                early, late = early + soon, late + (not soon)
    assert sum(learner.status.swings for leg in legs if (learner := bank.learner(leg))) > 150
    assert early < 25
    assert late <= 1
