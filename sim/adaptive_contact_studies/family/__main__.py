"""Learns the family of legs into a file, or tries it on legs of which nothing is known.

``python -m adaptive_contact_studies.family learn FILE``;
``python -m adaptive_contact_studies.family try FOLDER``, which keeps what each run gave.
"""

from __future__ import annotations

import sys
from pathlib import Path

from adaptive_contact_studies.family.prior import learn_family, save_family
from adaptive_contact_studies.family.trials import table, trials

_USAGE = "expected `learn FILE` or `try FOLDER`"


def _show(line: str) -> None:
    """Show how far it is, where somebody looks on."""
    if sys.stderr.isatty():
        print(f"\r{line:40}", end="", file=sys.stderr, flush=True)


def main(arguments: list[str]) -> int:
    """Do what is asked for."""
    match arguments:
        case ["learn", file]:
            family = learn_family(progress=_show)
            save_family(family, Path(file))
            print(f"{file}: {family.origin}")
        case ["try", folder]:
            print(table(trials(Path(folder), progress=_show)))
        case _:
            print(f"{' '.join(arguments) or 'nothing'}: {_USAGE}", file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
