"""Every leg from the side and from above, as the description and the servos say, in an SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.robot import Leg, Robot, foot

__all__ = ["chain", "draw"]

Array = NDArray[np.float64]

_CELL: Final = 260
_MARGIN: Final = 26
_COLOURS: Final = ("#1f6fb4", "#c8691b", "#3b8a3f", "#8a3b86", "#a33c3c", "#5d6d7e")


def chain(leg: Leg, angles: Sequence[float]) -> Array:
    """Joints and foot of a leg in its own frame.

    Args:
        leg: with ``lengths_m``.
        angles: (J,) rad.

    Returns:
        (J + 1, 3) m, from the body outwards.
    """
    assert leg.lengths_m is not None
    points = [np.zeros(3)]
    for j in range(1, len(leg.joints) + 1):
        points.append(foot(list(angles[:j]), leg.lengths_m[:j], leg.joint_axes[:j]))
    return np.stack(points)


def draw(robot: Robot, angles: Mapping[str, Sequence[float]]) -> str:
    """The picture.

    Args:
        robot: legs without ``lengths_m`` are left out.
        angles: (J,) rad by leg.

    Returns:
        SVG text.
    """
    legs = [leg for leg in robot.legs if leg.lengths_m is not None and leg.id in angles]
    width, height = max(len(legs), 1) * _CELL, 2 * _CELL + 40
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        f'<text x="8" y="18" font-size="14">{escape(robot.name)}: legs from the side (above) and '
        "from above (below), body on the left, foot red</text>",
    ]
    for i, leg in enumerate(legs):
        points = chain(leg, angles[leg.id])
        reach = np.hypot(points[:, 0], points[:, 1]) * np.sign(points[:, 0] + 1e-9)
        side = np.stack([reach, points[:, 2]], axis=1)
        above = points[:, :2]
        assert leg.lengths_m is not None
        scale = (_CELL - 2 * _MARGIN) / (2 * sum(leg.lengths_m))
        for row, flat in ((0, side), (1, above)):
            parts += _panel(leg, flat, angles[leg.id], i * _CELL, 30 + row * _CELL, scale, row == 0)
    parts.append("</svg>")
    return "\n".join(parts) + "\n"


def _panel(
    leg: Leg,
    flat: Array,
    angles: Sequence[float],
    left: float,
    top: float,
    scale: float,
    named: bool,
) -> list[str]:
    middle = _CELL / 2
    x = left + middle + scale * flat[:, 0]
    y = top + middle - scale * flat[:, 1]
    parts = [
        f'<rect x="{left + 3}" y="{top + 3}" width="{_CELL - 6}" height="{_CELL - 6}" '
        'fill="none" stroke="#d5d8dc"/>',
        f'<line x1="{left + 6}" y1="{top + middle}" x2="{left + _CELL - 6}" y2="{top + middle}" '
        'stroke="#eaecee"/>',
    ]
    if named:
        parts.append(f'<text x="{left + 10}" y="{top + 20}" font-weight="bold">{leg.id}</text>')
    for j in range(len(leg.joints)):
        colour = _COLOURS[j % len(_COLOURS)]
        parts.append(
            f'<line x1="{x[j]:.1f}" y1="{y[j]:.1f}" x2="{x[j + 1]:.1f}" y2="{y[j + 1]:.1f}" '
            f'stroke="{colour}" stroke-width="6" stroke-linecap="round"/>'
        )
        if named:
            parts.append(
                f'<text x="{left + 10}" y="{top + _CELL - 12 - 14 * (len(leg.joints) - 1 - j)}" '
                f'fill="{colour}">{escape(_label(leg, j, angles[j]))}</text>'
            )
    parts += [
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="4" fill="#2c3e50"/>'
        for a, b in zip(x[:-1], y[:-1], strict=True)
    ]
    parts.append(f'<circle cx="{x[-1]:.1f}" cy="{y[-1]:.1f}" r="5" fill="#e74c3c"/>')
    return parts


def _label(leg: Leg, joint: int, angle_rad: float) -> str:
    """A joint's name, angle, length, and how its servo is mounted."""
    assert leg.lengths_m is not None
    told = (
        f"{leg.joints[joint]} {np.degrees(angle_rad):+.1f}°, {1000 * leg.lengths_m[joint]:.0f} mm"
    )
    servos = leg.servos
    if servos is not None:
        sign = 1 if servos.directions is None else servos.directions[joint]
        offset = 0.0 if servos.offsets_rad is None else servos.offsets_rad[joint]
        told += f", sign {sign:+d}, offset {np.degrees(offset):.0f}°"
    return told
