"""The robots: a hexapod, a quadruped and an arm, none of them one that ships.

Lengths, masses, servos and gaits are assumed, each within what such robots have, and other than
those of the robots that the product was made with.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact_bullet.servo import Servo

Point = tuple[float, float, float]
_AXES: Final = {"yaw": "0 0 1", "roll": "1 0 0", "pitch": "0 -1 0"}
_LINK_RADIUS_M: Final = 0.012


@dataclasses.dataclass(frozen=True)
class LegShape:
    """One leg as it is built."""

    id: str
    axes: tuple[str, ...]
    origins_m: tuple[Point, ...]  # from each joint to the next, the last to the tip
    masses_kg: tuple[float, ...]
    mount_m: Point
    yaw_rad: float
    rest_rad: tuple[float, ...]  # as it stands


@dataclasses.dataclass(frozen=True)
class Shape:
    """One robot as it is built."""

    name: str
    period_s: float
    servo: Servo
    described_slope: float  # slope in robot.toml over the true one
    body_kg: float
    body_m: Point  # half extents
    legs: tuple[LegShape, ...]
    sole_m: float = 0.009
    bump_m: float = 0.022  # of rough ground, the highest that it walks over without a fall

    @property
    def joints(self) -> int:
        """Of a leg."""
        return len(self.legs[0].axes)

    @property
    def description(self) -> Robot:
        """Its robot.toml, as the product reads it."""
        return parse_robot(self.toml(), source=self.name)

    def toml(self) -> str:
        """Write its robot.toml."""
        quantum = self.servo.quantum_rad or self.servo.noise_rad
        lines = [
            "[robot]", f'name = "{self.name}"', f"period_s = {self.period_s}",
            f"quantum_rad = {quantum}", "[servo]",
            f"slope_rad = {self.servo.slope_rad * self.described_slope:.4f}",
        ]  # fmt: skip
        for leg in self.legs:
            names = [f"j{i}" for i in range(len(leg.axes))]
            lines += [
                "[[leg]]", f'id = "{leg.id}"', f"joints = {names}", f"axes = {list(leg.axes)}",
                f"origins_m = {[list(p) for p in leg.origins_m]}",
                f"mount = {{ xyz_m = {list(leg.mount_m)}, yaw_rad = {leg.yaw_rad} }}",
            ]  # fmt: skip
        return "\n".join(lines) + "\n"

    def urdf(self) -> str:
        """Write it for the engine; links are in the order of legs and joints."""
        x, y, z = self.body_m
        parts = [f'<robot name="{self.name}">', _body(self.body_kg, x, y, z)]
        for leg in self.legs:
            parent, origin, yaw = "body", leg.mount_m, leg.yaw_rad
            for i, axis in enumerate(leg.axes):
                link = f"{leg.id}{i}"
                tip = self.sole_m if i == len(leg.axes) - 1 else None
                parts.append(
                    f'<joint name="j{link}" type="revolute"><parent link="{parent}"/>'
                    f'<child link="{link}"/><axis xyz="{_AXES[axis]}"/>'
                    f'<origin xyz="{_text(origin)}" rpy="0 0 {yaw}"/>'
                    '<limit lower="-4" upper="4" effort="1000" velocity="1000"/></joint>'
                    + _link(link, leg.origins_m[i], leg.masses_kg[i], tip)
                )
                parent, origin, yaw = link, leg.origins_m[i], 0.0
        return "\n".join([*parts, "</robot>"])


def _text(point: Point) -> str:
    return " ".join(f"{value:.9g}" for value in point)


def _body(mass: float, x: float, y: float, z: float) -> str:
    xx, yy, zz = (mass / 3.0 * (a * a + b * b) for a, b in ((y, z), (x, z), (x, y)))
    return (
        f'<link name="body"><inertial><mass value="{mass}"/><inertia ixx="{xx}" iyy="{yy}" '
        f'izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
        f'<collision><geometry><box size="{2 * x} {2 * y} {2 * z}"/></geometry></collision></link>'
    )


def _link(name: str, to: Point, mass: float, sole_m: float | None) -> str:
    """A rod from the joint to the next, with a ball at its end where that is the foot's tip."""
    line = np.array(to)
    across = mass * (line @ line / 12.0 + _LINK_RADIUS_M**2 / 4.0)
    along = mass * _LINK_RADIUS_M**2 / 2.0
    unit = line / max(float(np.linalg.norm(line)), 1e-9)
    inertia = across * np.eye(3) + (along - across) * np.outer(unit, unit)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.tolist()
    ball = (
        ""
        if sole_m is None
        else f'<collision><origin xyz="{_text(to)}"/><geometry><sphere radius="{sole_m}"/>'
        "</geometry></collision>"
    )
    middle = (to[0] / 2.0, to[1] / 2.0, to[2] / 2.0)
    return (
        f'<link name="{name}"><inertial><origin xyz="{_text(middle)}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="{xy}" ixz="{xz}" iyz="{yz}"/>'
        f"</inertial>{ball}</link>"
    )


def _along(*lengths: float) -> tuple[Point, ...]:
    return tuple((length, 0.0, 0.0) for length in lengths)


