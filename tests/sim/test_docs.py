"""docs/simulator.md says what the code does."""

from __future__ import annotations

import math
import re
from pathlib import Path

from adaptive_contact_sim.drift import KINDS
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.pose import WORKSPACES, PoseSettings
from adaptive_contact_sim.scenario import parse_scenario
from adaptive_contact_sim.scene import build
from adaptive_contact_sim.servo import QUANTUM_RAD, ServoParameters
from adaptive_contact_sim.terrain import Terrain, TerrainSettings
from adaptive_contact_sim.walk import WalkSettings

TEXT = (Path(__file__).parents[2] / "docs/simulator.md").read_text(encoding="utf-8")
FLOWING = " ".join(TEXT.split())


def row(start: str) -> list[str]:
    (line,) = (line for line in TEXT.splitlines() if line.startswith(f"| {start}"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_kinds_of_drift() -> None:
    for name, kind in KINDS.items():
        _, unit, nominal, accepted, _ = row(f"`{name}`")
        low, high = accepted.replace("−", "-").rsplit("–", 1)
        assert unit == kind.unit
        assert float(nominal) == kind.nominal
        assert (float(low), float(high)) == (kind.low, kind.high)


def test_servo_constants() -> None:
    nominal = ServoParameters()
    assert f"{math.degrees(QUANTUM_RAD):.4f}°" in row("step")[1]
    for start, values in {
        "stall torque": (nominal.stall_torque_nm[0], nominal.no_load_speed_rad_s[0]),
        "Coulomb": (nominal.coulomb_nm[0],),
        "added at rest": (nominal.stribeck_nm[0], nominal.stribeck_speed_rad_s[0]),
        "load-dependent": (nominal.load_friction[0],),
        "viscous": (nominal.viscous_nms[0],),
        "armature": (nominal.armature_kgm2[0],),
    }.items():
        for value in values:
            assert f"{value:g}" in row(start)[1]


def test_links_of_the_model() -> None:
    model = build(Terrain(TerrainSettings(kind="flat", seed=0)))
    for leg in LEGS:
        for link in ("coxa", "femur", "tibia"):
            cell = row(f"{link} link")[1].replace("−", "-")
            body = model.body(f"{leg}_{link}")
            assert f"{body.mass[0]:g} kg" in cell
            numbers = [float(x) for x in re.findall(r"-?\d+\.?\d*", cell.split("diag")[0])]
            assert numbers[1:] == [round(x, 6) for x in body.ipos.tolist()]
            scale = 1e-4 if link == "tibia" else 1e-5
            diagonal = re.search(r"diag\(([^)]*)\)", cell)
            assert diagonal is not None
            expected = [float(x) * scale for x in diagonal[1].split(",")]
            assert all(
                math.isclose(a, b, rel_tol=1e-6)
                for a, b in zip(body.inertia.tolist(), expected, strict=True)
            )


def test_motion_defaults() -> None:
    walk, pose = WalkSettings(), PoseSettings()
    assert f"swing {walk.swing_s:g} s" in FLOWING
    assert f"stride {walk.stride_m * 100:g} cm" in FLOWING
    assert f"{pose.segment_ticks} ticks up" in FLOWING
    lower, upper = WORKSPACES["paper"]
    for space in (lower, upper):
        low, high = (f"{h:g}".replace("-", "−") for h in space.height_m)
        assert f"{low}..{high}" in FLOWING


def test_the_scenario_in_it_can_be_run() -> None:
    blocks = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    assert len(blocks) == 1
    assert parse_scenario(blocks[0], name="doc").settings.drift[0].at_s == 60.0


def test_the_python_in_it_runs() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    names: dict[str, object] = {}
    exec(block.replace("seconds=300", "seconds=3"), names)
    assert names["leg"].measured.shape == (150, 3)  # type: ignore[attr-defined]
