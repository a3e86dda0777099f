"""Writes contacts as a bag of ROS 2 (rosbag2, MCAP), on the topics of the gateway.

Joint states and, from a simulator or foot switches, the truth go with them.  Needs rosbags (the
extra ``ros2``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from adaptive_contact.errors import RecordingError
from adaptive_contact.robot import Robot
from adaptive_contact.robot.description import Ros2
from adaptive_contact.ros2.report import Report, header
from adaptive_contact.ros2.rmw import RosType
from adaptive_contact.ros2.types import Types, typestore
from adaptive_contact.wire import ContactEvent, ContactTruth, Message, ServoSample

_FOREVER: Final = QosTime(2**31 - 1, 2**32 - 1)
_LATCHED: Final = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)


class BagWriter:
    """Writes messages of the wire as ROS 2 has them; a context manager.

    Args:
        path: the folder, which must not be there yet.
        robot: whose legs are in the recording.

    Raises:
        RecordingError: it cannot be written.
        ConfigurationError: two legs would have one topic.
    """

    def __init__(self, path: Path, robot: Robot) -> None:
        settings = robot.ros2 or Ros2()
        self._types = Types(settings.distro)
        self._store = typestore()
        self._report = Report(self._types, settings.node, robot.name, robot.leg_ids)
        self._names = {
            leg.id: leg.ros2.joints if leg.ros2 else [f"{leg.id}_{name}" for name in leg.joints]
            for leg in robot.legs
        }
        self._newest_ns: dict[str, int] = {}
        self._connections: dict[str, Any] = {}
        try:
            # Version 9 of metadata.yaml: since Jazzy.
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise RecordingError(
                f"{path}: cannot be written ({error}); give another --out"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, leg: str, message: Message, time_ns: int) -> bool:
        """Append what ROS 2 gets of a message; False where that is nothing."""
        names = self._names.get(leg, ())
        contact = self._report.contacts[leg].topic if names else ""
        if isinstance(message, ServoSample) and len(names) == len(message.measured):
            self._newest_ns[leg] = time_ns
            self._add("/joint_states", self._joints(names, message), time_ns)
        elif isinstance(message, ContactTruth) and names:
            flag = self._types.types[RosType.BOOL](data=message.contact)
            self._add(contact.removesuffix("contact") + "truth", flag, time_ns)
        elif isinstance(message, ContactEvent) and names:
            changed = self._report.change(message)
            if changed is not None:
                self._write_payload(contact, RosType.BOOL, changed, time_ns)
            ages_ns = {of: time_ns - at_ns for of, at_ns in self._newest_ns.items()}
            # A leg is known while its newest sample is no older.
            known = {of for of, age_ns in ages_ns.items() if age_ns <= 500_000_000}
            every = self._report.all_legs({of: ns / 1e9 for of, ns in ages_ns.items()}, known)
            self._write_payload(self._report.values.topic, RosType.JOINT_VALUES, every, time_ns)
        else:
            return False
        return True

    def _joints(self, names: Any, sample: ServoSample) -> Any:
        none = np.zeros(0)
        return self._types.types[RosType.JOINT_STATE](
            header=header(self._types, sample.t_ns),
            name=list(names),
            position=np.array(sample.measured),
            velocity=none,
            effort=none,
        )

    def _add(self, topic: str, message: Any, time_ns: int) -> None:
        self._write_payload(topic, message.__msgtype__, self._types.encode(message), time_ns)

    def _write_payload(self, topic: str, kind: str, payload: bytes, time_ns: int) -> None:
        if topic not in self._connections:
            latched = () if kind == RosType.JOINT_STATE else (_LATCHED,)
            self._connections[topic] = self._writer.add_connection(
                topic, str(kind), typestore=self._store, offered_qos_profiles=latched
            )
        self._writer.write(self._connections[topic], time_ns, payload)
