"""Draws robots of the second engine: builds, servos, rates, gaits and grounds that nobody chose.

Some of them are no good robots: servos that buzz, gaits of six ticks a swing.  They stay.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact_bullet.gait import GAITS, Gait, Stop
from adaptive_contact_bullet.plant import Kind
from adaptive_contact_bullet.robots import SHAPES, LegShape, Shape
from adaptive_contact_bullet.servo import Servo

_NAME: Final = "drawn-"
_QUADRUPEDS: Final = 0.4  # share; the others are hexapods
_PERIODS_S: Final = (0.005, 0.01, 0.012, 0.02, 0.02, 0.025, 0.033)
_QUANTA_RAD: Final = (0.0, math.tau / 65536, math.tau / 4096, math.radians(300.0) / 1023)
_KINDS: Final[tuple[Kind, ...]] = ("hard", "hard", "soft", "rough", "tilted")


class Drawn(NamedTuple):
    """One robot, its gait and its ground."""

    shape: Shape
    gait: Gait
    kind: Kind


def is_drawn(name: str) -> bool:
    """Whether this is the name of a drawn robot, such as ``drawn-17``."""
    return name.startswith(_NAME) and name.removeprefix(_NAME).isdecimal()


def shape_of(name: str) -> Shape:
    """Return a robot by its name, drawn or not."""
    return drawn(name).shape if is_drawn(name) else SHAPES[name]


def gait_of(name: str) -> Gait:
    """Return a gait by its name; that of a drawn robot has the robot's."""
    return drawn(name).gait if is_drawn(name) else GAITS[name]


@functools.cache
def drawn(name: str) -> Drawn:
    """Draw a robot by the number in its name."""
    rng = np.random.default_rng([int(name.removeprefix(_NAME)), 0xD4A])
    four = bool(rng.random() < _QUADRUPEDS)
    base = SHAPES["quadruped" if four else "hexapod"]
    size = _times(rng, 0.8, 1.4)
    link_kg = [_times(rng, 0.6, 1.6) for _ in range(base.joints)]
    shape = dataclasses.replace(
        base,
        name=name,
        period_s=float(rng.choice(_PERIODS_S)),
        servo=_servo(base.servo, rng),
        described_slope=_times(rng, 0.5, 2.0),
        body_kg=base.body_kg * _times(rng, 0.5, 1.6),
        legs=tuple(_leg(leg, size, link_kg) for leg in base.legs),
        bump_m=0.008 if four else 0.015,
    )
    gait = _gait(name, rng, size, four=four)
    return Drawn(shape, gait, _KINDS[rng.integers(len(_KINDS))])


def _times(rng: np.random.Generator, least: float, most: float) -> float:
    return float(np.exp(rng.uniform(math.log(least), math.log(most))))


def _servo(of: Servo, rng: np.random.Generator) -> Servo:
    times = functools.partial(_times, rng)
    return Servo(
        stall_nm=of.stall_nm * times(0.6, 1.8),
        no_load_rad_s=of.no_load_rad_s * times(0.7, 1.6),
        gain=times(3.5, 12.0),
        damping=of.damping * times(0.3, 2.0),
        rotor_kgm2=of.rotor_kgm2 * times(0.4, 2.5),
        coulomb_nm=of.coulomb_nm * times(0.3, 2.5),
        stribeck_nm=of.stribeck_nm * times(0.2, 2.5),
        load_friction=times(0.02, 0.4),
        spring_nm_rad=of.spring_nm_rad * times(0.4, 3.0),
        play_rad=math.radians(times(0.05, 1.5)),
        quantum_rad=float(rng.choice(_QUANTA_RAD)),
        noise_rad=times(0.0001, 0.0025),
        latency_ticks=int(rng.integers(4)),
        on_motor=bool(rng.random() < 0.3),
    )


def _leg(of: LegShape, size: float, link_kg: list[float]) -> LegShape:
    return dataclasses.replace(
        of,
        origins_m=tuple((size * x, size * y, size * z) for x, y, z in of.origins_m),
        masses_kg=tuple(m * k for m, k in zip(of.masses_kg, link_kg, strict=True)),
    )


def _gait(name: str, rng: np.random.Generator, size: float, *, four: bool) -> Gait:
    planned = bool(rng.random() < 0.4)
    below_m = rng.uniform(0.001, 0.005) if planned else rng.uniform(0.005, 0.03)
    stop: Stop = "never" if planned else "touch"
    if four:
        of, cycle_s, below_m = GAITS["trot"], rng.uniform(0.4, 0.8), 0.5 * below_m
    else:
        of = GAITS["ripple" if rng.random() < 0.3 else "tripod"]
        cycle_s = of.cycle_s * _times(rng, 0.7, 2.5)
    return dataclasses.replace(
        of, name=name, cycle_s=cycle_s, step_m=of.step_m * size, below_m=below_m,
        height_m=size * rng.uniform(0.025, 0.05), react_s=rng.uniform(0.03, 0.12), stop=stop,
    )  # fmt: skip
