"""Changes of the robot over time: what can drift, how far, and what holds now.

A value is always absolute against nominal: saying the same again changes nothing, and nominal
takes a drift back.  A new drift takes its joints over from whatever drifted there before, from the
value they have at that moment: a ramp starts there, a pulse returns there.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from typing import Final, NamedTuple, get_args

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import Drift, DriftKind, DriftShape
from adaptive_contact_sim.elements import HEXAPOD, Layout
from adaptive_contact_sim.limits import check_number, check_word

# A random walk takes a step this often, s.
_WALK_STEP_S: Final = 0.1


class Kind(NamedTuple):
    """One kind of drift."""

    unit: str  # of its value
    # nominal, low, high: the value without drift, and what is accepted
    nominal: float
    low: float
    high: float
    usual: str  # the range seen or assumed in the field, docs/simulator.md
    meaning: str  # one line


KINDS: Final[dict[DriftKind, Kind]] = {
    "mass": Kind("kg", 0.0, 0.0, 0.5, "0-0.1", "mud or payload at the foot"),
    "friction": Kind("factor", 1.0, 0.1, 10.0, "1-6", "Coulomb friction, stiction"),
    "viscous": Kind("factor", 1.0, 0.1, 50.0, "1-10", "viscous friction"),
    "supply": Kind("V", 12.0, 7.0, 14.0, "9-12", "supply voltage"),
    "compliance": Kind("factor", 1.0, 0.125, 8.0, "1-4", "compliance slope, of 32 steps"),
    "winding": Kind("factor", 1.0, 0.7, 2.0, "1-1.16", "winding resistance, +0.4 %/K"),
    "backlash": Kind("rad", 0.0, 0.0, 0.07, "0-0.026", "backlash of the gear"),
    "offset": Kind("rad", 0.0, -0.2, 0.2, "+-0.015", "horn turned on its shaft"),
    "dropout": Kind("share", 0.0, 0.0, 0.5, "0.0003-0.03", "missing readings"),
}


class Injection(NamedTuple):
    """A drift, and when it begins, s of simulated time."""

    drift: Drift
    at_s: float = 0.0


def check(drift: Drift, layout: Layout | None = None) -> None:
    """Check that a drift can be made, of a robot where one is given.

    Raises:
        ConfigurationError: what was found, and what is expected.
    """
    check_word("drift", drift.kind, KINDS)
    kind = KINDS[drift.kind]
    if layout is not None:
        layout.servo_indices(drift.leg, drift.joint)
    if drift.kind == "mass" and drift.joint is not None:
        raise ConfigurationError("mass hangs at the foot, not at a joint; leave out the joint")
    if not kind.low <= drift.value <= kind.high:
        raise ConfigurationError(
            f"{drift.kind} of {drift.value:g} {kind.unit}; expected {kind.low:g} to {kind.high:g} "
            f"{kind.unit} ({kind.nominal:g} is nominal, {kind.usual} usual)"
        )
    check_word("shape", drift.shape, get_args(DriftShape))
    check_number("a drift's duration", drift.duration_s, 0.0, 1e6, "s")
    if drift.shape != "step" and drift.duration_s == 0.0:
        raise ConfigurationError(
            f"a {drift.shape} needs a duration above 0 s; give duration=SECONDS"
        )
    if drift.seed < 0:
        raise ConfigurationError(f"drift seed is {drift.seed}; expected 0 or more")


class _Course:
    """A drift under way, on the joints it took."""

    def __init__(self, injection: Injection, before: Array, layout: Layout) -> None:
        drift = injection.drift
        self.kind = drift.kind
        self.joints = layout.servo_indices(drift.leg, drift.joint)
        self._start_s = injection.at_s
        self._drift = drift
        self._before = before[self.joints]
        self._walk = _walk(drift) if drift.shape == "walk" else None

    def over(self, t_s: float) -> bool:
        """Whether its value will not change any more."""
        return self._drift.shape == "step" or t_s - self._start_s >= self._drift.duration_s

    def at(self, t_s: float) -> Array:
        """Value of every joint it took."""
        drift, since = self._drift, t_s - self._start_s
        target = np.full(self.joints.size, drift.value)
        if drift.shape == "step":
            return target
        if drift.shape == "pulse":
            return target if since < drift.duration_s else self._before
        if self._walk is None:
            share = min(since / drift.duration_s, 1.0)
        else:
            share = float(self._walk[min(int(since / _WALK_STEP_S), self._walk.size - 1)])
        return np.asarray(self._before + share * (target - self._before))


class DriftSchedule:
    """All drifts of a run: those to come, those under way, what holds."""

    def __init__(
        self,
        injections: Iterable[Injection] = (),
        *,
        dropout: float = 0.0,
        layout: Layout = HEXAPOD,
    ) -> None:
        size = layout.n_servos
        self._layout = layout
        self._nominal: dict[str, float] = {name: kind.nominal for name, kind in KINDS.items()}
        self._nominal["dropout"] = dropout
        self._values: dict[str, Array] = {
            name: np.full(size, self._nominal[name]) for name in KINDS
        }
        self._pending: list[Injection] = []
        self.begun: list[Injection] = []  # in order of time
        self._courses: list[_Course] = []  # likewise: where two hold a joint, the later one counts
        self._moving = False
        for injection in injections:
            self.add(injection)

    def add(self, injection: Injection) -> None:
        """Schedule a drift.

        Raises:
            ConfigurationError: it cannot be made.
        """
        check(injection.drift, self._layout)
        if not 0.0 <= injection.at_s < float("inf"):
            raise ConfigurationError(f"a drift begins at {injection.at_s} s; expected 0 s or later")
        bisect.insort(self._pending, injection, key=lambda i: i.at_s)

    def due(self, t_s: float) -> bool:
        """Whether something begins or changes at this time."""
        return self._moving or bool(self._pending and self._pending[0].at_s <= t_s)

    def values(self, t_s: float) -> dict[str, Array]:
        """Move on to a time, which never goes back.

        Returns:
            Per kind, (L, J) values now in force.
        """
        while self._pending and self._pending[0].at_s <= t_s:
            injection = self._pending.pop(0)
            self.begun.append(injection)
            # What is under way there goes on to this moment, and ends.
            self._advance(injection.at_s)
            before = self._values[injection.drift.kind]
            self._courses.append(_Course(injection, before, self._layout))
        self._advance(t_s)
        return {
            name: value.reshape(len(self._layout.legs), -1) for name, value in self._values.items()
        }

    def holds(self) -> dict[str, dict[str, dict[str, float]]]:
        """What holds now, kind by leg by joint, nominal values left out."""
        found: dict[str, dict[str, dict[str, float]]] = {}
        for name, values in self._values.items():
            for k in np.flatnonzero(np.abs(values - self._nominal[name]) > 1e-12):
                a, b = divmod(int(k), len(self._layout.joints))
                leg, joint = self._layout.legs[a], self._layout.joints[b]
                found.setdefault(name, {}).setdefault(leg, {})[joint] = float(values[k])
        return found

    def _advance(self, t_s: float) -> None:
        for course in self._courses:
            self._values[course.kind][course.joints] = course.at(t_s)
        self._moving = not all(course.over(t_s) for course in self._courses)


def _walk(drift: Drift) -> Array:
    """Shares of the way to the value, a random walk held between 0 and 1 by reflection.

    Its standard deviation over the whole duration is that of the way itself.
    """
    n = max(1, round(drift.duration_s / _WALK_STEP_S))
    rng = np.random.default_rng([drift.seed, 0xD41F7])
    path = np.abs(np.cumsum(rng.standard_normal(n)) / np.sqrt(n)) % 2.0
    return np.asarray(np.where(path > 1.0, 2.0 - path, path))
