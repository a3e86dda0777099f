"""A robot of two legs whose names in ROS 2 are known."""

from __future__ import annotations

import pytest

LEGS = """
[[leg]]
id = "lf"
joints = ["coxa", "femur", "tibia"]
lengths_m = [0.05, 0.07, 0.14]
ros2 = { joints = ["lf_c", "lf_f", "lf_t"] }
[[leg]]
id = "rf"
joints = ["coxa", "femur", "tibia"]
lengths_m = [0.05, 0.07, 0.14]
[leg.ros2]
joints = ["rf_c", "rf_f", "rf_t"]
"""
JOINTS = [f"{leg}_{joint}" for leg in ("lf", "rf") for joint in "cft"]


def text_of(ros2: str) -> str:
    return f'[robot]\nname = "mini"\nperiod_s = 0.02\nquantum_rad = 0.005\n[ros2]\n{ros2}\n{LEGS}'


@pytest.fixture
def joints() -> list[str]:
    return list(JOINTS)
