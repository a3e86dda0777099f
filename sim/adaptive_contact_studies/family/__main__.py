"""Learns the family of legs into a file, or tries it on legs of which nothing is known.

``python -m adaptive_contact_studies.family learn FILE [FOLDER]``;
``python -m adaptive_contact_studies.family try FOLDER``; what each run gave is kept in FOLDER.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rich.console import Console

from adaptive_contact_studies.family.prior import learn_family, save_family
from adaptive_contact_studies.family.trials import table, trials
from adaptive_contact_studies.work import Work


def main(arguments: list[str]) -> int:
    """Do what is asked for."""
    console = Console(stderr=True)
    match arguments:
        case ["learn", file, *folder]:
            family = learn_family(Work(Path(*folder or ["out/prior"]), 2, console=console))
            save_family(family, Path(file))
            print(f"{file}: {family.origin}")
        case ["try", folder]:
            print(table(trials(Work(Path(folder), 2, console=console))))
        case _:
            found = " ".join(arguments) or "nothing"
            print(f"{found}: expected `learn FILE` or `try FOLDER`", file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
