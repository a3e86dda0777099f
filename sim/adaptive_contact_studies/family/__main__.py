"""``python -m adaptive_contact_studies.family FILE``: learn the family of legs into a file."""

from __future__ import annotations

import sys
from pathlib import Path

from adaptive_contact_studies.family.prior import learn_family, save_family

if __name__ == "__main__":
    say = sys.stderr.isatty()

    def told(line: str) -> None:
        """Show how far it is, where somebody looks on."""
        if say:
            print(f"\r{line:40}", end="", file=sys.stderr, flush=True)

    family = learn_family(progress=told)
    save_family(family, Path(sys.argv[1]))
    print(f"\r{sys.argv[1]}: {family.origin}")
