"""Recordings of real servos: both formats, and files that are none."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive_contact.errors import RecordingError
from adaptive_contact_studies.paper.log_files import load_logs
from adaptive_contact_studies.paper.logs import run_logs
from adaptive_contact_studies.paper.report import markdown
from adaptive_contact_studies.paper.run import plain

REAL = Path(__file__).resolve().parents[4] / "shared" / "data"


def tables_of(tree: dict[str, Any]) -> list[str]:
    """The tables of its page."""
    blocks = markdown("logs.md", data=plain(tree)).split("\n\n")
    return [block for block in blocks if block.startswith("|")]


def servo(rng: np.random.Generator, n: int, joints: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A servo with a saturating law: speed limited to 0.08 rad a tick."""
    t = np.arange(n) * 0.02
    frequency = rng.uniform(0.2, 1.2, joints)
    goal = rng.uniform(0.3, 1.0, joints) * np.sin(2 * np.pi * frequency * t[:, None])
    position = np.zeros((n, joints))
    for k in range(n - 1):
        error = np.clip((goal[k] - position[k]) / 0.16, -1.0, 1.0)
        position[k + 1] = position[k] + 0.08 * error
    quantum = 0.0015
    noise = rng.normal(scale=quantum / 2, size=position.shape)
    return goal, np.round((position + noise) / quantum) * quantum


def write_arm(path: Path, motions: int = 6, n: int = 900) -> None:
    rng = np.random.default_rng(1)
    arrays = {}
    for i in range(motions):
        goal, position = servo(rng, n)
        arrays |= {
            f"m{i}/t": np.arange(n) * 0.02006,
            f"m{i}/goal": goal,
            f"m{i}/pos": position,
        }
    np.savez(path, **arrays)


def write_pendulum(path: Path, gain: int, seed: int, torque: bool = True) -> None:
    rng = np.random.default_rng(seed)
    goal, position = servo(rng, 350, joints=1)
    fine = np.cumsum(rng.uniform(0.0051, 0.0055, size=1280))
    grid = np.arange(350) * 0.02
    entries = [
        {
            "timestamp": float(t),
            "goal_position": float(goal[min(int(t / 0.02), 349), 0]),
            "position": float(np.interp(t, grid, position[:, 0])) + 2 * np.pi * (t > 3.0),
            "torque_enable": torque or bool(t < 5.0),
        }
        for t in fine
    ]
    path.write_text(json.dumps({"kp": gain, "trajectory": f"t{seed}", "entries": entries}))


def test_both_formats_are_fitted_and_tabled(tmp_path: Path) -> None:
    write_arm(tmp_path / "arm.npz", n=5600)
    for gain in (100, 200):
        for run in range(3):
            write_pendulum(tmp_path / f"p{gain}{run}.json", gain, run, torque=run > 0)
    tree = run_logs(tmp_path)
    arm = tree["arms"][0]
    assert arm["joints"] == 2
    for protocol in ("unseen motions", "unseen moments"):
        rms = {name: np.mean(v) for name, v in arm[protocol]["rms_deg"].items()}
        assert rms["servo"] < 0.75 * rms["linear"]
        assert rms["servo"] < 0.2 * np.mean(arm["naive_deg"])
        assert arm[protocol]["false_alarms"]["ticks"] > 4000
    pendulum = tree["pendulum"]
    assert pendulum["gains"] == ["100", "200"]
    servo_law = pendulum["rms_deg"]["servo"]
    assert set(servo_law["100"]) == set(servo_law) == {"100", "200"}
    assert all(isinstance(error, float) for error in servo_law["100"].values())
    # Turns are unwrapped: no reading leaps by a turn.
    assert max(pendulum["naive_deg"].values()) < 6.0
    assert any("without torque" in row["reason"] for row in tree["skipped"])
    tables = tables_of(tree)
    assert len(tables) == 3
    assert all(len({line.count("|") for line in table.splitlines()}) == 1 for table in tables)


