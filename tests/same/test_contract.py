"""What every object with state keeps to, in detection, learning, diagnosis and fitting.

A copy that was pickled goes on as the object itself.  A bad sample changes counts only.  What
was saved and restored is what was saved, and goes on alike.  A leg that is reset is as new.
Classes are found by themselves; a new one must be reached from a :class:`World`.
"""

from __future__ import annotations

import collections
import functools
import importlib
import inspect
import math
import pickle
import pkgutil
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactEvent, ServoSample
from adaptive_contact.core.bank import LearnerBank
from adaptive_contact.fit.recordings import LegGatherer
from adaptive_contact.model import shipped_baseline
from adaptive_contact.model.factor import Factor
from adaptive_contact.robot import shipped_robot

from .golden import motion
from .recordings import Round

ROOMS: Final = (
    *("core", "core.detect", "core.learn", "fit", "model"),
    *("checks.leg_ids", "checks.source_watch", "checks.watch"),
)
# Nothing of them changes once they are made.
FIXED: Final = {"HeldOut", "Rows", "_Posterior", "_Speeds", "_Swings"}
# What bad samples change: counts of them, and when all legs are compared, which counts calls.
COUNTED: Final = (
    "Counters.rejects", "LegGatherer.rejects", "Watch", "InlineRefitter",
)  # fmt: skip
# What a leg that is reset keeps: counts, regions of the ground, and what is of no leg or of all.
KEPT: Final = (
    "Counters", "StreamGuard.restarts", "LegBatch.legs.total_n", "Lifecycle.begun", "_Range",
    "ContactLearner._begun", "SwingLabels._region", "Segment.cell", "_Run",
    "Landings._late", "Watch", "InlineRefitter", "LegGatherer", "Factor", "Standing",
)  # fmt: skip
BAD: Final[Sequence[dict[str, Any]]] = (
    {"measured": [math.nan] * 3}, {"desired": [0.0, math.inf, 0.0]}, {"measured": [0.1] * 2},
    {"seq": -1}, {"valid": [True]}, {"preview": [[math.nan] * 3]}, {"t_ns": 2**63},
)  # fmt: skip
# Ticks from which legs without a baseline walk, at which copies are made, and of the end; rf has
# changed at 400.
NEW, TICKS, END = 420, 620, 800


def classes() -> Iterator[type]:
    """All whose objects are made by a method of their own and are no frozen values."""
    for room in ROOMS:
        package = importlib.import_module(f"adaptive_contact.{room}")
        under = pkgutil.iter_modules(getattr(package, "__path__", ()), f"{package.__name__}.")
        for module in [package, *(importlib.import_module(found.name) for found in under)]:
            for _, kind in inspect.getmembers(module, inspect.isclass):
                frozen = getattr(getattr(kind, "__dataclass_params__", None), "frozen", False)
                made = inspect.isfunction(vars(kind).get("__init__")) and not frozen
                protocol = getattr(kind, "_is_protocol", False) or issubclass(kind, Exception)
                whole = made and not protocol and not inspect.isabstract(kind)
                if kind.__module__ == module.__name__ and whole:
                    yield kind


KINDS: Final = [kind for kind in classes() if kind.__name__ not in FIXED]
of_kinds = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)


class Went(NamedTuple):
    """What came of samples: events, and after them what there is of each class."""

    events: list[ContactEvent]
    objects: dict[type, list[Any]]

    def differ(self, other: Went, kind: type, but: Sequence[str] = ()) -> list[str]:
        """Where objects of a class differ."""
        if kind.__name__ in but:
            return []
        pairs = zip(self.objects[kind], other.objects[kind], strict=True)
        found = (f"{kind.__name__}{difference(one, of) or ''}" for one, of in pairs)
        return [w for w in found if w != kind.__name__ and not w.startswith(tuple(but))]


