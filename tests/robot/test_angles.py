"""`[leg.angles]`: the wire's angles into the description's, and back."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import AngleFrame, parse_robot
from adaptive_contact.wire import ServoSample

TOML = """
[robot]
name = "testbot"
period_s = 0.02
quantum_rad = 0.005
[[leg]]
id = "rf"
joints = ["coxa", "femur", "tibia"]
"""
ANGLE = st.floats(-6.0, 6.0)


def leg(text: str = "") -> AngleFrame:
    return AngleFrame(parse_robot(TOML + text, source="test").leg("rf"))


def test_without_the_table_a_sample_is_left_as_it_is() -> None:
    sample = ServoSample(t_ns=1, seq=1, measured=[0.1, 0.2, 0.3], desired=[0.0, 0.0, 0.0])
    frame = leg()
    assert frame.same
    assert frame.sample(sample) is sample


def test_directions_come_before_offsets() -> None:
    frame = leg("angles = { directions = [1, -1, -1], offsets_rad = [0.0, 0.5, -1.0] }")
    sample = ServoSample(
        t_ns=1, seq=1, measured=[0.1, 0.2, 0.3], desired=[1.0, 1.0, 1.0], preview=[[0.0] * 3]
    )
    turned = frame.sample(sample)
    assert turned.measured == [0.1, 0.5 - 0.2, -1.0 - 0.3]
    assert turned.desired == [1.0, -0.5, -2.0]
    assert turned.preview == [[0.0, 0.5, -1.0]]
    assert sample.measured == [0.1, 0.2, 0.3], "inputs are never changed"


def test_a_sample_of_another_length_is_left_to_the_checks() -> None:
    frame = leg("angles = { directions = [1, -1, -1] }")
    assert frame.sample(ServoSample(t_ns=1, seq=1, measured=[1.0], desired=[])).measured == [1.0]


@given(
    st.lists(st.sampled_from([1, -1]), min_size=3, max_size=3),
    st.lists(ANGLE, min_size=3, max_size=3),
    st.lists(ANGLE, min_size=3, max_size=3),
)
def test_there_and_back_is_where_it_was(
    directions: list[int], offsets: list[float], wire: list[float]
) -> None:
    frame = leg(f"angles = {{ directions = {directions}, offsets_rad = {offsets} }}")
    assert frame.wire(frame.angles(wire)) == pytest.approx(wire, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("angles = { directions = [1, -1] }", "angles.directions"),
        ("angles = { directions = [1, 0, 1] }", "use 1 or -1"),
        ("angles = { offsets_rad = [0.0, nan, 0.0] }", "angles.offsets_rad has nan"),
        (f"angles = {{ offsets_rad = [0.0, {math.degrees(1.0)}, 0.0] }}", "-6.28 to 6.28"),
        ("angles = { direction = [1, 1, 1] }", "directions"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(text: str, found: str) -> None:
    with pytest.raises(ConfigurationError, match=found):
        leg(text)
