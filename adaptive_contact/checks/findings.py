"""Merges the faults that ``doctor`` and ``fit`` find: one cause, one entry.

A check reports each :class:`Fault` with its cause.  :func:`entries` then leaves out what
another cause of the same leg explains, and puts all legs of a cause into one :class:`Finding`.
The words of all faults stand in ``faults.toml``, beside this file.
"""

from __future__ import annotations

import functools
import itertools
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import Any, Final, Literal, NamedTuple, Self, cast

from adaptive_contact.wire import Reject

Level = Literal["error", "warning", "note"]
_RANKS: Final[dict[Level, int]] = {"error": 0, "warning": 1, "note": 2}
# Details of one entry that are printed; the others are counted.
_DETAILS: Final = 2


def many(count: float, total: int) -> bool:
    """Return whether a fault is more frequent than on any real bus."""
    # What happens to so few samples, or to such a share of them, is a note: a real bus drops or
    # spoils one reading in about 3,000, and one of a few hundred shows no share.
    return count > max(2, 2e-3 * total)


# Why a leg, or the whole robot, cannot report reliably; names are those of faults.toml.
Cause = Literal[
    # The network and the service.
    "no_service",
    "service_quiet",
    "service",
    "state_refused",
    "strange_leg",
    "nobody_publishes",
    "silent",
    "key",
    "other_key",
    "namespace",
    "leg_ids",
    "undescribed",
    "too_many_keys",
    # Payloads.
    "unreadable",
    "time_type",
    "field",
    "joints",
    # Order and time.
    "two_publishers",
    "run",
    "time_backwards",
    "time_unit",
    "seq",
    "loss",
    "period",
    "jitter",
    # Readings and commands.
    "invalid",
    "not_finite",
    "units",
    "echo",
    "near_echo",
    "old",
    "twins",
    "frozen",
    "held",
    "order",
    "backwards",
    "far",
    "glitches",
    "turn",
    "quantum",
    "undeclared",
    "phase",
    "limits",
    "goals",
    # What the leg's learner says.
    "signs",
    "leg_swap",
    "not_this_robot",
    "refused",
    "learning",
    "ambiguous",
    "unreported",
    "leg_note",
]


@functools.cache
def said() -> dict[str, dict[str, Any]]:
    """Return what is said of faults, by name, and tables of other use."""
    return tomllib.loads(resources.files(__package__).joinpath("faults.toml").read_text("utf-8"))


def _causes(names: Iterable[str]) -> frozenset[Cause]:
    groups = said()["groups"]
    each = (groups[name[1:]] if name.startswith("@") else [name] for name in names)
    return frozenset(cast(Cause, value) for values in each for value in values)


# Causes that a cause explains, in the same leg; one of the whole robot explains them in every leg.
EXPLAINS: Final = {
    cast(Cause, cause): _causes(of) - {cause} for cause, of in said()["explains"].items()
}
# Reasons for which the service refuses samples of a leg with such a fault.
REFUSED_FOR: Final[dict[str, frozenset[Reject]]] = {
    cause: frozenset(map(Reject, of)) for cause, of in said()["refused_for"].items()
}
# Causes that spoil every tick: no model of the leg can be learned from such a recording.  Other
# causes spoil known ticks, which are left out.
SPOILS: Final = frozenset(
    {"units", "echo", "twins", "frozen", "order", "backwards", "far"} | {"quantum", "held", "phase"}
)