class World:
    """Learners with and without a baseline, and what takes in samples beside them."""

    def __init__(self, saved: Sequence[dict[str, bytes]] = ({}, {})) -> None:
        self.robot = shipped_robot()
        self.gatherer = LegGatherer(self.robot.leg("rf"), self.robot.period_s)
        self.factor = Factor(3, 3)
        self.banks = []
        for baseline, legs in zip((shipped_baseline(self.robot.name), None), saved, strict=True):
            self.banks.append(LearnerBank(self.robot, baseline))
            for leg, of in legs.items():
                assert self.banks[-1].learner(leg).restore(msgspec.msgpack.decode(of)) is None

    def saved(self) -> list[dict[str, bytes]]:
        """What is saved of each leg, by bank."""
        encode = msgspec.msgpack.encode
        return [{leg: encode(b.learner(leg).snapshot()) for leg in b.legs} for b in self.banks]

    def go_on(self, rounds: Sequence[Round], *, run: int = 1, bad: bool = False) -> Went:
        """Take in samples, bad ones before each; the events, and what there is after them."""
        events: list[ContactEvent] = []
        for samples in rounds:
            for spoilt in [*BAD, {}] if bad else [{}]:
                given = {
                    leg: ServoSample(**{**of, "run": run, **spoilt}) for leg, of in samples.items()
                }
                known, new = self.banks
                events += known.update(given)
                events += new.update(given) if samples["rf"]["seq"] > NEW else []
                self.gatherer.add_sample(given["rf"])
            angles = np.array([samples["rf"]["measured"]])
            self.factor.add(angles, angles)
            if bad:
                self.factor.add(angles * math.nan, angles)
        return Went(events, objects(self))


def objects(of: Any) -> dict[type, list[Any]]:
    """What there is of each class, in an order that copies share."""
    found: dict[type, list[Any]] = collections.defaultdict(list)
    done: dict[int, Any] = {}

    def look(at: Any) -> None:
        if id(at) not in done:
            done[id(at)] = at
            found[type(at)].append(at)
            for part in parts(at).values():
                look(part)

    look(of)
    return found


def parts(of: Any) -> dict[str, Any]:
    """What an object is made of, by name; nothing of what holds no state."""
    if isinstance(of, dict) and of.keys() == {"shape", "data"}:
        packed = np.frombuffer(of["data"], np.float64).reshape(of["shape"])
        # Roots of covariances have no signs.
        return {"packed": packed @ packed.swapaxes(1, 2) if packed.ndim == 3 else packed}
    if isinstance(of, dict):
        return {str(key): value for key, value in of.items()}
    if isinstance(of, list | tuple | collections.deque):
        return {str(number): value for number, value in enumerate(of)}
    kind = type(of)
    if not kind.__module__.startswith("adaptive_contact") and kind is not World:
        return {}
    slots = [name for base in kind.__mro__ for name in getattr(base, "__slots__", ())]
    names = getattr(of, "__struct_fields__", None) or [*slots, *getattr(of, "__dict__", {})]
    lazy = functools.cached_property
    kept = [n for n in names if hasattr(of, n) and not isinstance(getattr(kind, n, None), lazy)]
    return {name: getattr(of, name) for name in kept}


def difference(one: Any, other: Any, done: set[tuple[int, int]] | None = None) -> str | None:
    """Where two objects differ, by more than the last digits, but for objects that have a test."""
    if type(one) is not type(other):
        return f": {one!r} and {other!r}"
    if done is not None and type(one) in KINDS:
        return None
    done = set() if done is None else done
    if isinstance(one, np.ndarray | float):
        if isinstance(one, np.ndarray) and one.dtype.names:
            return difference(
                {n: one[n] for n in one.dtype.names}, {n: other[n] for n in one.dtype.names}
            )
        close = np.shape(one) == np.shape(other) and np.allclose(
            one, other, 1e-6, 1e-9, equal_nan=True
        )
        return None if close else f": {one!r} and {other!r}"
    mine, theirs = parts(one), parts(other)
    if not mine and not theirs:
        plain = isinstance(one, str | int | set | frozenset | bytes | type(None))
        return f": {one!r} and {other!r}" if plain and one != other else None
    if mine.keys() != theirs.keys():
        return f": {sorted(mine)} and {sorted(theirs)}"
    if (id(one), id(other)) in done:
        return None
    done.add((id(one), id(other)))
    for name, part in mine.items():
        within = difference(part, theirs[name], done)
        if within is not None:
            return f".{name}{within}"
    return None


