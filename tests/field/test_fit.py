"""`fit` refuses what is no model of a leg, and ends with how good a model is."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from adaptive_contact.cli._verdict import unusable
from adaptive_contact.cli.fit import check_conventions, gather
from adaptive_contact.errors import AdaptiveContactError, ConfigurationError, RecordingError
from adaptive_contact.fit.train import Training, learn
from adaptive_contact.model import shipped_baseline
from adaptive_contact.model.tail import Tail
from adaptive_contact.robot import shipped_robot
from adaptive_contact.robot.write import write_robot

from . import mistakes as m


def test_inputs_are_read_once_and_not_written_over(
    ours: Any, walk_file: Path, tmp_path: Path
) -> None:
    config, link = tmp_path / "robot.toml", tmp_path / "again.mcap"
    config.write_text(write_robot(shipped_robot()))
    link.symlink_to(walk_file)
    before = config.read_bytes(), walk_file.read_bytes()
    for out in (config, walk_file):
        done = ours("fit", walk_file, "--config", config, "-o", out)
        assert (done.code, "what the command reads" in done.err) == (2, True), done.err
    done = ours("fit", walk_file, link, "-o", tmp_path / "b.json")
    assert done.code == 2
    assert done.err.endswith(f"{link} is given twice; give every recording once\n")
    assert (config.read_bytes(), walk_file.read_bytes()) == before


def test_a_good_fit_says_so_leg_by_leg(ours: Any, walk_file: Path, tmp_path: Path) -> None:
    done = ours("fit", walk_file, "-o", tmp_path / "legs.json")
    assert done.code == 0, done.err
    assert (tmp_path / "legs.json").exists()
    assert "(rad)" not in done.out, "equations are printed on request"
    last = done.out.splitlines()[-6:]
    assert [line.split(":")[0] for line in last] == [
        f"leg {leg}" for leg in ("lf", "lm", "lr", "rf", "rm", "rr")
    ]
    assert all("x the noise of its readings" in line or "too little" in line for line in last)


SECONDS = 20.0


@pytest.fixture(scope="module")
def sent(walk_file: Path) -> list[m.Sent]:
    return m.first(m.read(walk_file), SECONDS)


def made_of(messages: list[m.Sent], mistake: m.Mistake, folder: Path) -> Path:
    """A recording with a mistake."""
    return m.write(folder / "made.mcap", list(mistake(messages, np.random.default_rng(1))))


def said_of(
    mistake: m.Mistake,
    sent: list[m.Sent],
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> tuple[list[str], AdaptiveContactError | None]:
    """What is said of a recording with this mistake before anything is learned, and the refusal."""
    made = made_of(sent, mistake, folder)
    robot, refusal = shipped_robot(), None
    try:
        check_conventions(robot, gather([made], robot))
    except AdaptiveContactError as error:
        refusal = error
    lines = capsys.readouterr().err.splitlines()
    # A heuristic stops the command with a way past it, which its line names.
    if isinstance(refusal, ConfigurationError):
        assert "--anyway" in str(refusal)
        with contextlib.suppress(RecordingError):  # of which no sample can be used
            check_conventions(robot, gather([made], robot, refuse=False), refuse=False)
        assert capsys.readouterr().err.splitlines()[: len(lines)] == lines
    return lines, refusal


def test_of_a_good_recording_nothing_is_said(
    sent: list[m.Sent], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said_of(m.compose(), sent, tmp_path, capsys) == ([], None)


# What makes every tick of a recording worthless, and the one line that names it.
SPOILT: dict[str, tuple[m.Mistake, str]] = {
    "degrees": (m.degrees, "these look like degrees"),
    "readings in degrees": (
        m.angles(lambda row: [math.degrees(x) for x in row], "measured"),
        "these look like degrees",
    ),
    "registers": (m.registers, "these look like register steps"),
    "goals as readings": (m.echoed(), "measured copies desired"),
    "goals of the last tick": (m.echoed(1), "measured copies desired"),
    "late goals with noise": (m.noisy_goals(5), "measured copies desired"),
    "late goals, rounded": (
        m.compose(m.echoed(6), m.rounded(m.AX12_STEP)),
        "measured copies desired",
    ),
    "readings held for four ticks": (m.held(4), "readings are held"),
    "legs read by turns": (m.held(6, by_turns=True), "readings are held"),
    "another order": (m.swapped_readings, "another order than desired"),
    "another sign": (m.goals_mirrored, "a joint moves against its command"),
    "another zero": (m.zero_moved, "a joint is far from its command"),
    "a frozen joint": (m.frozen(1), "a reading never changes"),
    "coarser steps": (m.rounded(0.02), "do not step by the quantum_rad = 0.005118"),
    "one leg for all": (m.one_for_all, "legs send the same readings"),
    "joints that are missing": (m.angles(lambda row: row[:2]), "samples have 2 joints"),
    "milliseconds": (m.milliseconds, "seems to be in milliseconds"),
    "float seconds": (m.float_seconds, "t_ns is not an integer"),
    "an endless swing": (m.never_stance, "phase is `swing` all the time"),
    "another rate": (m.slower(2.0), "20.0 ms apart (50.0 Hz): found 40.0 ms (25.0 Hz)"),
}


# What spoils some ticks, which are left out.
NAMED: dict[str, tuple[m.Mistake, str]] = {
    "failed reads": (m.raw_zeros(0.005), "readings jump away and back"),
    "an encoder's seam": (m.encoder_seam, "readings are off by a full turn"),
    "a turn off": (m.one_turn_off, "readings are off by a full turn"),
    "jitter": (m.white_jitter, "t_ns jitters"),
    "losses": (m.lossy(0.03), "samples are lost"),
}


# One of each check, and all that is let through; test_table.py has them all, by name.
QUICK = ("degrees", "goals as readings", "readings held for four ticks", "another order")
QUICK += ("joints that are missing", "milliseconds", "an endless swing", *NAMED)


@pytest.mark.parametrize(
    ("mistake", "words", "refused"),
    [
        pytest.param(*row, name in SPOILT, id=name, marks=() if name in QUICK else pytest.mark.slow)
        for name, row in (SPOILT | NAMED).items()
    ],
)
def test_what_is_wrong_with_a_recording_is_one_line(
    sent: list[m.Sent],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mistake: m.Mistake,
    words: str,
    refused: bool,
) -> None:
    lines, refusal = said_of(mistake, sent, tmp_path, capsys)
    assert (refusal is not None) == refused
    (line,) = lines
    assert "legs lf lm lr rf rm rr: " in line
    assert words in line


def test_pitch_of_the_wrong_sign_is_refused(
    sent: list[m.Sent], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines, refusal = said_of(m.pitch_down, sent, tmp_path, capsys)
    assert refusal is not None
    assert "signs, order or zeros of the angles are not those of" in str(refusal)
    assert all("directions = [1, -1, -1]" in line for line in lines)
    assert len(lines) == 6


@pytest.mark.slow
@pytest.mark.parametrize("mistake", [m.encoder_seam, m.raw_zeros(0.005)], ids=["seam", "zeros"])
def test_what_is_named_does_not_enter_a_baseline(
    walk_file: Path, tmp_path: Path, mistake: m.Mistake
) -> None:
    robot, limits = shipped_robot(), []
    made = made_of(m.read(walk_file), mistake, tmp_path)
    for path in (walk_file, made):
        streams = {leg: one.stretches() for leg, one in gather([path], robot).items()}
        with threadpool_limits(1):
            training = learn(robot, streams, origin="", threshold=0.1)
        limits.append(training.baseline.thresholds(1.0).max())
    # Failed reads that were learned from made it nine times as much.
    assert limits[1] < 1.5 * limits[0]


@pytest.mark.parametrize("usable", [True, False])
def test_thresholds_that_no_leg_has_are_refused(usable: bool) -> None:
    robot = shipped_robot()
    baseline = shipped_baseline(robot.name)
    if not usable:
        zero = tuple(Tail(0.1, 0.01, 0.02, 0.0, 100) for _ in range(3))
        baseline = dataclasses.replace(baseline, tails=zero)
    why = unusable(robot, Training(baseline, {}))
    assert (why is None) == usable
    assert usable or why.startswith("thresholds are as low as")


def test_what_is_no_model_is_not_written(ours: Any, walk_file: Path, tmp_path: Path) -> None:
    made = made_of(m.read(walk_file), m.never_stance, tmp_path)
    done = ours("fit", made, "-o", tmp_path / "legs.json")
    assert done.code == 2, done.out
    assert not (tmp_path / "legs.json").exists()
    assert "phase is `swing` all the time" in done.err
    assert "nothing is learned from them" in done.err.splitlines()[-1]


def test_a_recording_of_other_legs_is_named(ours: Any, walk_file: Path, tmp_path: Path) -> None:
    made = made_of(m.read(walk_file), m.renamed({"lf": "LF"}), tmp_path)
    done = ours("fit", made, "-o", tmp_path / "legs.json")
    assert "no --config: taken for the shipped robot 'hexapod-ax12a'" in done.err
    assert "not used: leg LF, which robot 'hexapod-ax12a' lacks; it has leg lf" in done.err


@pytest.mark.parametrize("command", ["replay", "score"])
def test_what_seems_of_no_use_is_judged_on_request(
    ours: Any, sent: list[m.Sent], tmp_path: Path, command: str
) -> None:
    made = made_of(sent, m.milliseconds, tmp_path)
    more = ["--events", tmp_path / "events.jsonl", "--force"] if command == "replay" else []
    done = ours(command, made, *more)
    assert done.code == 2
    assert done.err.endswith("nothing can be judged by its samples (see above); --anyway goes on\n")
    assert "--anyway" not in ours(command, made, *more, "--anyway").err


@pytest.mark.parametrize(
    ("mistake", "seconds", "words", "lines"),
    [
        (m.swapped_readings, 20.0, "measured has its joints in another order than desired", 1),
        (m.swapped, 3.5, "joints are beyond their limits", 1),
        (m.swapped, 20.0, "the joints do not come in the order of robot.toml", 6),
    ],
    ids=["readings", "both, not yet judged by the feet", "both"],
)
def test_exchanged_joints_are_one_cause_in_a_replay(
    ours: Any,
    sent: list[m.Sent],
    tmp_path: Path,
    mistake: m.Mistake,
    seconds: float,
    words: str,
    lines: int,
) -> None:
    made = made_of(m.first(sent, seconds), mistake, tmp_path)
    done = ours("replay", made, "--events", tmp_path / "events.jsonl")
    _, _, *told = done.err.splitlines()
    assert sum(words in line for line in told) == lines
    assert not [line for line in told if words not in line and ("foot" in line or ";" in line)]


@pytest.mark.parametrize("command", ["fit", "replay", "score"])
def test_no_command_takes_the_shipped_robot_silently_or_for_another(
    ours: Any, sent: list[m.Sent], tmp_path: Path, command: str
) -> None:
    more = {
        "fit": ["-o", tmp_path / "legs.json"],
        "replay": ["--events", tmp_path / "events.jsonl", "--force"],
        "score": [],
    }[command]
    nameless = m.write(tmp_path / "one.mcap", sent[:2000])
    line = (
        "no --config: taken for the shipped robot 'hexapod-ax12a' (lf, lm, lr, rf, rm, rr; 20 ms)"
    )
    assert line in ours(command, nameless, *more).err
    named = m.write(tmp_path / "two.mcap", sent[:2000], {"robot": "my-robot"})
    done = ours(command, named, *more)
    assert done.code == 2
    (line,) = done.err.splitlines()
    assert "recorded from robot 'my-robot'" in line
    assert "give the --config of 'my-robot'" in line
