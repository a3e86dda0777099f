"""A little of the lists that `field.lies`, `field.honest` and `field.sources` print."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.robot import shipped_robot

from . import honest
from . import sources as s
from .lies import KINDS, Stream, first_order, follow_honest, simulated, tell


@pytest.fixture(scope="module")
def walkers() -> list[Stream]:
    return list(simulated(24.0, 5, ["hexapod"]))


@pytest.mark.parametrize("kind", KINDS)
def test_a_lie_is_named_silenced_and_over(walkers: list[Stream], kind: str) -> None:
    rng = np.random.default_rng([3, *kind.encode()])
    for fitted in (True, False):
        told = tell(walkers[int(rng.integers(6))], kind, rng, fitted=fitted)
        assert (told.named, told.contacts, told.right_again) == (True, 0, True), told


@pytest.mark.parametrize("fitted", [True, False])
def test_legs_that_walk_are_not_doubted(walkers: list[Stream], *, fitted: bool) -> None:
    assert not any(follow_honest(stream, fitted=fitted).doubted for stream in walkers[:3])


def test_servos_that_follow_closely_are_not_doubted() -> None:
    """Delays of 0 to 4 ticks, play up to 2 degrees, steps of 10 and 12 bits and none."""
    for stream in list(first_order(16.0, 2))[::4]:
        assert not follow_honest(stream, fitted=False).doubted


# -- A small share of the hundreds of hours (`make honest`), and that it goes on where it was


def test_honest_legs_are_not_doubted_and_a_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(honest, "TURNS", (honest.TURNS[4], honest.TURNS[1], honest.TURNS[3]))
    few = ["--seconds", "12"]
    assert honest.main([str(tmp_path), "--hours", "0.003", *few]) == 0
    path = tmp_path / "legs.jsonl"
    begun = path.read_text()
    assert honest.main([str(tmp_path), "--hours", "0.085", *few]) == 0
    assert path.read_text().startswith(begun)
    runs = [json.loads(line) for line in path.read_text().splitlines()]
    assert [of["run"] for of in runs] == list(range(len(runs)))
    assert sum(sum(of["hours"].values()) for of in runs) >= 0.085
    assert "| all |" in capsys.readouterr().out


# -- Loops that slip, in walks; more sources by ``python -m field.sources``

SECONDS = 45.0  # the first seconds, in which nothing is known of a source, are a share of it


@pytest.mark.parametrize(
    ("loop", "seed"),
    [
        ("one in 4 slips 0.25", 5),
        pytest.param("late 0 to 0.25", 5, marks=pytest.mark.slow),
        pytest.param("all slip 0 to 0.15", 6, marks=pytest.mark.slow),
    ],
)
def test_a_loop_that_is_late_finds_its_touches(loop: str, seed: int) -> None:
    """Where delays add up it is 6 to 8 % slower in the mean, and in some moments by more."""
    sent = s.late_loop(*s.walk_of(seed, SECONDS), *s.LOOPS[loop])
    total = s.play(sent, shipped_robot()).total
    assert total.counted.touches > 90
    assert total.counted.recall >= 0.95
    assert total.false_alarms <= 0.03 * total.counted.touches  # 3 or 4, by the processor
