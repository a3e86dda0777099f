"""A URDF of a robot of four legs."""

from __future__ import annotations

SIDES = {"fl": (0.2, 0.05), "fr": (0.2, -0.05), "hl": (-0.2, 0.05), "hr": (-0.2, -0.05)}


def quadruped(end: str = "_foot") -> str:
    """Twelve joints: hips roll, knees bend backwards with plus, as in most URDFs.

    Args:
        end: what the names of the feet end with; capital letters make all of them so.
    """
    parts, limit = ['<link name="base"/>'], '<limit lower="-3" upper="2" effort="9" velocity="9"/>'
    for leg, (x, y) in SIDES.items():
        foot = f"{leg}{end}".upper() if end.isupper() else f"{leg}{end}"
        for name, kind, parent, child, xyz, axis in (
            ("roll", "revolute", "base", f"{leg}_hip", f"{x} {y} 0", "1 0 0"),
            (
                "hip",
                "revolute",
                f"{leg}_hip",
                f"{leg}_thigh",
                f"0 {0.08 if y > 0 else -0.08} 0",
                "0 1 0",
            ),
            ("knee", "revolute", f"{leg}_thigh", f"{leg}_shank", "0 0 -0.16", "0 1 0"),
            ("tip", "fixed", f"{leg}_shank", foot, "0 0 -0.16", "0 0 1"),
        ):
            parts.append(
                f'<link name="{child}"/><joint name="{leg}_{name}" type="{kind}">'
                f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
                f'<axis xyz="{axis}"/>{limit}</joint>'
            )
    return f'<robot name="walker">{"".join(parts)}</robot>'
