"""The wheel in an environment of its own, and in an empty folder."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.e2e

OURS = (
    "adaptive_contact",
    "adaptive_contact_bullet",
    "adaptive_contact_models",
    "adaptive_contact_sim",
    "adaptive_contact_studies",
)


def test_it_installs_our_packages_and_nothing_else(
    built: Path, installed: Any, tmp_path: Path
) -> None:
    (wheel,) = built.glob("*.whl")
    tops = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == set(OURS)
    static = "adaptive_contact/web/static"
    page = {path.name for path in (installed.site / static).iterdir()}
    assert page == {path.name for path in (Path(__file__).parents[2] / static).iterdir()}
    assert "uPlot.LICENSE" in page
    found = {path.name for path in installed.site.iterdir() if path.is_dir()}
    assert {name for name in found if not name.endswith(".dist-info")} == set(OURS)
    assert (installed.site.parents[2] / "bin" / "adaptive-contact").is_file()
    names = ", ".join(OURS)
    code = f"import {names}; print(*(one.__file__ for one in ({names})))"
    paths = installed.run("-c", code, cwd=tmp_path).stdout.split()
    assert [Path(path).is_relative_to(installed.site) for path in paths] == [True] * len(OURS)


@pytest.fixture(scope="module")
def recording(installed: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    walk = ["sim", "walk", "--seconds", "10", "--offline", "--record", "walk.mcap"]
    done = installed.run("-m", "adaptive_contact", *walk, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "walk.mcap"


def test_without_extras_the_core_works(bare: Any, tmp_path: Path, recording: Path) -> None:
    code = (
        "import importlib.util as u, adaptive_contact; "
        "print([m for m in ('mujoco', 'dynamixel_sdk', 'matplotlib', 'PIL') if u.find_spec(m)], "
        "adaptive_contact.ContactLearner.__name__)"
    )
    assert bare.run("-c", code, cwd=tmp_path).stdout.strip() == "[] ContactLearner"
    for args in (["--help"], ["sim", "--help"], ["demo", "--help"], ["serve", "--help"]):
        assert bare.run("-m", "adaptive_contact", *args, cwd=tmp_path).returncode == 0
    replay = ["replay", str(recording), "--events", "walk.jsonl"]
    done = bare.run("-m", "adaptive_contact", *replay, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "walk.jsonl").stat().st_size > 1000


@pytest.mark.parametrize(
    ("line", "extra"),
    [
        ("sim list", "sim"),
        ("sim walk --offline --seconds 1", "sim"),
        ("sim inject friction --value 4", "sim"),
        ("demo --seconds 10", "sim"),
        ("sim walk --offline --seconds 1 --render walk.gif", "plot"),
    ],
)
def test_without_an_extra_a_command_says_which(
    bare: Any, without_plot: Any, tmp_path: Path, line: str, extra: str
) -> None:
    environment = {"sim": bare, "plot": without_plot}[extra]
    done = environment.run("-m", "adaptive_contact", *line.split(), cwd=tmp_path)
    assert done.returncode == 2
    (said,) = done.stderr.strip().splitlines()
    assert f".whl[{extra}]'" in said
    assert list(tmp_path.iterdir()) == []
