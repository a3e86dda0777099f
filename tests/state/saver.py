"""Saves six legs over and over, as fast as the disk takes it, until it is killed; a script.

    python tests/state/saver.py FOLDER FIRST_NUMBER

Prints the number of each round that is wholly on disk.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

from adaptive_contact.service.state.format import Identity, Record
from adaptive_contact.service.state.store import StateStore

LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")


def identity(leg: str) -> Identity:
    return Identity("mini", leg, "servo", "0123456789abcdef")


def main(folder: Path, first: int) -> None:
    store = StateStore.open(folder, "mini")
    assert store.trouble is None, store.trouble
    print("ready", flush=True)
    for number in itertools.count(first):
        for leg in LEGS:
            store.save(
                Record(
                    identity=identity(leg),
                    saved_ns=number,
                    package="",
                    model_version=number,
                    run=None,
                    seq=number,
                    # A leg's state is some hundred kilobytes of numbers.
                    body={"number": number, "rows": bytes([number % 251]) * 300_000},
                )
            )
        print(number, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