_SMALL: Final = Servo(
    stall_nm=2.1, no_load_rad_s=7.5, gain=7.0, damping=0.12, rotor_kgm2=0.006, coulomb_nm=0.05,
    stribeck_nm=0.035, load_friction=0.14, spring_nm_rad=55.0, play_rad=math.radians(0.4),
    quantum_rad=math.radians(300.0) / 1023, noise_rad=0.0012, latency_ticks=1,
)  # fmt: skip
_GEARED: Final = dataclasses.replace(
    _SMALL, gain=4.5, spring_nm_rad=24.0, play_rad=math.radians(0.9), rotor_kgm2=0.009,
    coulomb_nm=0.08, load_friction=0.2, quantum_rad=math.tau / 1024, latency_ticks=0, on_motor=True,
)  # fmt: skip
# Drives that rub and wind up: a foot that meets something is felt late and by little.
_RUBBING: Final = dataclasses.replace(
    _SMALL, rotor_kgm2=0.012, coulomb_nm=0.1, stribeck_nm=0.06, load_friction=0.3, noise_rad=0.002,
    play_rad=math.radians(0.8),
)  # fmt: skip


def _hexapod(name: str, servo: Servo, body_kg: float, lighter: float = 1.0) -> Shape:
    legs = [
        LegShape(
            id=f"{side}{place}",
            axes=("yaw", "pitch", "pitch"),
            origins_m=_along(0.045, 0.08, 0.125),
            masses_kg=(0.06 * lighter, 0.11 * lighter, 0.09 * lighter),
            mount_m=(x, y if side == "l" else -y, 0.0),
            yaw_rad=turn if side == "l" else -turn,
            rest_rad=(0.0, 0.45, -1.75),
        )
        for side in "lr"
        for place, x, y, turn in (
            ("f", 0.11, 0.055, math.radians(50)),
            ("m", 0.0, 0.08, math.radians(90)),
            ("r", -0.11, 0.055, math.radians(130)),
        )
    ]
    return Shape(name, 0.02, servo, 1.1, body_kg, (0.13, 0.06, 0.03), tuple(legs))


def _quadruped() -> Shape:
    legs = []
    for place, x in (("f", 0.18), ("b", -0.18)):
        for side, sign in (("l", 1.0), ("r", -1.0)):
            knee = 1.0 if place == "f" else -1.0
            legs.append(
                LegShape(
                    id=place + side,
                    axes=("roll", "pitch", "pitch"),
                    origins_m=((0.0, sign * 0.05, 0.0), (0.0, 0.0, -0.17), (0.0, 0.0, -0.18)),
                    masses_kg=(0.35, 0.45, 0.15),
                    mount_m=(x, sign * 0.06, 0.0),
                    yaw_rad=0.0,
                    rest_rad=(0.0, -0.7 * knee, 1.4 * knee),
                )
            )
    return Shape(
        "bullet-quadruped",
        0.01,
        Servo(
            stall_nm=16.0,
            no_load_rad_s=24.0,
            gain=5.0,
            damping=0.12,
            rotor_kgm2=0.02,
            coulomb_nm=0.22,
            stribeck_nm=0.1,
            load_friction=0.06,
            spring_nm_rad=420.0,
            play_rad=math.radians(0.1),
            quantum_rad=0.0,
            noise_rad=0.0004,
            latency_ticks=2,
        ),
        0.9,
        5.5,
        (0.22, 0.09, 0.05),
        tuple(legs),
        sole_m=0.015,
        bump_m=0.010,
    )


def _arm() -> Shape:
    leg = LegShape(
        id="arm",
        axes=("yaw", "pitch", "pitch", "pitch"),
        origins_m=_along(0.04, 0.11, 0.1, 0.1),
        masses_kg=(0.1, 0.14, 0.12, 0.12),
        mount_m=(0.0, 0.0, 0.0),
        yaw_rad=0.0,
        rest_rad=(0.0, 0.7, -1.4, -0.6),
    )
    return Shape(
        "bullet-arm",
        0.02,
        Servo(
            stall_nm=2.9,
            no_load_rad_s=4.7,
            gain=5.3,
            damping=0.03,
            rotor_kgm2=0.02,
            coulomb_nm=0.1,
            stribeck_nm=0.05,
            load_friction=0.1,
            spring_nm_rad=60.0,
            play_rad=math.radians(0.6),
            quantum_rad=math.tau / 4096,
            noise_rad=0.0006,
            latency_ticks=0,
        ),
        1.3,
        5.0,
        (0.05, 0.05, 0.05),
        (leg,),
    )


_HEXAPODS: Final = (
    _hexapod("bullet-hexapod", _SMALL, 1.3),
    _hexapod("bullet-geared", _GEARED, 0.9),
    _hexapod("bullet-light", _RUBBING, 0.5, 0.5),
    _hexapod(
        "bullet-worm",
        dataclasses.replace(
            _GEARED, rotor_kgm2=0.02, coulomb_nm=0.15, load_friction=0.5, noise_rad=0.002
        ),
        0.6,
        0.6,
    ),
)
SHAPES: Final = {s.name.split("-")[1]: s for s in (*_HEXAPODS, _quadruped(), _arm())}


def rest_angles(shape: Shape) -> Array:
    """Angles of all joints as the robot stands, (L J,) rad."""
    return np.concatenate([leg.rest_rad for leg in shape.legs])
