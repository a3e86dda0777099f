"""Names of the message types that are read and written."""

from __future__ import annotations

from typing import Final

__all__ = [
    "ARRAY",
    "BOOL",
    "COMMANDS",
    "CONTROLLER_STATE",
    "DIAGNOSTICS",
    "FLAGS",
    "JOINT_STATE",
    "JOINT_VALUES",
    "STATES",
    "TRAJECTORY",
]

CONTROLLER_STATE: Final = "control_msgs/msg/JointTrajectoryControllerState"
JOINT_STATE: Final = "sensor_msgs/msg/JointState"
TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
ARRAY: Final = "std_msgs/msg/Float64MultiArray"
BOOL: Final = "std_msgs/msg/Bool"
JOINT_VALUES: Final = "control_msgs/msg/DynamicJointState"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"

# What a topic of each role may carry.
STATES: Final = (CONTROLLER_STATE, JOINT_STATE)
COMMANDS: Final = (JOINT_STATE, TRAJECTORY, ARRAY)
FLAGS: Final = (BOOL,)
