"""A URDF gives the legs it has; transforms made another way agree, all else is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import Leg
from adaptive_contact.robot.urdf import MOST_BYTES, MOST_DEPTH, Urdf, read_urdf

Numbers = tuple[float, float, float]


def joint(
    name: str,
    parent: str,
    child: str,
    *,
    kind: str = "revolute",
    xyz: Numbers = (0, 0, 0),
    rpy: Numbers = (0, 0, 0),
    axis: Numbers = (0, 1, 0),
    more: str = '<limit lower="-1" upper="1.5" effort="1" velocity="1"/>',
) -> str:
    def text(numbers: Numbers) -> str:
        return " ".join(map(repr, numbers))

    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{text(xyz)}" rpy="{text(rpy)}"/><axis xyz="{text(axis)}"/>{more}</joint>'
    )


def robot_of(*joints: str, links: str = "body hip thigh shank foot") -> bytes:
    named = "".join(f'<link name="{link}"/>' for link in links.split())
    return f'<?xml version="1.0"?><robot name="r">{named}{"".join(joints)}</robot>'.encode()


HIP = joint("haa", "body", "hip", xyz=(0.2, 0.05, 0), axis=(1, 0, 0))
THIGH = joint("hfe", "hip", "thigh", xyz=(0, 0.08, 0))
KNEE = joint("kfe", "thigh", "shank", xyz=(0, 0, -0.2), axis=(0, 1, 0))
FOOT = joint("tip", "shank", "foot", kind="fixed", xyz=(0, 0, -0.25), more="")


def leg_of(data: bytes, foot: str = "foot", **options: object) -> Leg:
    [leg] = Urdf(data, "x.urdf").legs({"l": foot}, **options).legs  # type: ignore[arg-type]
    return leg


def test_a_leg_is_read_with_its_joints_axes_origins_limits_and_mount() -> None:
    leg = leg_of(robot_of(HIP, THIGH, KNEE, FOOT))
    assert leg.joints == ("haa", "hfe", "kfe")
    assert leg.joint_axes == ("roll", (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
    assert leg.origins_m == ((0.0, 0.08, 0.0), (0.0, 0.0, -0.2), (0.0, 0.0, -0.25))
    assert leg.mount.xyz_m == (0.2, 0.05, 0.0)
    assert leg.limits.lower_rad == (-1.0, -1.0, -1.0)
    assert leg.limits.upper_rad == (1.5, 1.5, 1.5)


number = st.floats(-0.5, 0.5)
turn = st.floats(-3.1, 3.1)


@st.composite
def trees(draw: st.DrawFn) -> tuple[bytes, list[dict[str, object]]]:
    """A chain of one to seven joints, with fixed ones in between."""
    kinds = draw(st.lists(st.sampled_from(["revolute", "fixed"]), min_size=0, max_size=8))
    kinds = [*kinds[:6], "continuous", "fixed"]
    rows: list[dict[str, object]] = []
    for kind in kinds:
        axis = draw(st.tuples(number, number, number).filter(lambda v: np.linalg.norm(v) > 0.1))
        xyz, rpy = draw(st.tuples(number, number, number)), draw(st.tuples(turn, turn, turn))
        rows.append({"kind": kind, "xyz": xyz, "rpy": rpy, "axis": axis})
    # The last joint raises the foot in some posture: it is level, and the foot is aside.
    rows[-2]["rpy"], rows[-2]["axis"], rows[-1]["xyz"] = (0, 0, 0), (0, 1, 0), (0.1, 0.0, -0.3)
    joints = [
        joint(f"j{k}", f"l{k}", f"l{k + 1}", **row)  # type: ignore[arg-type]
        for k, row in enumerate(rows)
    ]
    links = " ".join(f"l{k}" for k in range(len(rows) + 1))
    return robot_of(*joints, links=links), rows


@settings(deadline=None)
@given(trees(), st.lists(turn, min_size=9, max_size=9))
def test_the_foot_is_where_transforms_down_the_tree_put_it(
    tree: tuple[bytes, list[dict[str, object]]], q: list[float]
) -> None:
    data, rows = tree
    frame, angles = np.eye(4), iter(q)
    for row in rows:
        step, spin = np.eye(4), np.eye(4)
        step[:3, :3] = Rotation.from_euler("xyz", row["rpy"]).as_matrix()
        step[:3, 3] = row["xyz"]
        if row["kind"] != "fixed":
            axis = np.array(row["axis"]) / np.linalg.norm(row["axis"])
            spin[:3, :3] = Rotation.from_rotvec(next(angles) * axis).as_matrix()
        frame = frame @ step @ spin
    # A description has micrometres, and what truncated pi has made is taken out of it.
    for digits, snap, near in ((6, 2e-5, 5e-4), (15, 0.0, 1e-9)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("adaptive_contact.robot.urdf._DIGITS", digits)
            patch.setattr("adaptive_contact.robot.urdf._SNAP", snap)
            leg = leg_of(data, f"l{len(rows)}", base="l0")
        place = leg.chain.foot(q[: len(leg.joints)]) + np.array(leg.mount.xyz_m)
        np.testing.assert_allclose(place, frame[:3, 3], atol=near)


def test_the_body_is_the_last_link_that_all_legs_hang_on() -> None:
    """A floating body, a torso that turns, and legs of which one has a link of its own."""
    free = joint("free", "world", "pelvis", kind="floating", more="")
    waist = joint("waist", "pelvis", "torso", axis=(0, 0, 1), xyz=(0, 0, 0.3))
    sides = [
        part
        for side, y in (("l", 0.1), ("r", -0.1))
        for part in (
            joint(f"{side}_hip", "torso", f"{side}_leg", xyz=(0, y, -0.1)),
            joint(f"{side}_end", f"{side}_leg", f"{side}_foot", kind="fixed", xyz=(0, 0, -0.3)),
        )
    ]
    links = "world pelvis torso l_leg l_foot r_leg r_foot"
    found = Urdf(robot_of(free, waist, *sides, links=links), "x").legs(
        {"l": "l_foot", "r": "r_foot"}
    )
    assert found.base == "torso"
    assert [leg.mount.xyz_m for leg in found.legs] == [(0.0, 0.1, -0.1), (0.0, -0.1, -0.1)]
    assert found.notes == ("the body is link 'torso': joints above it (waist) are no leg's",)
    alone = Urdf(robot_of(free, waist, *sides, links=links), "x").legs({"l": "l_foot"})
    assert alone.base == "pelvis"
    assert alone.legs[0].joints == ("waist", "l_hip")


def test_a_tip_is_told_where_no_link_is_there() -> None:
    data = robot_of(HIP, THIGH, KNEE, links="body hip thigh shank")
    with pytest.raises(ConfigurationError, match=r"begins in joint 'kfe'.*or --tip X,Y,Z"):
        leg_of(data, "shank")
    leg = leg_of(data, "shank", tips_m=[(0.0, 0.0, -0.25)])
    assert leg.origins_m == leg_of(robot_of(HIP, THIGH, KNEE, FOOT)).origins_m


def test_each_leg_may_have_a_tip_of_its_own() -> None:
    """Frames that a drawing program has mirrored."""
    data = robot_of(HIP, joint("other", "body", "thigh", xyz=(0.2, -0.05, 0)))
    feet = {"l": "hip", "r": "thigh"}
    found = Urdf(data, "x").legs(feet, tips_m=[(0, 0.1, -0.2), (0, -0.1, -0.2)])
    assert [leg.origins_m for leg in found.legs] == [((0.0, 0.1, -0.2),), ((0.0, -0.1, -0.2),)]
    with pytest.raises(ConfigurationError, match="--tip has 3 points for 2 legs; give one, or"):
        Urdf(data, "x").legs(feet, tips_m=[(0, 0.1, -0.2)] * 3)


@pytest.mark.parametrize("without", ['<axis xyz="1 0 0"/>', ' xyz="1 0 0"'])
def test_an_axis_that_is_missing_is_x(without: str) -> None:
    assert without in HIP
    assert leg_of(robot_of(HIP.replace(without, ""), THIGH, KNEE, FOOT)).joint_axes[0] == "roll"


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "cp1252"])
def test_files_of_other_systems_are_read(encoding: str) -> None:
    plain = robot_of(HIP, THIGH, KNEE.replace("kfe", "knee é/1"), FOOT).decode()
    said = f'<?xml version="1.0" encoding="{encoding.removesuffix("-sig")}"?>'
    text = plain.replace('<?xml version="1.0"?>', said).replace("><", ">\r\n<")
    assert leg_of(text.encode(encoding)).joints == ("haa", "hfe", "knee é/1")


def test_limits_that_are_missing_are_said() -> None:
    wheel = joint("kfe", "thigh", "shank", kind="continuous", xyz=(0, 0, -0.2), more="")
    found = Urdf(robot_of(HIP, THIGH, wheel, FOOT), "x").legs({"l": "foot"})
    assert found.legs[0].limits.upper_rad == (1.5, 1.5, pytest.approx(np.pi, abs=1e-5))
    assert found.notes == ("no limits for joint kfe; fill in limits before the bridge drives it",)
    none = [part.replace("<limit", "<no") for part in (HIP, THIGH, KNEE)]
    assert leg_of(robot_of(*none, FOOT)).limits is None


def test_joints_that_lead_to_no_foot_are_named() -> None:
    rod = joint("rod", "thigh", "bar", more='<mimic joint="kfe"/>')
    head = joint("neck", "body", "head", kind="prismatic", more="")
    plate = joint("plate", "shank", "cover", kind="fixed", more="")
    named = "body hip thigh shank foot bar head cover"
    data = robot_of(HIP, THIGH, KNEE, FOOT, rod, head, plate, links=named)
    found = Urdf(data, "x").legs({"l": "foot"})
    assert found.legs == (leg_of(robot_of(HIP, THIGH, KNEE, FOOT)),)
    (note,) = found.notes
    assert "lead to no foot: joint rod, neck" in note


def test_a_foot_of_other_case_is_recognised() -> None:
    with pytest.raises(ConfigurationError, match=r"no link 'FOOT'; did you mean 'foot'\?"):
        leg_of(robot_of(HIP, THIGH, KNEE, FOOT), "FOOT")


def test_a_body_that_is_upside_down_is_doubted() -> None:
    over = [part.replace("-0.2", "0.2") for part in (KNEE, FOOT)]
    found = Urdf(robot_of(HIP, THIGH, *over), "x").legs({"l": "foot"})
    assert len(found.notes) == 1
    assert "is z of link 'body' up?" in found.notes[0]


@pytest.mark.parametrize(
    ("data", "foot", "says"),
    [
        (b"", "foot", "no XML that can be read (no element found)"),
        (b"<robot><link", "foot", "line 1: no XML that can be read"),
        (b"<sdf/>", "foot", "begins with <sdf>; expected a URDF's <robot>"),
        (b"<robot/>", "foot", "has no <link>"),
        (
            b'<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot>&b;</robot>',
            "foot",
            "has <!DOCTYPE r>; expected a URDF's <robot>, with no DOCTYPE",
        ),
        (b'<!DOCTYPE r SYSTEM "http://example.org/x"><robot/>', "foot", "has <!DOCTYPE r>"),
        (b"<robot>&xxe;</robot>", "foot", "no XML that can be read (undefined entity)"),
        (
            b'<robot xmlns:xacro="x"><xacro:macro name="leg"/></robot>',
            "foot",
            "<macro> is xacro, not expanded; run `xacro FILE > robot.urdf`",
        ),
        (
            robot_of(HIP.replace('xyz="0.2', 'xyz="${length}'), THIGH, KNEE, FOOT),
            "foot",
            "<origin> is xacro, not expanded; run `xacro",
        ),
        (
            b'<robot xmlns:x="http://www.ros.org/wiki/xacro"><x:property name="a"/></robot>',
            "foot",
            "<property> is xacro",
        ),
        (b'<robot><macro name="leg"/></robot>', "foot", "<macro> is xacro"),
        (robot_of(HIP.replace('link="body', 'link="${of}body')), "hip", "<parent> is xacro"),
        (robot_of(HIP.replace('lower="-1', 'lower="$(arg low)')), "hip", "<limit> is xacro"),
        (b'<?xml version="1.0" encoding="GB2312"?><robot/>', "foot", "multi-byte encodings"),
        (b'<?xml version="1.0" encoding="none"?><robot/>', "foot", "unknown encoding: none"),
        (b"<!DOCTYPE html><html/>", "foot", "has <!DOCTYPE html>; expected a URDF's <robot>"),
        (b"<mujoco/>", "foot", "begins with <mujoco>; expected a URDF's <robot>: give a URDF, or"),
        (robot_of(HIP.replace('"1 0 0"', '"1.7e308 1.7e308 0"')), "hip", "has the axis 1.7e+308"),
        (
            robot_of(HIP.replace("revolute", "prismatic"), THIGH, KNEE, FOOT),
            "foot",
            "joint 'haa' is prismatic; expected revolute, continuous or fixed in a leg: give",
        ),
        (robot_of(HIP.replace('xyz="0.2', 'xyz="nan')), "foot", "xyz has 'nan'; expected a number"),
        (robot_of(HIP.replace('xyz="0.2', 'xyz="0')), "toot", "there is no link 'toot'; did you"),
        (robot_of(HIP), "none", "there is no link 'none'; its last links: hip"),
        (robot_of(HIP.replace("0.05 0", "0.05")), "foot", "xyz has 2 numbers; expected 3"),
        (robot_of(HIP, links="body hip hip"), "hip", "link 'hip' is there twice"),
        (robot_of(HIP, HIP), "hip", "joint 'haa' is there twice"),
        (robot_of(HIP, links="body"), "body", "has the child link 'hip'; there is no such <link>"),
        (
            robot_of(HIP, THIGH, joint("rod", "body", "thigh")),
            "thigh",
            "hangs on joint 'hfe' and on joint 'rod'; expected a tree: a loop",
        ),
        (
            robot_of(joint("a", "body", "hip"), joint("b", "hip", "body")),
            "hip",
            "hang on each other in a circle; expected a tree of links",
        ),
        (
            robot_of(HIP, THIGH, KNEE.replace("<limit", '<mimic joint="hfe"/><limit'), FOOT),
            "foot",
            "joint 'kfe' follows joint 'hfe' (mimic); remove its <mimic> if your source publishes",
        ),
        (
            robot_of(HIP, THIGH, KNEE.replace("revolute", "prismatic"), FOOT),
            "foot",
            "joint 'kfe' is prismatic; expected revolute, continuous or fixed in a leg",
        ),
        (
            robot_of(HIP, THIGH, KNEE.replace("revolute", "floating"), FOOT),
            "foot",
            "joint 'kfe' is floating; expected revolute",
        ),
        (robot_of(HIP.replace("revolute", "screw")), "hip", "has type 'screw'; expected one of"),
        (robot_of(HIP, THIGH, KNEE.replace("0 1 0", "0 0 0"), FOOT), "foot", "has the axis 0 0 0"),
        (robot_of(FOOT), "foot", "no joint below link 'foot' turns link 'foot'"),
        (
            robot_of(joint("a", "body", "hip", axis=(0, 0, 1)), joint("b", "hip", "foot",
                     kind="fixed", xyz=(0.1, 0, 0), more="")),
            "foot",
            "no joint raises its foot; is z of link 'body' up?",
        ),
        (b'<robot><link/></robot>', "foot", "a <link> has no name"),
        (b"<robot>" + b"<a>" * MOST_DEPTH + b"</robot>", "foot", "nested more than 64 deep"),
    ],
)  # fmt: skip
def test_what_is_no_leg_is_refused_in_one_line(data: bytes, foot: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=f"^x.urdf: .*{re.escape(says)}"):
        leg_of(data, foot)


SPINE = robot_of(
    joint("spine", "rear", "front", axis=(0, 0, 1)),
    joint("ja", "front", "a", xyz=(0, 0.1, 0)),
    joint("jb", "front", "b", xyz=(0, -0.1, 0)),
    joint("jc", "rear", "c"),
    links="rear front spare a b c",
)


@pytest.mark.parametrize(
    ("data", "feet", "more", "says"),
    [
        (
            robot_of(joint("a", "body", "hip"), joint("b", "thigh", "shank")),
            {"l": "hip", "r": "shank"},
            {},
            r"several roots \(body, thigh\)",
        ),
        (
            SPINE,
            {"a": "a", "b": "b", "c": "c"},
            {"tips_m": [(0.1, 0.0, -0.1)]},
            "joint 'spine' moves leg 'a' and leg 'b'",
        ),
        (SPINE, {"a": "a"}, {"base": "spare"}, "--base 'spare' carries no leg 'a'"),
    ],
)
def test_several_roots_and_shared_joints_are_refused(
    data: bytes, feet: dict[str, str], more: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigurationError, match=says):
        Urdf(data, "x").legs(feet, **more)


def test_large_and_missing_files_are_refused(tmp_path: Path) -> None:
    large = tmp_path / "large.urdf"
    large.write_bytes(b"<robot>" + b" " * MOST_BYTES + b"</robot>")
    with pytest.raises(ConfigurationError, match="has more than 8000 kB; give the path of a URDF"):
        read_urdf(large)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_urdf(tmp_path / "none.urdf")


@settings(deadline=None, max_examples=200)
@given(st.data())
def test_any_bytes_are_read_or_refused_in_one_line(data: st.DataObject) -> None:
    whole = robot_of(HIP, THIGH, KNEE, FOOT)
    first = data.draw(st.integers(0, len(whole)))
    last = data.draw(st.integers(first, min(len(whole), first + 20)))
    spoiled = whole[:first] + data.draw(st.binary(max_size=12)) + whole[last:]
    said = "read"
    try:
        leg_of(spoiled)
    except ConfigurationError as error:
        said = str(error)
    assert said.isprintable()
