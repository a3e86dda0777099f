"""Draws the robot from above and every leg from the side, as an SVG.

Beside each joint: a dashed line where its zero is, and an arrow the way its angle grows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.checks.conventions.feet import on_body
from adaptive_contact.cli._output import say
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import write_file
from adaptive_contact.robot import Leg, Mount, Robot

_CELL: Final = 300
_TOP: Final = 62
_MARGIN: Final = 40
_HEADING: Final = 80
_LINE: Final = 15
_COLOURS: Final = ("#1f6fb4", "#c8691b", "#3b8a3f", "#8a3b86", "#a33c3c", "#5d6d7e")
_GREY, _PALE, _INK = "#7f8c8d", "#d5d8dc", "#2c3e50"
_HEAD_PX: Final = 6
# A joint's turn is drawn where its axis points this much towards the eye, and from a link that is
# no shorter than this share of the leg.
_FACING: Final = 0.5
_LEAST_LINK: Final = 0.05

# A joint, where its link points at 0, rad from the right, and 1 or -1, the way its angle grows.
_Turn = tuple[int, float, int]


class _View(NamedTuple):
    """Describes from where legs are seen: which ways of the body go right and up."""

    words: str
    ways: str
    right: tuple[float, float, float]
    up: tuple[float, float, float]


_SIDE: Final = _View("from the side", "x to the right, z up", (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
_FRONT: Final = _View("from the front", "y to the right, z up", (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_ABOVE: Final = _View("from above", "x to the right, y up", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
_ROBOT: Final = _View("", "", (0.0, -1.0, 0.0), (1.0, 0.0, 0.0))


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
    say(f"drew {path}", err=True)


def draw(robot: Robot, angles: Mapping[str, Sequence[float]]) -> str:
    """Draw the picture.

    Args:
        robot: legs without a geometry are left out.
        angles: (J,) rad by leg.

    Returns:
        SVG text.
    """
    legs = [leg for leg in robot.legs if leg.chain is not None and leg.id in angles]
    # With mounts of so many legs given, the robot is drawn as a whole.
    placed = sum(leg.mount != Mount() for leg in legs) >= 2
    views = [(leg, view) for leg in legs for view in _views(leg, angles[leg.id], placed=placed)]
    rows = 2 if placed else -(-len(views) // 4)
    columns, body = -(-len(views) // max(rows, 1)), rows * _CELL * placed
    width, height = max(body + columns * _CELL, 2 * _CELL), _TOP + rows * _CELL
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        f'<text x="10" y="19" font-size="15" font-weight="bold">{escape(robot.name)}</text>',
        _text(
            10,
            37,
            "dashed: the link at 0°; arrow: + is the way the angle grows; red: the foot",
            _GREY,
        ),
        _text(
            10,
            53,
            "sign and offset are those of robot.toml; a joint that turns against its arrow needs "
            "the other sign",
            _GREY,
        ),
    ]
    if placed:
        parts += _panel(legs, angles, 0, body, _ROBOT)
    for k, (leg, view) in enumerate(views):
        parts += _panel(
            [leg], angles, body + (k % columns) * _CELL, _CELL, view, _TOP + k // columns * _CELL
        )
    parts.append("</svg>")
    return "\n".join(parts) + "\n"


def _views(leg: Leg, angles: Sequence[float], *, placed: bool) -> list[_View]:
    assert leg.chain is not None
    yaws = leg.chain.is_straight or leg.chain.vectors[0, 2] ** 2 > _FACING**2
    beside = [_own_plane(leg, angles)] if yaws else [_SIDE, _FRONT]
    # Without mounts the legs' places are unknown: each is drawn from above by itself.
    return beside if placed else [*beside, _ABOVE]


def _own_plane(leg: Leg, angles: Sequence[float]) -> _View:
    """Return the upright plane of a leg that yaws; the body is on the left."""
    assert leg.chain is not None
    points = on_body(leg, leg.chain.frames(angles)[0])
    far = _LEAST_LINK * float(np.ptp(points, axis=0).max())
    ways = [points[-1] - points[0], points[0], np.array([1.0, 0.0, 0.0])]
    if leg.chain.is_straight:  # whose foot may be on the side of the body
        ahead = np.cross([0.0, 0.0, 1.0], leg.chain.frames(angles)[1][-1])
        ways.insert(0, on_body(leg, ahead) - on_body(leg, np.zeros(3)))
    away = next(way for way in ways if np.hypot(*way[:2]) > far)
    x, y = away[:2] / np.hypot(*away[:2])
    return _View(_SIDE.words, "outwards to the right, z up", (x, y, 0.0), _SIDE.up)


def _panel(
    legs: Sequence[Leg],
    angles: Mapping[str, Sequence[float]],
    left: float,
    size: float,
    view: _View,
    top: float = _TOP,
) -> list[str]:
    """Draw one leg, or the whole robot from above, into a square."""
    seen = [_flat(leg, angles[leg.id], view) for leg in legs]
    flat = np.concatenate([points for points, _ in seen])
    whole, lines = view is _ROBOT, 0 if view is _ROBOT else len(legs[0].joints)
    # Room for arrows all around, the heading above, and the joints' lines below.
    room = size - 2 * _MARGIN, size - _HEADING - _MARGIN - _LINE * lines
    # Never so large that a leg that stretches looks another one than a leg that stands.
    least_m = 0.5 * max(leg.chain.reach_m for leg in legs if leg.chain is not None)
    scale = float((np.array(room) / np.maximum(np.ptp(flat, axis=0), least_m)).min())
    centre = np.array([left + size / 2, top + _HEADING + room[1] / 2])
    middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
    parts = [
        f'<rect x="{left + 3:.1f}" y="{top + 3:.1f}" width="{size - 6:.1f}" '
        f'height="{size - 6:.1f}" fill="none" stroke="{_PALE}"/>'
    ]
    on_page = [centre + scale * (points - middle) * (1.0, -1.0) for points, _ in seen]
    if whole:
        order = np.argsort([np.arctan2(leg.mount.xyz_m[1], leg.mount.xyz_m[0]) for leg in legs])
        hull = " ".join(f"{on_page[k][0][0]:.1f},{on_page[k][0][1]:.1f}" for k in order)
        x, y = size / 2, top + 22
        parts += [
            f'<polygon points="{hull}" fill="#f4f6f7" stroke="{_PALE}" stroke-width="2"/>',
            f'<line x1="{x:.1f}" y1="{y + 40:.1f}" x2="{x:.1f}" y2="{y:.1f}" stroke="{_INK}" '
            f'stroke-width="2"/>' + _head(x, y, np.pi / 2, _INK),
            _text(x + 8, y + 12, "front (x)", _INK, bold=True),
            _text(12, top + size / 2, "left (y)", _GREY),
            _text(size - 12, top + size / 2, "right", _GREY, anchor="end"),
        ]
    else:
        parts += [
            _text(left + 10, top + 20, legs[0].id, _INK, bold=True),
            _text(left + 10, top + 36, view.words, _GREY),
            _text(left + 10, top + 51, view.ways, _GREY),
        ]
    for leg, at, (_, turns) in zip(legs, on_page, seen, strict=True):
        for j in range(len(leg.joints)):
            parts.append(_link(at[j], at[j + 1], _COLOURS[j % len(_COLOURS)]))
        for j, zero_rad, way in turns:
            parts += _turning(at[j], at[j + 1], zero_rad, _COLOURS[j % len(_COLOURS)], way)
        parts += _ends(at)
        if whole:
            out = at[-1] - at[0]
            x, y = at[-1] + 16 * out / max(float(np.hypot(*out)), 1.0)
            parts.append(_text(x, y + 4, leg.id, _INK, bold=True, anchor="middle"))
    if view.words == _SIDE.words:
        for j in range(lines):
            label = _label(legs[0], j, angles[legs[0].id][j])
            y = top + size - 12 - _LINE * (lines - 1 - j)
            parts.append(_text(left + 10, y, label, _COLOURS[j % len(_COLOURS)]))
    return parts


def _flat(leg: Leg, angles: Sequence[float], view: _View) -> tuple[Array, list[_Turn]]:
    assert leg.chain is not None
    plane = np.array([view.right, view.up])

    def seen(vectors: Array) -> Array:
        return np.asarray((on_body(leg, vectors) - on_body(leg, np.zeros(3))) @ plane.T)

    points, axes = leg.chain.frames(angles)
    facing = np.cross(view.right, view.up)
    towards = (on_body(leg, axes) - on_body(leg, np.zeros(3))) @ facing
    turns: list[_Turn] = []
    for j in np.flatnonzero(np.abs(towards) > _FACING).tolist():
        at_zero = [0.0 if k == j else angle for k, angle in enumerate(angles)]
        beyond = seen(leg.chain.frames(at_zero)[0])[j:]
        far = np.hypot(*(beyond - beyond[0]).T) > _LEAST_LINK * leg.chain.reach_m
        if far.any():
            x, y = (beyond - beyond[0])[int(np.argmax(far))]
            turns.append((j, float(np.arctan2(y, x)), 1 if towards[j] > 0 else -1))
    return np.asarray(on_body(leg, points) @ plane.T), turns


def _turning(
    joint: tuple[float, float], tip: tuple[float, float], zero_rad: float, colour: str, way: int = 1
) -> list[str]:
    """Draw where a joint's link is at 0, and which way its angle grows."""
    x, y = joint
    length = float(np.hypot(tip[0] - x, tip[1] - y))
    # The arrow around a joint: at half of its link, within these, px; it goes so far, rad.
    radius = float(np.clip(length / 2, 16.0, 40.0))
    end = zero_rad + way * 0.9
    x0, y0 = x + radius * np.cos(zero_rad), y - radius * np.sin(zero_rad)
    x1, y1 = x + radius * np.cos(end), y - radius * np.sin(end)
    far = 62.0 if length > 62.0 else radius + _HEAD_PX
    ahead = end + way * np.pi / 2
    return [
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + far * np.cos(zero_rad):.1f}" '
        f'y2="{y - far * np.sin(zero_rad):.1f}" stroke="{colour}" stroke-width="1.2" '
        'stroke-dasharray="4 3"/>',
        f'<path d="M {x0:.1f} {y0:.1f} A {radius:.1f} {radius:.1f} 0 0 {int(way < 0)} '
        f'{x1:.1f} {y1:.1f}" fill="none" stroke="{colour}" stroke-width="1.6"/>',
        _head(x1, y1, float(ahead), colour),
        _text(
            x + (radius + 13) * np.cos(end),
            y - (radius + 13) * np.sin(end) + 4,
            "+",
            colour,
            bold=True,
            anchor="middle",
        ),
    ]


