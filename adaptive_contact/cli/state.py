"""Defines ``adaptive-contact state``: shows or removes what the service has learned."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.table import Table

from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._options import (
    JsonOption,
    StateOption,
    option,
)
from adaptive_contact.cli._output import print_json, print_line
from adaptive_contact.durations import duration
from adaptive_contact.errors import ConfigurationError, reason_of
from adaptive_contact.printable import printable
from adaptive_contact.service.settings import shown_path

if TYPE_CHECKING:
    from adaptive_contact.service.state import Stored

app = typer.Typer(
    help="Show or forget what the service has learned and kept.", no_args_is_help=True
)

RobotOption = Annotated[str | None, option("--robot", "Only of this robot.", "NAME")]
LegOption = Annotated[str | None, option("--leg", "Only of this leg.", "ID")]


@app.command()
def show(
    state: StateOption = None,
    robot: RobotOption = None,
    leg: LegOption = None,
    json: JsonOption = False,
) -> None:
    """List what is kept: of which robot and leg, how old, and whether it is sound."""
    rows = [_row(stored) for stored in _found(state, robot, leg)]
    if json:
        print_json(rows, indent=2)
        return
    if not rows:
        print_line(f"no state in {shown_path(_folder(state))}")
        return

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("robot", "leg", "model", "age", "size", "state"):
        table.add_column(name, no_wrap=True)
    table.add_column("file", overflow="fold")  # its name holds library of terms and settings
    for row in rows:
        known = row["age_s"] is not None
        table.add_row(
            printable(row["robot"]) if known else "-",
            printable(row["leg"]) if known else "-",
            str(row["model_version"]) if known else "-",
            duration(row["age_s"]) if known else "-",
            f"{row['bytes'] / 1000:.0f} kB",
            "sound" if row["refused"] is None else "refused",
            printable(Path(row["file"]).name),
        )
    print_line(f"in {shown_path(_folder(state))}")
    table_console(pipe_width=160).print(table)
    for row in rows:
        if row["refused"] is not None:
            print_line(f"{Path(row['file']).name}: {row['refused']}")


@app.command()
def reset(
    state: StateOption = None,
    robot: RobotOption = None,
    leg: LegOption = None,
    yes: Annotated[bool, option("--yes", "Do not ask.", short="-y")] = False,
) -> None:
    """Forget what was learned: the service starts from its baseline again.

    Refused while a service saves into the folder, for it would save again.
    """
    from adaptive_contact.service.state import StateStore, list_rest

    root = _folder(state)
    found = [stored.path for stored in _found(state, robot, leg)]
    found += [path for path in list_rest(root) if _is_named(path, root, robot, leg)]
    if not found:
        if robot is not None or leg is not None:
            asked = [f"leg '{leg}'"] if leg else []
            asked += [f"robot '{robot}'"] if robot else []
            raise ConfigurationError(
                f"nothing of {' of '.join(asked)} is kept in {shown_path(root)}; `adaptive-contact "
                "state show` lists what is"
            )
        print_line(f"nothing to forget in {shown_path(root)}")
        return
    with contextlib.ExitStack() as held:
        # Before the question is asked; no service begins to save before it is answered.
        for folder in sorted({path.parent for path in found}):
            store = StateStore(folder)
            held.callback(store.close)
            try:
                store.reopen()
            except OSError as error:
                raise ConfigurationError(
                    f"{folder}: cannot be emptied ({error.strerror})"
                ) from error
            if store.trouble is not None:
                raise ConfigurationError(store.trouble)
        if not yes:
            typer.confirm(
                printable(f"forget {len(found)} files in {shown_path(root)}?"), abort=True
            )
        for path in found:
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise ConfigurationError(f"{path}: cannot be removed ({error.strerror})") from error
    print_line(f"forgot {len(found)} files")


def _folder(state: Path | None) -> Path:
    from adaptive_contact.service.state import default_folder

    return state or default_folder()


def _found(state: Path | None, robot: str | None, leg: str | None) -> list[Stored]:
    """Return what is there; a file that cannot be read has neither robot nor leg, but a name."""
    from adaptive_contact.service.state import Refused, list_states

    root = _folder(state)
    try:
        next(root.iterdir(), None)
    except (FileNotFoundError, NotADirectoryError) as error:
        if state is not None:  # of the default one: nothing has been kept yet
            raise ConfigurationError(
                f"{root} is no folder; give the --state DIR of the service"
            ) from error
    except OSError as error:
        raise ConfigurationError(
            f"{root} cannot be read ({reason_of(error)}); run as the "
            "service's user, or give another --state DIR"
        ) from error
    found = []
    for stored in list_states(root):
        record = stored.record
        if isinstance(record, Refused):
            wanted = _is_named(stored.path, root, robot, leg)
        else:
            wanted = robot in (None, record.identity.robot) and leg in (None, record.identity.leg)
        if wanted:
            found.append(stored)
    return found


def _is_named(path: Path, root: Path, robot: str | None, leg: str | None) -> bool:
    """Return whether a file is a robot's and a leg's by its name; None is any."""
    from adaptive_contact.service.state import is_of_leg, robot_folder

    of_robot = robot is None or path.parent == robot_folder(root, robot)
    return of_robot and (leg is None or is_of_leg(path, leg))


def _row(stored: Stored) -> dict[str, Any]:
    from adaptive_contact.service.state import Refused

    record = stored.record
    row: dict[str, Any] = {"file": shown_path(stored.path), "bytes": stored.size}
    if isinstance(record, Refused):
        empty = dict.fromkeys(("robot", "leg", "library", "settings", "model_version", "age_s"))
        return row | empty | {"refused": record.why}
    refused = stored.path.suffix == ".refused"
    return {
        **row,
        "robot": record.identity.robot,
        "leg": record.identity.leg,
        "library": record.identity.library,
        "settings": record.identity.settings,
        "model_version": record.model_version,
        "age_s": max(0.0, (time.time_ns() - record.saved_ns) / 1e9),
        "refused": "refused by the service; the log says why" if refused else None,
    }
