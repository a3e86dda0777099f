"""Types of the messages that are read and written."""

from __future__ import annotations

import enum
from typing import Final


class RosType(enum.StrEnum):
    """Name of a message type, as keys, bags and rosbags write it."""

    CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
    JOINT_STATE = "sensor_msgs/msg/JointState"
    TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
    ARRAY = "std_msgs/msg/Float64MultiArray"
    BOOL = "std_msgs/msg/Bool"
    JOINT_VALUES = "control_msgs/msg/DynamicJointState"
    DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


# What a topic of each role may carry.
STATES: Final = (RosType.CONTROLLER_STATE, RosType.JOINT_STATE)
COMMANDS: Final = (RosType.JOINT_STATE, RosType.TRAJECTORY, RosType.ARRAY)
FLAGS: Final = (RosType.BOOL,)
