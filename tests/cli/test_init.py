"""``robot init`` without a bus: from a URDF, from options; and its picture."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.cli._robot_picture import draw
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import Leg, Mount, Robot, load_robot
from programs import invoke
from urdfs import SIDES, quadruped

FEET = ",".join(f"{leg}={leg}_foot" for leg in SIDES)
STEPS = ("--resolution", "0.00153", "--rate", "100")


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("walker.urdf").write_text(quadruped())


def test_a_urdf_becomes_a_robot() -> None:
    said = invoke("robot", "init", "--urdf", "walker.urdf", "--legs", FEET, *STEPS)
    assert "wrote robot.toml: 4 legs of 3 joints; run `adaptive-contact robot check --live" in said
    robot = load_robot("robot.toml")
    assert robot.name == "walker"
    assert robot.leg_ids == ("fl", "fr", "hl", "hr")
    assert (robot.period_s, robot.quantum_rad) == (0.01, 0.00153)
    leg = robot.leg("hr")
    assert leg.joints == ("hr_roll", "hr_hip", "hr_knee")
    assert leg.mount.xyz_m == (-0.2, -0.05, 0.0)
    assert leg.chain is not None
    # Knees bent backwards: as far below the hip on the right as on the left.
    pose = [0.2, 0.7, -1.4]
    at = [one.chain.foot(pose) for one in robot.legs if one.chain is not None]
    assert at[0][2] == pytest.approx(
        np.sin(0.2) * 0.08 - np.cos(0.2) * 0.16 * (np.cos(0.7) + np.cos(-0.7))
    )
    assert at[1][2] - at[0][2] == pytest.approx(-2 * 0.08 * np.sin(0.2))


def test_without_a_urdf_joints_are_named() -> None:
    said = invoke("robot", "init", "--legs", "l,r", "--joints", "hip,knee,ankle,toe", *STEPS)
    assert "2 legs of 4 joints; fill in lengths_m, then run" in said
    robot = load_robot("robot.toml")
    assert robot.leg("l").joints == ("hip", "knee", "ankle", "toe")
    assert robot.leg("l").joint_axes == ("yaw", "pitch", "pitch", "pitch")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "which port.*--urdf FILE --legs .* or --legs lf,rf,... --joints 3, .*--rate 50"),
        (("--urdf", "walker.urdf"), r"which links are the feet\? give --legs lf=LINK,...; .*fl_f"),
        (("--urdf", "walker.urdf", "--legs", "fl"), "a leg has no link; with --urdf give lf=LINK"),
        (("--urdf", "walker.urdf", "--legs", "a=fl_foot,b=fl_foot"), "one is there twice"),
        (("--urdf", "walker.urdf", "--legs", FEET), "give --rate 50 .*, --resolution .* as well"),
        (("--urdf", "none.urdf", "--legs", FEET), "none.urdf: cannot be read"),
        (("--urdf", "walker.urdf", "--legs", FEET, "--joints", "3"), "both give the joints"),
        (("--urdf", "walker.urdf", "--legs", FEET, "--lengths", "1"), "both give the geometry"),
        (("--urdf", "walker.urdf", "--legs", FEET, "--tip", "0,1"), "--tip 0,1: expected X,Y,Z"),
        (("--urdf", "walker.urdf", "--legs", FEET, "--tip", "0,0,1/0,0,1"), "--tip has 2 points"),
        (("--legs", "a,a", "--joints", "3"), "one is there twice; legs and feet must differ"),
        (("--legs", "a/b", "--joints", "3", *STEPS), "'a/b': an id is 1 to 32 letters"),
        (("--legs", "a=x", "--joints", "3"), "links go with --urdf FILE"),
        (("--legs", "a", "--joints", "3", "--base", "x"), "--base and --tip go with --urdf"),
        (("--joints", "3"), "give --legs lf,rf,... .*, --rate 50 .*, --resolution .* as well"),
        (("--legs", "a", "--joints", "a,a"), "--joints a,a: expected 1 to 16, or as many differ"),
        (("--legs", "a", "--joints", "0"), "--joints 0: expected 1 to 16"),
        (("--legs", "a", "--joints", "3", "--rate", "50"), "give --resolution .* as well"),
    ],
)
def test_what_is_missing_is_said_in_one_line(words: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        invoke("robot", "init", *words)
    assert not Path("robot.toml").exists()


def test_a_urdf_in_millimetres_is_named() -> None:
    Path("mm.urdf").write_text(quadruped().replace("-0.16", "-160"))
    with pytest.raises(
        ConfigurationError, match=r"^mm.urdf: .*origins_m\[1\]\[2\] is -160.0; expected .* m"
    ):
        invoke("robot", "init", "--urdf", "mm.urdf", "--legs", FEET, *STEPS)


@pytest.mark.parametrize(("axis", "ahead"), [((0, -1, 0), 1), ((0, 1, 0), -1)])
def test_an_arrow_shows_the_way_in_which_the_foot_goes(axis: tuple, ahead: int) -> None:
    """A leg that hangs straight down: plus swings its foot ahead about -y, back about y."""
    mount = Mount(xyz_m=(0.1, 0.0, 0.0))
    legs = tuple(
        Leg(id=name, joints=("hip",), axes=(axis,), origins_m=((0, 0, -0.2),), mount=mount)
        for name in ("a", "b")
    )
    robot = Robot(name="r", period_s=0.02, quantum_rad=0.001, legs=legs)
    assert np.sign(legs[0].chain.foot([0.1])[0]) == ahead  # type: ignore[union-attr]
    text = draw(robot, {"a": [0.0], "b": [0.0]})
    side = text[text.index("from the side") : text.index("from the front")]
    [(begins, ends)] = re.findall(r'd="M ([-\d.]+) [-\d.]+ A .*? 0 0 [01] ([-\d.]+) [-\d.]+"', side)
    assert np.sign(float(ends) - float(begins)) == ahead


def test_a_robot_on_no_bus_is_drawn_as_described() -> None:
    invoke("robot", "init", "--urdf", "walker.urdf", "--legs", FEET, *STEPS)
    said = invoke("robot", "check", "--config", "robot.toml", "--picture", "legs.svg")
    assert "drawn with all joints at 0" in said
    assert "hr_knee" in Path("legs.svg").read_text(encoding="utf-8")
