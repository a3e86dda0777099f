"""``python -m adaptive_contact``."""

from __future__ import annotations

from adaptive_contact.cli.main import main

main()