def test_bad_files_are_told_and_the_rest_is_used(tmp_path: Path) -> None:
    write_arm(tmp_path / "arm.npz", motions=2, n=200)
    (tmp_path / "text.json").write_text("{")
    (tmp_path / "list.json").write_text("[1, 2]")
    (tmp_path / "empty.json").write_text('{"entries": []}')
    (tmp_path / "lacks.json").write_text('{"entries": [{"position": 1}]}')
    (tmp_path / "rows.json").write_text('{"kp": 1, "entries": [1, 2]}')
    (tmp_path / "huge.json").write_text(
        '{"kp": 1, "entries": [{"timestamp": 1%s, "position": 0, "goal_position": 0}]}'
        % ("0" * 400)
    )
    (tmp_path / "gain.json").write_text('{"entries": [{"timestamp": 0}]}')
    (tmp_path / "millis.json").write_text(
        json.dumps(
            {
                "kp": 1,
                "entries": [
                    {"timestamp": 20.0 * i, "position": 0.0, "goal_position": 0.0}
                    for i in range(300)
                ],
            }
        )
    )
    (tmp_path / "noise.npz").write_bytes(b"\x00" * 100)
    write_arm(tmp_path / "cut.npz", motions=1, n=200)
    damaged = bytearray((tmp_path / "cut.npz").read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    (tmp_path / "cut.npz").write_bytes(bytes(damaged))
    np.savez(
        tmp_path / "column.npz",
        **{"m/t": np.zeros((9, 1)), "m/goal": np.zeros((9, 2)), "m/pos": np.zeros((9, 2))},
    )
    np.savez(
        tmp_path / "unread.npz",
        **{"m/t": np.arange(99.0), "m/goal": np.zeros((99, 2)), "m/pos": np.full((99, 2), np.nan)},
    )
    np.savez(tmp_path / "keys.npz", a=np.zeros(3))
    np.savez(
        tmp_path / "shapes.npz",
        **{"m/t": np.arange(9.0), "m/goal": np.zeros((9, 2)), "m/pos": np.zeros((9, 3))},
    )
    bad = np.zeros((200, 2))
    bad[3] = np.nan
    t = np.arange(200) * 0.02
    t[50] = t[49]
    np.savez(tmp_path / "nan.npz", **{"m/t": t, "m/goal": np.zeros((200, 2)), "m/pos": bad})
    logs = load_logs(tmp_path)
    assert len(logs.recordings) == 3
    told = {name for name, _ in logs.skipped}
    assert told == {
        "text.json", "list.json", "empty.json", "lacks.json", "noise.npz", "keys.npz",
        "shapes.npz", "nan.npz", "rows.json", "huge.json", "gain.json", "millis.json", "cut.npz",
        "column.npz", "unread.npz",
    }  # fmt: skip
    # One line each, however many stretches.
    assert all("\n" not in reason and len(reason) < 300 for _, reason in logs.skipped)
    assert sum(name == "millis.json" for name, _ in logs.skipped) == 1
    tree = run_logs(tmp_path)
    assert tree["recordings"] == 3
    assert "expected at least" in tree["arms"][0]["unseen motions"]["status"]


def test_a_file_of_no_use_ends_the_command_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text('{"kp": 1, "entries": [1]}')
    with pytest.raises(RecordingError, match=r"a\.json: no recording that can be used") as told:
        run_logs(file)
    assert "\n" not in str(told.value)


@pytest.mark.skipif(
    not (REAL / "xl330").is_dir(),
    reason="no ../shared/data/xl330: recordings of github.com/Rhoban/bam, not part of the project",
)
def test_the_real_pendulum_prefers_a_refit_of_its_own_gain() -> None:
    tree = run_logs(REAL / "xl330")
    pendulum = tree["pendulum"]
    rms = pendulum["rms_deg"]["servo"]
    for gain in ("100", "200"):
        assert rms[gain][gain] < 0.2 * pendulum["naive_deg"][gain]
    assert rms["100"]["800"] > 2.0 * rms["800"]["800"]


def test_a_recording_that_unpacks_to_gigabytes_is_not_unpacked(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "bomb.npz", **{"m/t": np.zeros(9 << 20)})
    tracemalloc.start()
    with pytest.raises(RecordingError, match="unpacks to more than 64 MB"):
        load_logs(tmp_path / "bomb.npz")
    assert tracemalloc.get_traced_memory()[1] < 32 << 20
    tracemalloc.stop()
