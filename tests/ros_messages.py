"""Messages of ROS 2: joints, the controller's state, phases."""

from __future__ import annotations

from typing import Any

import numpy as np

from adaptive_contact.ros2.rmw import RosType


class Messages:
    """Makes messages of a definition of the controller's state."""

    def __init__(self, state: str = "jazzy") -> None:
        from adaptive_contact.ros2.types import typestore

        self.store = typestore(state)

    def header(self, t_ns: int) -> Any:
        types = self.store.types
        stamp = types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="")

    def _point(self, angles: list[float]) -> Any:
        types = self.store.types
        empty = np.zeros(0)
        duration = types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        return types["trajectory_msgs/msg/JointTrajectoryPoint"](
            np.array(angles, dtype=np.float64), empty, empty, empty, duration
        )

    def state(
        self, names: list[str], read: list[float], told: list[float], t_ns: int = 10**9
    ) -> Any:
        types = self.store.types
        duration = types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        nothing = types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]([], [], [], duration)
        values: dict[str, Any] = {}
        for name, _ in self.store.fielddefs[RosType.CONTROLLER_STATE][1]:
            if name == "header":
                values[name] = self.header(t_ns)
            elif name.endswith("joint_names"):
                values[name] = names if name == "joint_names" else []
            elif name == "speed_scaling_factor":
                values[name] = 1.0
            elif name.startswith("multi_dof"):
                values[name] = nothing
            elif name in ("feedback", "actual"):
                values[name] = self._point(read)
            elif name in ("reference", "desired"):
                values[name] = self._point(told)
            else:
                values[name] = self._point([])
        return types[RosType.CONTROLLER_STATE](**values)

    def joints(self, names: list[str], positions: list[float], t_ns: int = 10**9) -> Any:
        empty = np.zeros(0)
        return self.store.types[RosType.JOINT_STATE](
            self.header(t_ns), names, np.array(positions, dtype=np.float64), empty, empty
        )

    def trajectory(self, names: list[str], points: list[list[float]]) -> Any:
        return self.store.types[RosType.TRAJECTORY](
            self.header(0), names, [self._point(point) for point in points]
        )

    def array(self, values: list[float]) -> Any:
        types = self.store.types
        layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
        return types[RosType.ARRAY](layout, np.array(values, dtype=np.float64))

    def flag(self, value: bool) -> Any:
        return self.store.types["std_msgs/msg/Bool"](data=value)

    def cdr(self, message: Any) -> bytes:
        return bytes(self.store.serialize_cdr(message, message.__msgtype__))
