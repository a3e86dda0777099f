"""Says what a baseline is worth on swings that it was not learned from.

In some of them the foot is stopped half-way down, by holding the readings; what the detector
reports of these, and of the swings that touch nothing, is what a user may expect of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Mask
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.fit.train import Stretch
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.wire import ServoSample

# How long feet are stopped, s.
STOPS_S: Final = (0.06, 0.2)


class Worth(NamedTuple):
    """Holds what a leg's detector reports on held-out swings."""

    stops: dict[float, tuple[int, int]]  # by length in s: reported, of so many
    false: int  # contacts where nothing touched
    free_swings: int  # that were not stopped, and are known to touch nothing

    def __str__(self) -> str:
        found = ", ".join(
            f"{found} of {total} stops of {1e3 * s:.0f} ms"
            for s, (found, total) in self.stops.items()
        )
        false = f"; {self.false} false in {self.free_swings} swings" if self.free_swings else ""
        return f"finds {found}{false}"

    @property
    def good(self) -> bool:
        """Whether the long stops are found and nothing else is reported."""
        found, total = self.stops[STOPS_S[-1]]
        return found >= 0.9 * total and not self.false


def split(stretches: Sequence[Stretch]) -> tuple[list[Stretch], list[Stretch]]:
    """Split a leg's samples in time: the first to learn from, the last held out.

    A stretch on the border is cut in two.
    """
    left = round(2.0 / 3.0 * sum(len(stretch.swing) for stretch in stretches))
    first, last = [], []
    for stretch in stretches:
        n = len(stretch.swing)
        at = min(max(left, 0), n)
        left -= n
        first += [part(stretch, 0, at)] if at else []
        last += [part(stretch, at, n)] if at < n else []
    return first, last


def part(stretch: Stretch, first: int, last: int) -> Stretch:
    """Return ticks ``first`` to ``last`` - 1 of a stretch, as one."""
    names = ("measured", "desired", "swing", "free", "sound")
    cut = {name: getattr(stretch, name)[first:last] for name in names}
    return Stretch(**cut, certain=stretch.certain)


def worth(
    robot: Robot, baseline: Baseline, held_out: Mapping[str, Sequence[Stretch]]
) -> dict[str, Worth]:
    """Replay held-out samples, with stops in two of three swings, drawn at random.

    Args:
        robot: its description.
        baseline: that was learned from other samples.
        held_out: by leg.

    Returns:
        By leg; without legs that the baseline lacks, or of which no swing could be stopped.
    """
    found = {}
    for leg_id, stretches in held_out.items():
        if leg_id in baseline.legs:
            of_leg = _replay_leg(robot, robot.leg(leg_id), baseline, stretches)
            if all(total for _, total in of_leg.stops.values()):
                found[leg_id] = of_leg
    return found


def _replay_leg(robot: Robot, leg: Leg, baseline: Baseline, stretches: Sequence[Stretch]) -> Worth:
    """Replay the stretches of one leg, with stops."""
    learner = ContactLearner(robot, leg.id, baseline)
    draw = np.random.default_rng(len(stretches))
    stops = {length: [0, 0] for length in STOPS_S}
    late = round(0.06 / robot.period_s)  # ticks after its end in which a stop may be reported
    false = free_swings = tick = 0
    for stretch in stretches:
        measured, until = stretch.measured.copy(), np.zeros(len(stretch.swing), dtype=np.int64)
        touched_nothing = stretch.free & stretch.certain
        pending: dict[int, float] = {}
        for first, last in _swings(stretch.swing):
            length = (*STOPS_S, 0.0)[draw.integers(3)]
            at = _half_way_down(leg, stretch, first, last)
            ticks = round(length / robot.period_s)
            if not ticks:
                free_swings += bool(touched_nothing[first:last].all())
                continue
            measured[at : at + ticks] = measured[at - 1]
            until[at : at + ticks + late] = at
            touched_nothing[at : max(last, at + ticks + late)] = False
            pending[at] = length
            stops[length][1] += 1
        for k in range(len(measured)):
            event = learner.update(
                ServoSample(
                    t_ns=round((tick + k) * robot.period_s * 1e9),
                    seq=tick + k,
                    measured=measured[k].tolist(),
                    desired=stretch.desired[k].tolist(),
                    phase="swing" if stretch.swing[k] else "stance",
                )
            )
            if event is None or not event.contact:
                continue
            if int(until[k]) in pending:
                stops[pending.pop(int(until[k]))][0] += 1
            else:
                false += bool(touched_nothing[k])
        tick += len(measured) + 100  # a pause, for the learner
    return Worth({s: (found, total) for s, (found, total) in stops.items()}, false, free_swings)


def _swings(swing: Mask) -> list[tuple[int, int]]:
    """List the first tick and the one after the last of each whole swing."""
    edges = np.flatnonzero(np.diff(swing.astype(np.int8))) + 1
    begins = edges[swing[edges]]
    ends = edges[~swing[edges]]
    return [(int(a), int(ends[ends > a][0])) for a in begins if len(ends) and a < ends[-1]]


def _half_way_down(leg: Leg, stretch: Stretch, first: int, last: int) -> int:
    """Return the tick in which the command has come half of its way down."""
    if leg.chain is None:
        return first + round(0.75 * (last - first))
    height = leg.chain.foot(stretch.desired[first:last])[:, 2]
    top = int(height.argmax())
    half = 0.5 * (height[top] + height[-1])
    return first + top + int((height[top:] <= half).argmax())
