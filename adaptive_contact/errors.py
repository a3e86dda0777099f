"""Defines the one exception tree of the project.

::

    AdaptiveContactError            anything this package raises on purpose
    ├── ConfigurationError          a robot.toml, a setting or a command line that cannot be used
    │   └── MissingExtraError       an optional dependency is not installed
    ├── RecordingError              a recording that cannot be read or written
    ├── BaselineError               a model file that is corrupt, or of another robot
    ├── IdentificationError         a fit that cannot be made (too few rows, empty library)
    │   └── TooLittleDataError      there is too little to fit to: how much, and how much it takes
    ├── LinkError                   Zenoh cannot be reached, or refuses
    ├── BusError                    a Dynamixel bus that cannot be used
    └── SimulationDivergedError          the simulated robot left the range of the possible

Every message is one line: what was found, what was expected, what to do.  A bus of which several
things are wrong says all of them, a line each.
Bad *samples* never raise; they are counted by :class:`adaptive_contact.wire.Reject`.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Final
from urllib.parse import unquote


class AdaptiveContactError(Exception):
    """Base of everything this package raises on purpose."""

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the message as it is printed."""
        return (str(self),)


class ConfigurationError(AdaptiveContactError):
    """Reports a robot description, a setting or a command line that cannot be used."""


class MissingExtraError(ConfigurationError):
    """Reports an optional dependency that a command needs and that is missing or broken."""

    def __init__(self, what: str, extra: str, broken: str = "") -> None:
        found, again = "is not installed", ""
        if broken:
            found, again = f"cannot be loaded ({broken})", "--force-reinstall "
        source = installed_from()
        how = f"run: pip install {again}'{source}[{extra}]'"
        if source is None:
            how = (
                f"run: pip install {again}'.[{extra}]' in a clone, or with the name of the wheel "
                "in place of the dot"
            )
        super().__init__(f"{what} needs the extra '{extra}', which {found}; {how}")
        self.extra = extra


# Either may be what is installed; the second lacks what learns (packaging/listen).
_DISTRIBUTIONS: Final = ("adaptive-contact", "adaptive-contact-listen")
# What only the first brings.
_OF_THE_WHOLE: Final = (
    *("numpy", "scipy", "numba", "pysindy", "sklearn", "threadpoolctl"),
    *("adaptive_contact_sim", "adaptive_contact_studies", "adaptive_contact_bullet"),
)


def installed_from() -> str | None:
    """Return the folder or wheel that this package was installed from; None if it is gone.

    No index has its name, so that pip takes extras from there only.
    """
    for name in _DISTRIBUTIONS:
        with contextlib.suppress(metadata.PackageNotFoundError, ValueError, KeyError):
            url = json.loads(metadata.distribution(name).read_text("direct_url.json") or "")["url"]
            path = unquote(url.removeprefix("file://"))
            if url.startswith("file://") and Path(path).exists():
                return path
    return None


def missing_of_the_whole(error: ImportError) -> str | None:
    """Return a line on what to install, where only the listening part is installed; else None."""
    module = (error.name or "").partition(".")[0]
    if module not in _OF_THE_WHOLE:
        return None
    return (
        f"needs the whole package, as '{module}' is not installed; run: pip uninstall "
        "adaptive-contact-listen, then in a clone: pip install . (or with the name of the wheel)"
    )


@contextlib.contextmanager
def needs(what: str, extra: str, *modules: str) -> Iterator[None]:
    """Report which extra is missing; wrap it around imports of what that extra brings.

    Args:
        what: that needs it.
        extra: its name.
        modules: what it brings, where other imports stand beside; their errors go through.

    Raises:
        MissingExtraError: a module is not installed, or cannot be loaded.
    """
    try:
        yield
    except ImportError as error:
        if modules and (error.name or "").partition(".")[0] not in modules:
            raise
        broken = "" if isinstance(error, ModuleNotFoundError) else str(error).partition("\n")[0]
        raise MissingExtraError(what, extra, broken) from error


class RecordingError(AdaptiveContactError):
    """Reports a recording that cannot be read or written."""


class BaselineError(AdaptiveContactError):
    """Reports a model file that is corrupt, implausible, or of another robot."""


class IdentificationError(AdaptiveContactError):
    """Reports that a fit cannot be made from the rows it was given."""


class TooLittleDataError(IdentificationError):
    """Reports that there is too little to learn from.

    Attributes:
        have, needed: free ticks.
    """

    def __init__(self, message: str, have: int, needed: int) -> None:
        super().__init__(message)
        self.have = have
        self.needed = needed


class LinkError(AdaptiveContactError):
    """Reports that Zenoh cannot be reached, or refuses the connection."""


class BusError(AdaptiveContactError):
    """Reports a Dynamixel bus that cannot be used."""

    def __init__(self, message: str, things: Sequence[str] = ()) -> None:
        self._lines = (message, *(f"  - {thing}" for thing in things))
        super().__init__("\n".join(self._lines))

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the message as it is printed."""
        return self._lines


class SimulationDivergedError(AdaptiveContactError):
    """Reports that the simulated robot left the range of the physically possible."""


def reason_of(error: OSError) -> str:
    """Return the system's words for a failure, in lower case."""
    return (error.strerror or str(error)).lower()
