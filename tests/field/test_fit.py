"""`fit` refuses what is no model of a leg, and ends with how good a model is."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import adaptive_contact_models

from . import mistakes as m

SHIPPED = Path(adaptive_contact_models.__file__).parent / "hexapod" / "robot.toml"


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    full = [sys.executable, "-m", "adaptive_contact", *map(str, arguments)]
    return subprocess.run(full, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("walk") / "walk.mcap"
    done = run("sim", "walk", "--seconds", "90", "--seed", "4", "--offline", "--record", path)
    assert done.returncode == 0, done.stderr
    return path


def test_a_good_fit_says_so_leg_by_leg(walk: Path, tmp_path: Path) -> None:
    done = run("fit", walk, "-o", tmp_path / "legs.json")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "legs.json").exists()
    assert "(rad)" not in done.stdout, "equations are printed on request"
    last = done.stdout.splitlines()[-6:]
    assert [line.split(":")[0] for line in last] == [
        f"leg {leg}" for leg in ("lf", "lm", "lr", "rf", "rm", "rr")
    ]
    assert all("x the noise of its readings" in line or "too little" in line for line in last)


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (m.echoed(1), "measured is made of commands"),
        (m.never_stance, "no leg swings for seconds"),
    ],
    ids=["copies", "swing without end"],
)
def test_what_is_no_model_is_not_written(
    walk: Path, tmp_path: Path, mistake: m.Mistake, words: str
) -> None:
    made = m.write(tmp_path / "made.mcap", list(mistake(m.read(walk), np.random.default_rng(1))))
    done = run("fit", made, "-o", tmp_path / "legs.json")
    assert done.returncode == 1, done.stdout
    assert not (tmp_path / "legs.json").exists()
    assert sum(words in line for line in done.stderr.splitlines()) == 1
    assert "no baseline was written" in done.stderr.splitlines()[-1]


def test_a_recording_of_other_legs_is_named(walk: Path, tmp_path: Path) -> None:
    renamed = m.renamed({"lf": "LF"})
    made = m.write(tmp_path / "made.mcap", list(renamed(m.read(walk), np.random.default_rng(1))))
    done = run("fit", made, "-o", tmp_path / "legs.json")
    assert "no --config: taken for the shipped robot 'hexapod-ax12a'" in done.stderr
    assert "not used: leg LF, which robot 'hexapod-ax12a' lacks; it has leg lf" in done.stderr


def test_steps_that_hide_a_touch_are_refused(walk: Path, tmp_path: Path) -> None:
    config = tmp_path / "robot.toml"
    made = SHIPPED.read_text().replace("quantum_rad = 0.005118", "quantum_rad = 0.03")
    config.write_text(made)
    done = run("fit", walk, "--config", config, "-o", tmp_path / "legs.json")
    assert done.returncode == 1, done.stdout
    assert "quantum_rad of lf, lm, lr, rf, rm, rr is over 0.02 rad" in done.stderr
    assert not (tmp_path / "legs.json").exists()
