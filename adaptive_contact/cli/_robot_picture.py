"""Draws the robot from above and every leg from the side, as an SVG.

Beside each joint: a dashed line where its zero is, and an arrow the way its angle grows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.cli._output import print_line
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import write_file
from adaptive_contact.robot import Angles, Leg, Mount, Robot
from adaptive_contact.robot.kinematics import rotation

_CELL: Final = 300  # px, of a panel
_TOP: Final = 62
_MARGIN: Final = 50
_LINE: Final = 15
_COLOURS: Final = ("#1f6fb4", "#c8691b", "#3b8a3f", "#8a3b86", "#a33c3c", "#5d6d7e")
_GREY, _INK = "#7f8c8d", "#2c3e50"
# A joint's turn is drawn where its axis points this much towards the eye, and from a link that is
# no shorter than this share of the leg.
_FACING: Final = 0.5
_LEAST_LINK: Final = 0.05
_UP: Final = (0.0, 0.0, 1.0)
# What all panels have in common; arrows end in the marker.
_HEAD: Final = """\
<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" \
viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12">
<marker id="head" viewBox="0 0 10 10" refX="5" refY="5" markerWidth="12" markerHeight="12" \
markerUnits="userSpaceOnUse" orient="auto"><path d="M 0 0 L 10 5 L 0 10 z"/></marker>
<rect width="{width}" height="{height}" fill="#ffffff"/>
<text x="10" y="19" font-size="15" font-weight="bold">{name}</text>"""
_EXPLAINED: Final = (
    "dashed: the link at 0°; arrow: + is the way the angle grows; red: the foot",
    "sign and offset are those of robot.toml; a joint that turns against its arrow needs the other "
    "sign",
)


class _View(NamedTuple):
    """Describes from where legs are seen: which ways of the body go right and up."""

    words: str
    right: tuple[float, float, float]
    up: tuple[float, float, float]


# Legs alone are seen in their own frames, whose x is their zero direction.
_SIDE: Final = _View("from the side: its x to the right, z up", (1.0, 0.0, 0.0), _UP)
_FRONT: Final = _View("from the front: its y to the right, z up", (0.0, 1.0, 0.0), _UP)
_ABOVE: Final = _View("from above: front (x) up, left (y) left", (0.0, -1.0, 0.0), (1.0, 0.0, 0.0))


# A joint, where its link points at 0, rad from the right, and 1 or -1, the way its angle grows.
_Turn = tuple[int, float, int]


def write_picture(robot: Robot, angles: Mapping[str, Sequence[float]], path: Path) -> None:
    """Draw the legs into a file.

    Raises:
        ConfigurationError: no leg can be drawn.
    """
    if all(leg.chain is None for leg in robot.legs):
        raise ConfigurationError(
            "no leg has lengths_m or origins_m, so there is nothing to draw; measure one"
        )
    if not angles:
        raise ConfigurationError(f"no samples came, so there is nothing to draw in {path}")
    write_file(path, draw(robot, angles), advice="give another --picture")
    print_line(f"drew {path}", err=True)


def draw(robot: Robot, angles: Mapping[str, Sequence[float]]) -> str:
    """Draw the picture.

    Args:
        robot: legs without a geometry are left out.
        angles: (J,) rad by leg.

    Returns:
        SVG text.
    """
    legs = [leg for leg in robot.legs if leg.chain is not None and leg.id in angles]
    # With mounts of so many legs given, the robot is drawn as a whole; else each leg from above.
    placed = sum(leg.mount != Mount() for leg in legs) >= 2
    views = (_SIDE, _FRONT) if placed else (_SIDE, _FRONT, _ABOVE)
    tall = _CELL + _LINE * max((len(leg.joints) for leg in legs), default=0)
    body = 2 * _CELL * placed
    width, height = body + max(len(legs), 2) * _CELL, _TOP + len(views) * tall
    parts = [_HEAD.format(width=width, height=height, name=escape(robot.name))]
    for k, line in enumerate(_EXPLAINED):
        parts.append(_text((10, 37 + 16 * k), line, _GREY))
    if placed:
        parts += _panel(legs, angles, _ABOVE, 0, _TOP, body)
    for k, leg in enumerate(legs):
        alone = msgspec.structs.replace(leg, mount=Mount())
        left, below = body + k * _CELL, _TOP + _CELL
        for v, view in enumerate(views):
            parts += _panel([alone], angles, view, left, _TOP + v * tall, _CELL)
        for j, label in enumerate(_labels(leg, angles[leg.id])):
            parts.append(_text((left + 10, below + _LINE * j), label, _colour(j)))
    parts.append("</svg>")
    return "\n".join(parts) + "\n"


def _panel(
    legs: Sequence[Leg],
    angles: Mapping[str, Sequence[float]],
    view: _View,
    left: float,
    top: float,
    size: float,
) -> list[str]:
    """Draw one leg, or the whole robot, into a square."""
    seen = [_flat(leg, angles[leg.id], view) for leg in legs]
    flat = np.concatenate([points for points, _ in seen])
    # Never so large that a leg that stretches looks another one than a leg that stands.
    least_m = 0.5 * max(leg.chain.reach_m for leg in legs if leg.chain is not None)
    scale = (size - 2 * _MARGIN) / max(float(np.ptp(flat, axis=0).max()), least_m)
    centre = np.array([left, top]) + size / 2
    middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
    parts = [_text((left + 10, top + 20), view.words, _GREY)]
    for leg, (points, turns) in zip(legs, seen, strict=True):
        at = centre + scale * (points - middle) * (1.0, -1.0)
        for j, (begin, end) in enumerate(itertools.pairwise(at)):
            solid = 'class="link" stroke-width="6" stroke-linecap="round"'
            parts.append(_line(begin, end, _colour(j), solid))
        for j, zero_rad, way in turns:
            parts += _turning(at[j], at[j + 1], zero_rad, way, _colour(j))
        parts += [_dot(place, _INK) for place in at[:-1]]
        parts += [_dot(at[-1], "#e74c3c"), _text(at[-1] + (8, 14), leg.id, _INK)]
    return parts


def _colour(joint: int) -> str:
    return _COLOURS[joint % len(_COLOURS)]


def _flat(leg: Leg, angles: Sequence[float], view: _View) -> tuple[Array, list[_Turn]]:
    """Compute the places of joints and foot in a view, (J + 1, 2) m, and the turns it shows."""
    assert leg.chain is not None
    body = np.array([view.right, view.up])
    plane = body @ rotation(_UP, leg.mount.yaw_rad)  # in the leg's frame
    points, axes = leg.chain.frames(angles)
    towards = axes @ np.cross(*plane)
    turns: list[_Turn] = []
    for j in np.flatnonzero(np.abs(towards) > _FACING).tolist():
        at_zero = [0.0 if k == j else angle for k, angle in enumerate(angles)]
        places = leg.chain.frames(at_zero)[0] @ plane.T
        beyond = places[j:] - places[j]
        far = np.hypot(*beyond.T) > _LEAST_LINK * leg.chain.reach_m
        if far.any():
            x, y = beyond[int(np.argmax(far))]
            turns.append((j, float(np.arctan2(y, x)), 1 if towards[j] > 0 else -1))
    return points @ plane.T + body @ leg.mount.xyz_m, turns


def _turning(joint: Array, tip: Array, zero_rad: float, way: int, colour: str) -> list[str]:
    """Draw where a joint's link is at 0, and which way its angle grows."""
    # The arrow around a joint: at half of its link, within these, px; it goes so far, rad.
    radius = float(np.clip(np.hypot(*(tip - joint)) / 2, 16.0, 40.0))
    zero = np.array([np.cos(zero_rad), -np.sin(zero_rad)])
    end_rad = zero_rad + way * 0.9
    end = np.array([np.cos(end_rad), -np.sin(end_rad)])
    (x0, y0), (x1, y1) = joint + radius * zero, joint + radius * end
    return [
        _line(joint, joint + (radius + 22) * zero, colour, 'stroke-dasharray="4 3"'),
        f'<path d="M {x0:.1f} {y0:.1f} A {radius:.1f} {radius:.1f} 0 0 {int(way < 0)} '
        f'{x1:.1f} {y1:.1f}" fill="none" stroke="{colour}" marker-end="url(#head)"/>',
        _text(joint + (radius + 13) * end + (-4, 4), "+", colour),
    ]


def _line(start: Array, end: Array, colour: str, style: str) -> str:
    (x0, y0), (x1, y1) = start, end
    return (
        f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}" {style}/>'
    )


def _dot(place: Array, colour: str) -> str:
    x, y = place
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>'


def _text(place: tuple[float, float] | Array, words: str, colour: str) -> str:
    x, y = place
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}">{escape(words)}</text>'


def _labels(leg: Leg, angles: Sequence[float]) -> Iterator[str]:
    """Format each joint's name, angle and link, and its sign and offset of robot.toml."""
    assert leg.chain is not None
    turned = leg.angles or leg.servos or Angles()
    signs = turned.directions or (1,) * len(leg.joints)
    offsets = turned.offsets_rad or (0.0,) * len(leg.joints)
    for j, (name, angle_rad) in enumerate(zip(leg.joints, angles, strict=True)):
        length_m = np.hypot.reduce(leg.chain.origins_m[j])
        yield (
            f"{name} {np.degrees(angle_rad):+.1f}°, link {1000 * length_m:.0f} mm, sign "
            f"{signs[j]:+d}, offset {offsets[j]:+.2f} rad"
        )
