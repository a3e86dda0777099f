"""Encodes contacts and learner statuses as messages of ROS 2."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Mapping, Sequence
from typing import Any, Final

import numpy as np

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.ros2.rmw import Address, RosType
from adaptive_contact.ros2.types import Types
from adaptive_contact.wire import NS_PER_S, ContactEvent, LearnerStatus, LegState

# Levels of diagnostic_msgs/DiagnosticStatus.
OK: Final = 0
WARN: Final = 1
ERROR: Final = 2
STALE: Final = 3
_LEVELS: Final = {"valid": OK, "adapting": OK, "learning": WARN, "ambiguous": WARN, "silent": STALE}
_MEANS: Final = {
    "valid": "follows its model",
    "adapting": "has changed; its model follows",
    "learning": "is being learned: contacts by what is known of any leg",
    "ambiguous": "cannot be judged: contacts are withheld",
    "silent": "sends no usable samples",
}


def topic_of_leg(node: str, leg: str) -> str:
    """Return a leg's contact topic, ``/adaptive_contact/lf/contact``; '-' and '.' become '_'."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", leg)
    return f"/{node}/{name if not name[0].isdigit() else '_' + name}/contact"


class Report:
    """Makes the messages that go out.

    Args:
        types: of the distribution.
        node: name of the gateway's node.
        robot: its name, for the diagnostics.
        legs: ids.

    Attributes:
        contacts: where each leg's contact goes.
        values: where those of all legs go.
        states: where the states of a tick of all legs go.
        diagnostics: where the learners' state goes.

    Raises:
        ConfigurationError: two legs would have one topic.
    """

    def __init__(self, types: Types, node: str, robot: str, legs: tuple[str, ...]) -> None:
        self._types = types
        self._robot = robot
        self._node = node
        self._last: dict[str, ContactEvent] = {}
        self._newest_ns = 0  # of the sample that decided the newest event
        self.contacts = {leg: self._address(topic_of_leg(node, leg), RosType.BOOL) for leg in legs}
        if len({address.topic for address in self.contacts.values()}) < len(legs):
            raise ConfigurationError(
                f"the legs {', '.join(legs)} would share topics, as ROS names hold no '-' or '.'; "
                "rename them in robot.toml"
            )
        self.values = self._address(f"/{node}/contacts", RosType.JOINT_VALUES)
        self.states = self._address(f"/{node}/states", RosType.JOINT_VALUES)
        self._states: dict[str, LegState] = {}  # of the tick in hand
        self.diagnostics = self._address("/diagnostics", RosType.DIAGNOSTICS)

    def _address(self, topic: str, type_name: str) -> Address:
        return Address(topic, type_name, self._types.hash_of(type_name))

    def change(self, event: ContactEvent) -> bytes | None:
        """Store an event; return its contact as a ``Bool`` if that has changed, else None."""
        before = self._last.get(event.leg)
        self._last[event.leg], self._newest_ns = event, event.t_ns
        if before is not None and before.contact == event.contact:
            return None
        return self._types.encode(self._types.types[RosType.BOOL](data=event.contact))

    def all_legs(self, ages_s: Mapping[str, float], valid: Container[str]) -> bytes:
        """Encode the contacts of all legs as a ``DynamicJointState``.

        A leg's values: contact (0 or 1), score, onset age in seconds (how long before the deciding
        sample the foot touched or let go), withheld and valid (0 or 1), age in seconds.  What was
        never reported is NaN.

        Args:
            ages_s: of each leg's newest sample; without those that have had none.
            valid: legs that are watched.
        """
        rows = [
            [*_decided(self._last.get(leg)), float(leg in valid), ages_s.get(leg, math.nan)]
            for leg in self.contacts
        ]
        return self._table(
            self._newest_ns, ("contact", "score", "onset_age", "withheld", "valid", "age"), rows
        )

    def state(self, leg: str, state: LegState) -> bytes | None:
        """Store a leg's state; return a tick's ``DynamicJointState`` once it is complete.

        A leg's values: contact (0 or 1), p and known (0 or 1); p of a leg that is not known is NaN.
        A tick is whole with its last leg, or where a leg's next state comes before that.
        """
        whole = None
        if leg in self._states:
            whole = self._tick()
        self._states[leg] = state
        return self._tick() if len(self._states) == len(self.contacts) else whole

    def _tick(self) -> bytes:
        states, self._states = self._states, {}
        rows = [
            [0.0, math.nan, 0.0]
            if (of := states.get(leg)) is None
            else [float(of.contact), math.nan if of.p is None else of.p, float(of.known)]
            for leg in self.contacts
        ]
        return self._table(max(of.t_ns for of in states.values()), ("contact", "p", "known"), rows)

    def _table(self, t_ns: int, names: Sequence[str], rows: Sequence[Sequence[float]]) -> bytes:
        """Encode a ``DynamicJointState`` with a row per leg."""
        types = self._types.types
        value = types["control_msgs/msg/InterfaceValue"]
        message = types[RosType.JOINT_VALUES](
            header=header(self._types, t_ns),
            joint_names=list(self.contacts),
            interface_values=[
                value(interface_names=list(names), values=np.array(row)) for row in rows
            ],
        )
        return self._types.encode(message)

    def diagnose(
        self,
        now_ns: int,
        learners: Mapping[str, LearnerStatus],
        valid: Container[str],
        gateway: Mapping[str, object],
        trouble: str | None,
    ) -> bytes:
        """Encode a ``DiagnosticArray`` of all learners and of the gateway.

        Args:
            now_ns: wall clock.
            learners: newest status of each leg.
            valid: legs that are watched.
            gateway: what the gateway has counted.
            trouble: what is wrong with the gateway, None where nothing is.
        """
        rows = [self._describe_learner(one, leg in valid) for leg, one in sorted(learners.items())]
        level = OK if trouble is None else ERROR
        text = "relays" if trouble is None else trouble
        rows.append(self._row(level, f"{self._node}: gateway", text, gateway))
        types = self._types.types
        message = types[RosType.DIAGNOSTICS](header=header(self._types, now_ns), status=rows)
        return self._types.encode(message)

    def _describe_learner(self, status: LearnerStatus, valid: bool) -> Any:
        text = status.note or f"{status.status}: {_MEANS[status.status]}"
        if not valid and status.status != "silent":
            text = f"not known: no word of the service; was {text}"
        rejects = ", ".join(f"{why} {n}" for why, n in status.rejects.items())
        values: dict[str, object] = {
            "status": status.status,
            "valid": valid,
            "contact": status.contact and valid,
            "contacts": status.contacts,
            "withheld": status.withheld,
            "swings": status.swings,
            "swings_withheld": status.swings_withheld,
            "doubt": status.doubt or "",
            "model_version": status.model_version,
            "drift_level": round(status.drift.level, 3),
            "drift_kind": status.drift.kind or "",
            "samples": status.ticks,
            "missed": status.missed,
            "rejects": rejects,
            "residual_rms_rad": " ".join(f"{value:.4f}" for value in status.residual_rms),
        }
        level = _LEVELS[status.status] if valid else STALE
        return self._row(level, f"{self._node}: leg {status.leg}", text, values)

    def _row(self, level: int, name: str, text: str, values: Mapping[str, object]) -> Any:
        types = self._types.types
        pair = types["diagnostic_msgs/msg/KeyValue"]
        return types["diagnostic_msgs/msg/DiagnosticStatus"](
            level=level,
            name=name,
            message=text,
            hardware_id=self._robot,
            values=[pair(key=key, value=str(value)) for key, value in values.items()],
        )


def header(types: Types, time_ns: int) -> Any:
    """Make a ``Header`` of a time."""
    seconds, rest = divmod(time_ns, NS_PER_S)
    seconds = min(max(seconds, -(2**31)), 2**31 - 1)  # a stamp has 32 bits of them
    stamp = types.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return types.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")


def _decided(event: ContactEvent | None) -> tuple[float, float, float, float]:
    if event is None:
        return 0.0, math.nan, math.nan, 1.0
    onset_age_s = (event.t_ns - event.onset_ns) / NS_PER_S
    return float(event.contact), event.score, onset_age_s, float(event.withheld)
