"""Collects from messages what is scored: samples, truth and events per leg, as arrays.

Samples are taken in one at a time and kept as plain numbers, 50 bytes each: ten hours of six legs
fit in half a gigabyte.
"""

from __future__ import annotations

import collections
import math
from array import array
from collections.abc import Iterable
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.robot.gait_phase import infer_phase
from adaptive_contact.score.contacts import find_swings, lift_by_height, truth_changes
from adaptive_contact.score.outcome import Events, LegStream
from adaptive_contact.wire import (
    LEG_MESSAGES,
    ContactEvent,
    ContactTruth,
    Reject,
    Rejected,
    ServoSample,
    decode,
    is_leg_id,
)

_UNTOLD, _SWING, _STANCE = 0, 1, 2
_PHASES: Final = {None: _UNTOLD, "swing": _SWING, "stance": _STANCE}


class Received(Protocol):
    """Describes what is needed of a recorded message."""

    @property
    def key(self) -> str:
        """Return the Zenoh key."""

    @property
    def payload(self) -> bytes:
        """Return the bytes."""

    @property
    def encoding(self) -> str:
        """Return the Zenoh encoding."""


class _Samples:
    """Gathers one leg's samples."""

    def __init__(self, joints: int) -> None:
        self.joints = joints
        self.t_ns = array("q")
        self.desired = array("d")
        self.phase = array("b")
        self.run = array("q")
        self.runs: dict[int | None, int] = {}

    def add(self, sample: ServoSample) -> Reject | None:
        if len(sample.desired) != self.joints:
            return Reject.WRONG_JOINTS
        if not all(map(math.isfinite, sample.desired)):
            return Reject.NOT_FINITE
        if not 0 <= sample.t_ns <= (2**63 - 1):
            return Reject.OUT_OF_RANGE
        self.t_ns.append(sample.t_ns)
        self.desired.extend(sample.desired)
        self.phase.append(_PHASES[sample.phase])
        self.run.append(self.runs.setdefault(sample.run, len(self.runs)))
        return None


class Gatherer:
    """Takes in the messages of a recording; gives a leg's stream and events.

    Args:
        robot: for the swing phase where the samples do not report it, and for the lift; a leg that
            it does not describe is taken to have no known geometry.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        # messages that could not be used, by reason
        self.rejects: collections.Counter[Reject] = collections.Counter()
        self._samples: dict[str, _Samples] = {}
        self._truth: dict[str, list[ContactTruth]] = {}
        self._events: dict[str, list[ContactEvent]] = {}

    def add_message(self, received: Received) -> None:
        """Add one message; keys that do not matter for a score are skipped."""
        head, _, kind = received.key.rpartition("/")
        if kind not in ("servo", "truth", "contact") or not head.startswith("robot/leg/"):
            return
        leg = head.removeprefix("robot/leg/")
        if not is_leg_id(leg):
            self.rejects[Reject.UNKNOWN_LEG] += 1
            return
        message = decode(received.payload, LEG_MESSAGES[kind], received.encoding)
        fault: Reject | None = None
        if isinstance(message, Rejected):
            fault = message.reason
        elif isinstance(message, ServoSample):
            if leg not in self._samples:
                described = self._described(leg)
                joints = len(described.joints) if described else len(message.desired)
                self._samples[leg] = _Samples(joints)
            fault = self._samples[leg].add(message)
        elif isinstance(message, ContactTruth):
            self._truth.setdefault(leg, []).append(message)
        elif isinstance(message, ContactEvent):
            self._events.setdefault(leg, []).append(message)
        if fault is not None:
            self.rejects[fault] += 1

    @property
    def withheld(self) -> dict[str, int]:
        """Return the contacts of each leg that the service withheld, as the leg was ambiguous."""
        counts = {
            leg: sum(e.withheld and e.status != "silent" for e in events)
            for leg, events in self._events.items()
        }
        return {leg: count for leg, count in counts.items() if count}

    def replace_events(self, events: Iterable[ContactEvent]) -> None:
        """Replace the events that were received by these."""
        self._events = {}
        for event in events:
            self._events.setdefault(event.leg, []).append(event)

    @property
    def legs_with_events(self) -> tuple[str, ...]:
        """Return the legs with contact events, with or without samples."""
        return tuple(self._events)

    @property
    def legs(self) -> tuple[str, ...]:
        """Return the legs with samples, in order of appearance."""
        return tuple(leg for leg, samples in self._samples.items() if samples.t_ns)

    @property
    def legs_with_truth(self) -> tuple[str, ...]:
        """Return the legs with samples and truth."""
        return tuple(leg for leg in self.legs if leg in self._truth)

    def events(self, leg: str) -> Events:
        """Return the events received of a leg."""
        return Events.from_messages(sorted(self._events.get(leg, []), key=lambda event: event.t_ns))

    def stream(self, leg: str) -> LegStream:
        """Return what is known of one of :attr:`legs`.

        Raises:
            ConfigurationError: the samples carry no phase, and the geometry is not known either.
            RecordingError: two runs overlap in time.
        """
        samples = self._samples[leg]
        t_ns = np.array(samples.t_ns, dtype=np.int64)
        desired = np.array(samples.desired, dtype=np.float64).reshape(-1, samples.joints)
        phase = np.array(samples.phase, dtype=np.int8)
        keep = self._select_in_order(leg, t_ns, np.array(samples.run, dtype=np.int64))
        t_ns, desired, phase = t_ns[keep], desired[keep], phase[keep]
        described = self._described(leg)
        swing = phase == _SWING
        if np.any(phase == _UNTOLD):
            inferred = None if described is None else infer_phase(desired, described)
            if inferred is None:
                raise ConfigurationError(
                    f"leg '{leg}': its samples carry no phase and '{self.robot.name}' gives no "
                    "lengths_m for it, so swings cannot be found; give the robot with --config"
                )
            swing = np.where(phase == _UNTOLD, inferred, swing)
        lift = None
        if described is not None and described.chain is not None:
            height = described.chain.foot(desired)[:, 2]
            lift = lift_by_height(find_swings(t_ns, swing), height)
        truth = truth_changes(self._truth.get(leg, []))
        return LegStream(leg=leg, t_ns=t_ns, swing=swing, truth=truth, lift=lift)

    def _select_in_order(
        self, leg: str, t_ns: NDArray[np.int64], run: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Select samples later than all before; others are counted, or are a second run."""
        latest = np.concatenate(([-1], np.maximum.accumulate(t_ns)[:-1]))
        late = t_ns <= latest
        ends = np.concatenate(([-1], np.maximum.accumulate(run)[:-1]))
        if np.any(late & (run > ends)) or np.any(run < ends):
            raise RecordingError(
                f"leg '{leg}': the recording holds runs whose times overlap (a source that was "
                "started again, or two at once); record each into a file of its own"
            )
        self.rejects[Reject.TIME_BACKWARDS] += int(np.sum(late))
        return ~late

    def _described(self, leg: str) -> Leg | None:
        return self.robot.leg(leg) if leg in self.robot.leg_ids else None
