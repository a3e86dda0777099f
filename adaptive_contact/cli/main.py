"""``adaptive-contact``: one thin file per command, gathered here.

Command files import what they need inside the function, so that ``--help`` and every command
that does not fit starts without PySINDy (1.6 s), MuJoCo or matplotlib.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Final

import typer

from adaptive_contact.errors import AdaptiveContactError

__all__ = ["app", "main"]

app = typer.Typer(
    name="adaptive-contact",
    help="Foot contacts from servo positions alone.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

# Command -> module with a function of the same name; order is the help's.
_COMMANDS: Final = (
    "demo",
    "serve",
    "watch",
    "doctor",
    "record",
    "replay",
    "score",
    "fit",
    "bench",
    "paper",
)


def _register() -> None:
    for name in _COMMANDS:
        module = importlib.import_module(f"adaptive_contact.cli.{name}")
        app.command(name)(getattr(module, name))
    from adaptive_contact.cli import bridge, experiment, robot, scenarios, sim, state
    from adaptive_contact.cli.baseline import baseline

    sim.app.command("baseline")(baseline)
    app.add_typer(sim.app, name="sim")
    app.add_typer(bridge.app, name="bridge")
    app.add_typer(robot.app, name="robot")
    app.add_typer(state.app, name="state")
    app.add_typer(scenarios.app, name="scenarios")
    app.add_typer(experiment.app, name="experiment")


def main() -> None:
    """Run the command line; expected failures end in one line on stderr and exit code 2."""
    _register()
    try:
        app()
    except AdaptiveContactError as error:
        print(f"adaptive-contact: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        # The reader of our stdout is gone (`| head`); keep the interpreter's own flush quiet.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)


if __name__ == "__main__":
    main()
