"""Gathers the commands of ``adaptive-contact``, one thin file each.

Command files import what takes long inside the function, so that ``--help`` and every command
that does not fit starts without PySINDy (1.6 s), MuJoCo or matplotlib.
"""

from __future__ import annotations

import atexit
import errno
import importlib
import os
import signal
import sys
import threading
from typing import Annotated, Any, Final, NoReturn

import typer

from adaptive_contact import __version__
from adaptive_contact.cli._output import (
    OutputLost,
    make_stdout_optional,
    print_line,
    print_note,
    protect_output,
)
from adaptive_contact.cli._signals import interrupt_once, on_signals
from adaptive_contact.errors import AdaptiveContactError, missing_of_the_whole

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

# Command -> module with a function of the same name; order is the help's.
_COMMANDS: Final = (
    "demo",
    "serve",
    "watch",
    "doctor",
    "record",
    "replay",
    "export",
    "score",
    "fit",
    "bench",
    "paper",
)


# Those with commands of their own.
_GROUPS: Final = ("sim", "bridge", "robot", "state", "scenarios")


def _print_version(asked: bool) -> None:
    if asked:
        print_line(f"adaptive-contact {__version__}")
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


def load_commands(asked: str = "") -> None:
    """Load the command that is asked for, as the others take as long as a small one runs.

    Args:
        asked: its name; where it is none, as for the help, all are loaded.  Later calls do nothing.
    """
    if app.registered_commands or app.registered_groups:
        return
    known = asked in _COMMANDS or asked in _GROUPS
    for name in [asked] if known else [*_COMMANDS, *_GROUPS]:
        try:
            module = importlib.import_module(f"adaptive_contact.cli.{name}")
        except ModuleNotFoundError as error:
            if known or missing_of_the_whole(error) is None:
                raise
            continue  # the help lists what is there
        if name in _GROUPS:
            app.add_typer(module.app, name=name)
        else:
            app.command(name)(getattr(module, name))


def main() -> None:
    """Run the command line.

    Exit codes: 0 the command did its work; 1 it did not, or found something wrong; 2 an expected
    failure, said in one line on stderr, such as a file that cannot be read or a full disk under
    stdout; 129, 130 and 143 SIGHUP, Ctrl-C and SIGTERM; 141 the reader of stdout is gone
    (``| head``).
    """
    protect_output()
    on_signals(_end, (signal.SIGTERM, signal.SIGHUP))
    interrupt_once()
    try:
        code = run()
        sys.stdout.flush()
    except OutputLost as lost:
        code = _lost(lost.cause)
    finally:  # the interpreter's own flush cannot fail any more
        make_stdout_optional()
    if "zenoh" in sys.modules:
        _leave(code)
    sys.exit(code)


def _end(number: int, _: object) -> NoReturn:
    """End as an exception does: what is half written is removed, and children are ended."""
    raise SystemExit(128 + number)


def _leave(code: int) -> NoReturn:
    """End the process without ending the interpreter.

    The interpreter ends any thread that comes back to Python meanwhile. Zenoh's threads do, also
    after their session was closed, and do not survive that: the process would abort, once in some
    sixty times.
    """
    threading._shutdown()  # type: ignore[attr-defined]  # joins threads, as `sys.exit` would
    atexit._run_exitfuncs()
    sys.stderr.flush()
    os._exit(code)


def run() -> int:
    """Run the command line, and return its exit code, see :func:`main`."""
    try:
        load_commands(sys.argv[1] if len(sys.argv) > 1 else "")
        code = app(prog_name="adaptive-contact", standalone_mode=False)
    except KeyboardInterrupt:  # while a command was still being loaded
        return _INTERRUPTED
    except SystemExit as ended:
        return int(ended.code or 0)
    except typer.Abort as abort:
        if isinstance(abort.__cause__, KeyboardInterrupt):
            return _INTERRUPTED
        print_note("nothing was done")
        return 1
    except _Misunderstood as error:
        return _refuse(error)
    except AdaptiveContactError as error:
        first, *others = error.lines
        print_note(first)
        for line in others:
            print_line(line, err=True)
        return 2
    except ModuleNotFoundError as error:
        why = missing_of_the_whole(error)
        if why is None:
            raise
        print_note(f"{' '.join(sys.argv[1:2])} {why}")
        return 2
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        print_note(f"{error.filename or 'a file'} cannot be written ({error.strerror}); make room")
        return 2
    return code if isinstance(code, int) else 0


def _lost(cause: OSError) -> int:
    """Say why stdout cannot be written; a reader that is gone knows."""
    if isinstance(cause, BrokenPipeError):
        # As a shell has it: 128 + SIGPIPE.
        return 141
    print_note(f"the output cannot be written ({cause.strerror}); make room, or send it elsewhere")
    return 2


def _refuse(error: Any) -> int:
    """Print one line on a command line that cannot be understood, and where its options are."""
    if type(error).__name__ == "NoArgsIsHelpError":  # the help was its message
        error.show()
        return int(error.exit_code)
    path = "adaptive-contact" if error.ctx is None else error.ctx.command_path
    words = " ".join(error.format_message().replace("Value error, ", "").split()).rstrip(".")
    print_note(f"{words}; see `{path} --help`")
    return int(error.exit_code)


if __name__ == "__main__":
    main()