def _head(x: float, y: float, way_rad: float, colour: str) -> str:
    """Draw an arrow's head with its tip a little ahead of a point."""
    corners = [
        (x + _HEAD_PX * np.cos(way_rad + turn), y - _HEAD_PX * np.sin(way_rad + turn))
        for turn in (0.0, 2.4, -2.4)
    ]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in corners)
    return f'<polygon points="{points}" fill="{colour}"/>'


def _link(start: tuple[float, float], end: tuple[float, float], colour: str) -> str:
    return (
        f'<line x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}" '
        f'class="link" stroke="{colour}" stroke-width="6" stroke-linecap="round"/>'
    )


def _ends(points: Sequence[tuple[float, float]]) -> list[str]:
    joints = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{_INK}"/>' for x, y in points[:-1]]
    x, y = points[-1]
    return [*joints, f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="#e74c3c"/>']


def _text(
    x: float, y: float, words: str, colour: str, *, bold: bool = False, anchor: str = "start"
) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="{anchor}"{weight}>'
        f"{escape(words)}</text>"
    )


def _label(leg: Leg, joint: int, angle_rad: float) -> str:
    """Format a joint's name, angle and link, and its sign and offset of robot.toml."""
    assert leg.chain is not None
    length_m = np.hypot.reduce(leg.chain.origins_m[joint])
    text = f"{leg.joints[joint]} {np.degrees(angle_rad):+.1f}°, link {1000 * length_m:.0f} mm"
    turned = leg.angles or leg.servos
    if turned is not None:
        sign = 1 if turned.directions is None else turned.directions[joint]
        offset = 0.0 if turned.offsets_rad is None else turned.offsets_rad[joint]
        text += f", sign {sign:+d}, offset {offset:+.2f} rad"
    return text
