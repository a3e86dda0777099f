"""Defines ``adaptive-contact robot``: a new robot, from its bus to a baseline."""

from __future__ import annotations

import typer

from adaptive_contact.cli._robot_check import check
from adaptive_contact.cli._robot_init import init
from adaptive_contact.cli._robot_learning import learn

app = typer.Typer(help="A new robot: who is there, is it right, learn it.", no_args_is_help=True)
app.command("init")(init)
app.command("check")(check)
app.command("learn")(learn)
