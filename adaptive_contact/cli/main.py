"""``adaptive-contact``: one thin file per command, gathered here.

Command files import what they need inside the function, so that ``--help`` and every command
that does not fit starts without PySINDy (1.6 s), MuJoCo or matplotlib.
"""

from __future__ import annotations

import errno
import importlib
import os
import sys
from typing import Annotated, Any, Final, NoReturn

import typer

from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.printable import printable

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

# The base of what typer raises for a command line; it is click's, or a copy of typer's own.
_Misunderstood: Final[type[Exception]] = next(
    kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "UsageError"
)
_INTERRUPTED: Final = 130  # as a shell has it
_FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)

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


# Those with commands of their own.
_GROUPS: Final = ("sim", "bridge", "robot", "state", "scenarios", "experiment")


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"adaptive-contact {version('adaptive-contact')}")
        raise typer.Exit


# Without a callback a command that is loaded alone would be taken for the whole program.
@app.callback()
def _one_of_several(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and end."
        ),
    ] = False,
) -> None:
    pass


def _register(asked: str = "") -> None:
    """Load the command that is asked for, as the others take as long as a small one runs.

    Args:
        asked: its name; where it is none, as for the help, all are loaded.
    """
    known = asked in _COMMANDS or asked in _GROUPS
    for name in _COMMANDS:
        if not known or name == asked:
            module = importlib.import_module(f"adaptive_contact.cli.{name}")
            app.command(name)(getattr(module, name))
    for name in _GROUPS:
        if not known or name == asked:
            module = importlib.import_module(f"adaptive_contact.cli.{name}")
            app.add_typer(module.app, name=name)


def main() -> None:
    """Run the command line.

    Expected failures end in one line on stderr and exit code 2, Ctrl-C in 130, and a reader of
    stdout that is gone (`| head`) in 141.
    """
    try:
        _register(sys.argv[1] if len(sys.argv) > 1 else "")
        code = app(prog_name="adaptive-contact", standalone_mode=False)
        sys.stdout.flush()
    except KeyboardInterrupt:  # while a command was still being loaded
        sys.exit(_INTERRUPTED)
    except typer.Abort as abort:
        if isinstance(abort.__cause__, KeyboardInterrupt):
            sys.exit(_INTERRUPTED)
        print("adaptive-contact: nothing was done", file=sys.stderr)
        sys.exit(1)
    except _Misunderstood as error:
        _refuse(error)
    except AdaptiveContactError as error:
        print(f"adaptive-contact: {printable(error)}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        _drop_stdout()
        sys.exit(141)
    except OSError as error:
        if error.errno not in _FULL:
            raise
        _drop_stdout()
        print(
            f"adaptive-contact: the output cannot be written ({error.strerror}); make room, or "
            "send it elsewhere",
            file=sys.stderr,
        )
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)


def _refuse(error: Any) -> NoReturn:
    """One line for a command line that cannot be understood, and where its options are told."""
    if type(error).__name__ == "NoArgsIsHelpError":  # the help was its message
        error.show()
        sys.exit(error.exit_code)
    path = "adaptive-contact" if error.ctx is None else error.ctx.command_path
    words = " ".join(error.format_message().replace("Value error, ", "").split()).rstrip(".")
    print(f"adaptive-contact: {words}; see `{path} --help`", file=sys.stderr)
    sys.exit(error.exit_code)


def _drop_stdout() -> None:
    """Nothing can be written there: keep the interpreter's own flush at the end quiet."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