@pytest.fixture(scope="module")
def rounds() -> list[Round]:
    """Of rf, whose friction changes, and of two other legs."""
    both = zip(motion("drift").rounds, motion("tripod").rounds, strict=False)
    return [{**of_rf, "lm": others["lm"], "rr": others["rr"]} for of_rf, others in both]


@pytest.fixture(scope="module")
def begun(rounds: list[Round]) -> bytes:
    """In a swing, while rf adapts."""
    world = World()
    world.go_on(rounds[:TICKS])
    return pickle.dumps(world)


@pytest.fixture(scope="module")
def itself(rounds: list[Round]) -> Went:
    """Never pickled, and gone on for some swings."""
    world = World()
    world.go_on(rounds[:TICKS])
    return world.go_on(rounds[TICKS:END])


@pytest.fixture(scope="module")
def copied(rounds: list[Round], begun: bytes) -> Went:
    return pickle.loads(begun).go_on(rounds[TICKS:END])


@pytest.fixture(scope="module")
def spoilt(rounds: list[Round], begun: bytes) -> Went:
    return pickle.loads(begun).go_on(rounds[TICKS:END], bad=True)


@pytest.fixture(scope="module")
def restored(rounds: list[Round], begun: bytes) -> tuple[Went, Went]:
    """From what was saved, and from what was saved of that."""
    first = World(pickle.loads(begun).saved())
    second = World(first.saved())
    return first.go_on(rounds[TICKS:END], run=2), second.go_on(rounds[TICKS:END], run=2)


@pytest.fixture(scope="module")
def reset(rounds: list[Round], begun: bytes) -> tuple[Went, Went]:
    """After a fault in each leg, of which nothing was saved; and new."""
    used = pickle.loads(begun)
    for bank in used.banks:
        for leg in bank.legs:
            bank.learner(leg).reset_after_fault(ValueError("a fault"))
            bank.learner(leg).place.leg.release_pending = False  # what was reported
    new = World()
    for bank in new.banks:
        for leg in rounds[0]:
            bank.learner(leg)
    return used.go_on(rounds[TICKS:END], run=2), new.go_on(rounds[TICKS:END], run=2)


@of_kinds
def test_a_pickled_copy_goes_on_as_the_object_itself(
    kind: type, itself: Went, copied: Went
) -> None:
    assert itself.objects[kind], "no World has one: let a World go on with it, or name it in FIXED"
    assert itself.events == copied.events
    assert not itself.differ(copied, kind)


@of_kinds
def test_bad_samples_change_nothing_but_counts(kind: type, copied: Went, spoilt: Went) -> None:
    assert copied.events == spoilt.events
    assert not copied.differ(spoilt, kind, COUNTED)


@of_kinds
def test_what_is_restored_goes_on_as_what_was_saved(
    kind: type, restored: tuple[Went, Went]
) -> None:
    first, second = restored
    assert len(first.events) == len(second.events) > 10
    assert not first.differ(second, kind, ["Lifecycle._saved"])  # the one was saved, to be read


@pytest.mark.parametrize("kind", [kind for kind in KINDS if hasattr(kind, "snapshot")])
def test_what_is_restored_is_what_was_saved(kind: type, begun: bytes) -> None:
    world = pickle.loads(begun)
    saved, restored = (objects(of.banks)[kind] for of in (world, World(world.saved())))
    for one, other in zip(saved, restored, strict=True):
        assert difference(one.snapshot(), other.snapshot()) is None


@of_kinds
def test_a_leg_that_is_reset_is_as_new(kind: type, reset: tuple[Went, Went]) -> None:
    used, new = reset
    assert used.events == new.events
    assert not used.differ(new, kind, KEPT)
