"""A small synthetic leg: known linear dynamics, no simulator needed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from adaptive_contact import ContactEvent, ContactLearner, ServoSample
from adaptive_contact.fit.train import Stretch, learn
from adaptive_contact.model import Baseline, Rows
from adaptive_contact.robot import Robot, inverse, parse_robot

PERIOD = 20_000_000
LENGTHS = (0.052, 0.066, 0.138)
TOML = """
[robot]
name = "testbot"
period_s = 0.02
quantum_rad = 0.005
[[leg]]
id = "rf"
joints = ["coxa", "femur", "tibia"]
lengths_m = [0.052, 0.066, 0.138]
"""


@dataclasses.dataclass
class FakeLeg:
    """First-order servos with a saturating pull: fast enough to simulate ten thousand ticks."""

    seed: int = 0
    gain: float = 0.35
    noise: float = 0.003

    def run(
        self,
        swings: int,
        *,
        touch: Callable[[int], int | None] = lambda _: None,
        change: Callable[[int], float] = lambda _: 1.0,
        falling: Callable[[int], float] = lambda _: 1.0,
        pressed: int = 0,
        late: Callable[[int], int | None] = lambda _: None,
        by: float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Swings of 10 ticks up, 14 down, 4 of stance.

        Args:
            swings: how many.
            touch: the tick of a swing at which the leg is stopped, None for none.
            change: factor on the gain, by swing.
            falling: the same, once the foot has begun to come down; no lift shows it.
            pressed: ticks of a swing for which the foot is held by the stance before.
            late: the tick of a swing after which the next one comes late, None for none.
            by: so many periods, in which the leg goes on.

        Returns:
            measured, desired (n, 3) rad, swing (n,), touching (n,).
        """
        rng = np.random.default_rng(self.seed)
        low = np.array([0.16, 0.0, -0.10])
        q = inverse(low, LENGTHS)
        out: list[tuple[np.ndarray, np.ndarray, bool, bool]] = []
        start = low
        for number in range(swings):
            top = rng.uniform([0.14, -0.06, -0.02], [0.2, 0.06, 0.02])
            end = rng.uniform([0.14, -0.06, -0.12], [0.2, 0.06, -0.08])
            up = [start + (top - start) * (i + 1) / 10 for i in range(10)]
            down = [top + (end - top) * (i + 1) / 14 for i in range(14)]
            stop = touch(number)
            for tick, point in enumerate([*up, *down, end, end, end, end]):
                desired = inverse(point, LENGTHS)
                measured = np.round((q + rng.normal(size=3) * self.noise) / 0.005) * 0.005
                held = tick < pressed or (stop is not None and tick >= stop)
                # The reading comes first: a stop in this tick shows in the next.
                touching = stop is not None and tick > stop
                out.append((measured, desired, tick < 24, touching))
                if not held:
                    pull = np.clip((desired - q) / 0.164, -1.0, 1.0)
                    down_only = falling(number) if 13 <= tick < 24 else 1.0
                    gain = self.gain * change(number) * down_only
                    if tick == late(number):
                        gain = 1.0 - (1.0 - gain) ** (1.0 + by)
                    q = q + gain * 0.164 * pull
            start = end
        measured, desired, swing, touching = (np.array(column) for column in zip(*out, strict=True))
        return measured, desired, swing, touching

    def stream(self, *args: Any, **kwargs: Any) -> list[ServoSample]:
        """The samples of :meth:`run`."""
        measured, desired, swing, _ = self.run(*args, **kwargs)
        return samples(measured, desired, swing)


@pytest.fixture(scope="session")
def robot() -> Robot:
    return parse_robot(TOML, source="testbot")


@pytest.fixture(scope="session")
def baseline(robot: Robot) -> Baseline:
    return trained(robot, FakeLeg(seed=1).run(900))


def samples(measured: np.ndarray, desired: np.ndarray, swing: np.ndarray) -> list[ServoSample]:
    return [
        ServoSample(
            t_ns=k * 20_000_000, seq=k, measured=m, desired=d, phase="swing" if s else "stance"
        )
        for k, (m, d, s) in enumerate(
            zip(measured.tolist(), desired.tolist(), swing.tolist(), strict=True)
        )
    ]


def play(learner: ContactLearner, stream: list[ServoSample]) -> list[ContactEvent]:
    return [event for s in stream if (event := learner.update(s)) is not None]


def followed(
    learner: ContactLearner, stream: list[ServoSample]
) -> tuple[list[str], list[str | None], list[list[int]]]:
    """Status and note after each swing, and the times that were confirmed by then."""
    status, notes, confirmed = [], [], []
    for k, sample in enumerate(stream):
        learner.update(sample)
        if k % 28 == 27:
            status.append(learner.status.status)
            notes.append(learner.status.note)
            confirmed.append(learner.drain_confirmed())
    return status, notes, confirmed


def taken(learner: ContactLearner) -> list[Rows]:
    """The rows that go into the buffer from here on."""
    buffer, found = learner.lifecycle.adapter.buffer, list[Rows]()
    add = buffer.add

    def listen(rows: Rows, region: int, era: int) -> None:
        if rows:
            found.append(rows)
        add(rows, region, era)

    buffer.add = listen  # type: ignore[method-assign]
    return found


def trained(robot: Robot, run: tuple[np.ndarray, ...]) -> Baseline:
    """A baseline of swings that touch nothing."""
    measured, desired, swing, _ = run
    sound = np.ones(len(swing), dtype=bool)
    stretch = Stretch(measured, desired, swing, swing, sound)
    return learn(robot, {"rf": [stretch]}, origin="test").baseline


def outcome(events: list[ContactEvent], first: int, stop: int | None) -> str:
    """Of the swing whose first sample is ``first``: hit, miss, alarm or clean."""
    inside = [e.seq - first for e in events if e.contact and first <= e.seq < first + 24]
    if stop is None:
        return "alarm" if inside else "clean"
    early = [tick for tick in inside if tick <= stop]
    return "alarm" if early else "hit" if inside else "miss"


def outcomes(events: list[ContactEvent], swings: range, stops: list[int | None]) -> list[str]:
    return [outcome(events, 28 * n, stops[n]) for n in swings]
