"""``adaptive-contact robot``: a new robot, from its bus to a baseline."""

from __future__ import annotations

import typer

__all__ = ["app"]

app = typer.Typer(help="A new robot: who is there, is it right, learn it.", no_args_is_help=True)
