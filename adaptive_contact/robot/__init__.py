"""Describes the robot: its description, and the geometry of its legs."""

from __future__ import annotations

from adaptive_contact.robot.description import (
    ROBOT_HOUR_TICKS,
    AngleFrame,
    Angles,
    DetectorSettings,
    Leg,
    LegRos2,
    Limits,
    Mount,
    Port,
    Robot,
    Ros2,
    ServoBus,
    ServoLaw,
)
from adaptive_contact.robot.kinematics import (
    Chain,
    axis_text,
    foot,
    inverse,
)
from adaptive_contact.robot.load import load_robot, parse_robot, shipped_robot

__all__ = [
    "ROBOT_HOUR_TICKS",
    "AngleFrame",
    "Angles",
    "Chain",
    "DetectorSettings",
    "Leg",
    "LegRos2",
    "Limits",
    "Mount",
    "Port",
    "Robot",
    "Ros2",
    "ServoBus",
    "ServoLaw",
    "axis_text",
    "foot",
    "inverse",
    "load_robot",
    "parse_robot",
    "shipped_robot",
]