class Fault(NamedTuple):
    """Holds one fault of one leg, as a check found it."""

    level: Level
    cause: Cause  # faults of one cause become one entry
    what: str  # what was found and expected, the same for every leg of one entry
    remedy: str  # what to do
    detail: str | None = None  # this leg's figures, None where `what` has them all
    size: float = 0.0  # severity among faults of this cause: the largest are shown
    key: str = ""  # separates entries of one cause that need different remedies
    total: int = 0  # samples of which ``size`` is a part; a small part makes it a note

    @classmethod
    def from_table(
        cls,
        name: str,
        /,
        detail: str | None = None,
        size: float = 0.0,
        key: str = "",
        *,
        level: Level | None = None,
        total: int = 0,
        **figures: object,
    ) -> Self:
        """Make one in the words that ``faults.toml`` has under a name, with figures filled in."""
        words = said()[name]
        what, remedy = (words[part].format(**figures) for part in ("what", "remedy"))
        cause = cast(Cause, name.partition("-")[0])
        return cls(level or words["level"], cause, what, remedy, detail, size, key, total)


def explained(fault: Fault) -> frozenset[Cause]:
    """Return the causes that a fault explains in its leg."""
    return frozenset() if fault.level == "note" else EXPLAINS.get(fault.cause, frozenset())


class Finding(NamedTuple):
    """Describes one fault and its remedy.  A ``note`` is worth knowing and no fault."""

    level: Level
    leg: str | None  # the only leg that it is of; None for several, and for the whole robot
    what: str
    remedy: str
    cause: str = ""  # a `Cause`
    legs: Sequence[str] = ()  # all legs that it is of


def name_legs(legs: Iterable[str]) -> str:
    """Format leg ids: ``leg lf`` or ``legs lf rf``."""
    names = list(legs)
    return f"leg{'s' if len(names) > 1 else ''} {' '.join(names)}"


def entries(faults: Iterable[tuple[str | None, Fault]]) -> list[Finding]:
    """Merge faults into one entry for each cause, the worst first.

    Args:
        faults: each with its leg, None for the whole robot; in the order in which legs are named.

    Returns:
        What is left when consequences are left out and legs are put together.
    """
    together: dict[tuple[Cause, str], list[tuple[str | None, Fault]]] = {}
    for leg, fault in faults:
        together.setdefault((fault.cause, fault.key), []).append((leg, fault))
    groups = [_weighed(group) for group in together.values()]
    known: defaultdict[str | None, set[Cause]] = defaultdict(set)
    for leg, fault in itertools.chain(*groups):
        known[leg] |= explained(fault)
    left = (
        [(leg, fault) for leg, fault in group if fault.cause not in known[None] | known[leg]]
        for group in groups
    )
    made = [_entry(group) for group in left if group]
    # The whole robot first, then what most legs have: a wrong description shows in single legs.
    return sorted(
        made,
        key=lambda finding: (_RANKS[finding.level], bool(finding.legs), -len(finding.legs)),
    )


def _weighed(faults: list[tuple[str | None, Fault]]) -> list[tuple[str | None, Fault]]:
    """Return faults of one cause, as notes where all legs together have only a few such samples."""
    total = sum(fault.total for _, fault in faults)
    if not total or many(sum(fault.size for _, fault in faults), total):
        return faults
    return [(leg, fault._replace(level="note")) for leg, fault in faults]


def _entry(faults: Sequence[tuple[str | None, Fault]]) -> Finding:
    level = min((fault.level for _, fault in faults), key=lambda level: _RANKS[level])
    ordered = sorted(faults, key=lambda item: (_RANKS[item[1].level], -item[1].size))
    worst = ordered[0][1]
    legs = list(dict.fromkeys(leg for leg, _ in faults if leg is not None))
    alike = len({fault.detail for _, fault in faults}) == 1
    details = dict.fromkeys(
        fault.detail if alike or len(legs) < 2 else f"{leg} {fault.detail}"
        for leg, fault in ordered
        if fault.detail is not None
    )
    shown = list(details)[:_DETAILS]
    if len(details) > _DETAILS:
        shown.append(f"and {len(details) - _DETAILS} more")
    what = f"{worst.what}: {', '.join(shown)}" if shown else worst.what
    return Finding(
        level, legs[0] if len(legs) == 1 else None, what, worst.remedy, worst.cause, legs
    )
