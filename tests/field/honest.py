"""Legs that are honest, for hundreds of hours: how many are doubted.

    PYTHONPATH=tests python -m field.honest out/honest [--hours 300]

One process, which goes on where it was interrupted: every line of ``OUT/legs.jsonl`` is a run of
one robot.  Runs take turns: the shipped robots, a drawn leg, the second engine where it is
installed, servos of first order with delays of 0 to 4 ticks, play to 2 degrees, 10 bits to float.
Exits with 1 where more than one leg in 100 leg-hours is doubted.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from .lies import SECOND, Stream, drawn, first_order, follow_honest, second_engine, simulated

MOST_DOUBTED: Final = 0.01  # legs an hour
SECONDS: Final = 120.0
_KINDS: Final = tuple(SECOND)
# Runs in turn, each of a seed.
TURNS: Final[tuple[Callable[[float, int], Iterator[Stream]], ...]] = (
    lambda seconds, seed: simulated(seconds, seed, ["hexapod"]),
    lambda seconds, seed: first_order(seconds / 2, seed),
    lambda seconds, seed: simulated(seconds, seed, ["quadruped12"]),
    lambda seconds, seed: drawn(round(seconds), seed),
    lambda seconds, seed: simulated(seconds, seed, ["leg5"]),
    lambda seconds, seed: second_engine(seconds / 2, seed, [_KINDS[seed % len(_KINDS)]]),
    lambda seconds, seed: drawn(round(seconds), seed + 100_000),
)


def run(number: int, seconds: float) -> dict[str, Any]:
    """Follow all legs of a run, with their baselines and without by turns."""
    seed = 1000 + number // len(TURNS)
    legs = [
        follow_honest(stream, fitted=stream.baseline is not None and (number + k) % 2 == 0)
        for k, stream in enumerate(TURNS[number % len(TURNS)](seconds, seed))
    ]
    return {
        "run": number,
        "hours": {name: sum(leg.hours for leg in legs if leg.name == name) for name in
                  {leg.name for leg in legs}},
        "doubted": [f"{leg.name}, seed {seed}: {leg.words}" for leg in legs if leg.doubted],
        "noted": [f"{leg.name}, seed {seed}: {leg.words}" for leg in legs
                  if leg.words and not leg.doubted],
    }  # fmt: skip


def table(runs: list[dict[str, Any]]) -> str:
    """Print leg-hours of each kind, and those that were doubted."""
    hours, doubted = Counter[str](), [who for of in runs for who in of["doubted"]]
    for of in runs:
        hours.update(of["hours"])
    lines = ["| honest legs | leg-hours | doubted |", "|---|---|---|"]
    for name, of_kind in sorted(hours.items()):
        count = sum(who.startswith(f"{name},") for who in doubted)
        lines.append(f"| {name} | {of_kind:.2f} | {count} |")
    lines.append(f"| all | {sum(hours.values()):.2f} | {len(doubted)} |")
    return "\n".join([*lines, *doubted, *(who for of in runs for who in of["noted"])])


def doubted_of(runs: list[dict[str, Any]]) -> int:
    """How many legs were."""
    return sum(len(of["doubted"]) for of in runs)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--hours", type=float, default=300.0)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "legs.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    runs = [json.loads(line) for line in lines]
    done = sum(sum(of["hours"].values()) for of in runs)
    with path.open("a") as file:
        while done < options.hours:
            found = run(len(runs), options.seconds)
            file.write(json.dumps(found) + "\n")
            file.flush()
            runs.append(found)
            done += sum(found["hours"].values())
            told = f"{done:.2f} of {options.hours:g} leg-hours, {doubted_of(runs)} doubted"
            print(told, file=sys.stderr, flush=True)
    print(table(runs))
    return int(doubted_of(runs) > max(1.0, MOST_DOUBTED * done))


if __name__ == "__main__":
    sys.exit(main())
