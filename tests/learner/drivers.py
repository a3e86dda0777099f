"""The compiled steps of a tick, one at a time, for a leg by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from adaptive_contact.detect import layout
from adaptive_contact.detect.contact import MIN_LIFT_ROWS, begin_labels, enter_row, note_hole
from adaptive_contact.detect.history import (
    MAX_STEP_RAD_S,
    enter_residual,
    push_command,
    repair,
    restart_history,
    take,
)
from adaptive_contact.detect.leg_batch import LegBatch, LegPlace
from adaptive_contact.detect.source import take_phase
from adaptive_contact.detect.swing import follow_command, follow_foot, place_foot
from adaptive_contact.detect.swing_judge import SwingJudge
from adaptive_contact.detect.swing_labels import LAST_TICKS, close_swing, let_go_row, not_pushed
from adaptive_contact.learn.lifecycle import ready_for_changes
from adaptive_contact.model import Baseline, leg_library
from adaptive_contact.model.labelled_swing import Rows
from adaptive_contact.model.library import with_changes
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.wire import ServoSample

from .ticks import Tick, rows_of

PERIOD_NS = 20_000_000
_PHASES = {None: -1, "stance": 0, "swing": 1}


def place_of(robot: Robot, leg: Leg) -> LegPlace:
    """Arrays of one leg that has seen nothing."""
    plain = leg_library(robot, leg)
    library = with_changes(plain, np.zeros((plain.size, len(leg.joints))))
    return LegPlace(LegBatch([leg], library, [0.005], PERIOD_NS, max_step=MAX_STEP_RAD_S * 0.02))


class Arrays(NamedTuple):
    """What a tick has of one leg, as `arrays_of` names it."""

    sample: layout.Sample
    source: layout.Source
    swing: layout.Swing
    past: layout.Past
    model: layout.Model
    noise: layout.Noise
    kept: layout.Kept


def arrays_of(place: LegPlace) -> Arrays:
    """The arrays of a leg, views of those of its batch."""
    given = {**vars(place.batch), **place.batch.table._asdict()}

    def array(name: str) -> Any:
        return given[name] if name in layout.SHARED else given[name][place.row]

    return Arrays(*(of(*map(array, of._fields)) for of in get_type_hints(Arrays).values()))


class Swings:
    """Follows the swings of a leg, as a tick does."""

    def __init__(self, robot: Robot, leg: Leg | None = None) -> None:
        leg = robot.leg("rf") if leg is None else leg
        self.place = place_of(robot, leg)
        self.judge = SwingJudge(leg, self.place)

    def follow(self, sample: ServoSample, *, awaited: bool = False) -> bool:
        """A sample's phase and command; True where the next swing ends one that was awaited."""
        b, joints = self.place.batch, len(self.place.batch.desired[0])
        angles = [(list(v) * joints)[:joints] for v in (sample.measured, sample.desired)]
        b.measured[0], b.desired[0] = angles
        leg = self.place.record
        leg["phase"], leg["seq"] = _PHASES[sample.phase], sample.seq
        ended: bool = follow_command(
            leg, arrays_of(self.place).swing, b.measured[0], b.desired[0], awaited
        )
        return ended

    def observe(self, measured: Sequence[float]) -> None:
        """Where the leg is."""
        follow_foot(self.place.record, arrays_of(self.place).swing, np.array(measured))

    def take(self, sample: ServoSample) -> None:
        """All of a sample."""
        self.follow(sample)
        self.observe(sample.measured)

    @property
    def cleared(self) -> bool:
        """The foot was off the ground before."""
        return bool(self.place.record["cleared"])


class Readings:
    """Repairs the readings of a leg whose model expects the same movement in every tick."""

    def __init__(self, robot: Robot, baseline: Baseline, expected: np.ndarray) -> None:
        model = ready_for_changes(baseline.legs["rf"]).model
        batch = LegBatch(
            [robot.leg("rf")], model.library, [0.005], PERIOD_NS, max_step=MAX_STEP_RAD_S * 0.02
        )
        self.place, self._expected = LegPlace(batch), expected

    def move(self, reading: np.ndarray, valid: list[bool] | None = None) -> np.ndarray:
        """One tick; the residual it left."""
        self.observe(reading, valid)
        residual = self.place.residuals[0].copy()
        b, leg = self.place.batch, self.place.record
        push_command(leg, b.window[0], b.depths, reading)
        b.increment[0] = self._expected
        leg["predicted"] = True
        return residual

    def leave_range(self, leverage: float) -> None:
        """Have the motion lie so far out of what the model was fitted to, in every tick."""
        b, leg = self.place.batch, self.place.record
        leg["has_domain"] = True
        b.domain[0], b.theta[0] = 0.0, 0.0
        b.domain[0, 0, 0], b.theta[0, 0] = np.sqrt(leverage), 1.0

    def observe(self, reading: np.ndarray, valid: list[bool] | None = None) -> None:
        """Take a reading in."""
        b, leg, own = self.place.batch, self.place.record, arrays_of(self.place)
        flags = np.ones(3, dtype=bool) if valid is None else np.array(valid)
        measured = np.asarray(reading, dtype=float)
        repair(leg, own.past, own.model, measured, flags, valid is not None and not all(valid))
        take(own.past.reading, own.past.increment, own.past.window, own.past.history, b.lags)
        enter_residual(leg, own.past.theta, own.past.thetas)

    def restart(self) -> None:
        """Drop the past."""
        restart_history(self.place.record, self.place.batch.suspects[0])

    @property
    def substituted(self) -> bool:
        """The last reading of a joint was replaced by the model's prediction."""
        return bool(self.place.record["bad"])

    @property
    def unlearned(self) -> bool:
        """A reading repeats itself, and no row of the tick is learned."""
        return bool(self.place.record["repeats"])

    @property
    def usable(self) -> int:
        """Sound residuals, the newest in a row."""
        return int(self.place.record["usable"])

    @property
    def full(self) -> bool:
        """The window holds enough for a prediction."""
        return bool(self.place.record["filled"] >= self.place.record["length"])


class Labels:
    """Holds back the rows of a swing, as a tick does, and hands them on."""

    def __init__(self, robot: Robot) -> None:
        self.place = place_of(robot, robot.leg("rf"))
        self.place.record["gated"] = self.place.record["learning"] = True
        self._seen: list[Tick] = []
        self._lift_taken = False

    def begin(self) -> None:
        """A swing begins."""
        begin_labels(self.place.record)
        self._seen, self._lift_taken = [], False

    def discard(self) -> None:
        """The swing was broken off."""
        begin_labels(self.place.record)
        self.place.record["broken"] = True

    def hole(self) -> None:
        """Readings were lost."""
        note_hole(self.place.record, self.place.batch.rows[0])

    def add(self, row: Tick, ticks: int, *, descending: bool) -> None:
        """Enter a tick."""
        b, leg = self.place.batch, self.place.record
        leg["ticks"], leg["rising"], leg["cleared"], leg["at_ns"] = (
            ticks, row.lift, row.cleared, row.t_ns,
        )  # fmt: skip
        own, before = arrays_of(self.place), int(leg["row_n"])
        leg["squared"] = row.nis * len(b.unit[0])
        enter_row(
            leg, own.swing, own.past, own.noise, own.kept, row.value, row.was_free, descending
        )
        if int(leg["row_n"]) > before:
            self._seen = [*self._seen[:before], row]
        elif int(leg["row_n"]) == before and before and b.rows[0, before - 1]["t_ns"] == row.t_ns:
            self._seen = [*self._seen[1:], row]
        if leg["row_n"] + 2 > b.rows.shape[1]:
            b.grow()

    def take_lift(self) -> Rows | None:
        """The rows of the lift, once its top is past."""
        leg = self.place.record
        if not leg["topped"] or leg["broken"] or self._lift_taken or not leg["lift_n"]:
            return None
        self._lift_taken = True
        count = int(leg["lift_n"])
        first, _ = let_go_row(self.place.batch.rows[0], count)
        return self._rows(first, count) if count - first >= MIN_LIFT_ROWS else None

    def alarm(self, onset_ns: int, period_ns: int) -> Rows:
        """A contact was reported."""
        b, leg = self.place.batch, self.place.record
        lift, count = int(leg["lift_n"]), int(leg["row_n"])
        kept, free, near_ns = close_swing(
            b.rows[0], b.row_values[0], lift, int(leg["commanded_n"]), count, onset_ns, period_ns,
            int(leg["hole_ns"]),
        )  # fmt: skip
        rows, rest = self._rows(lift, free), self._rows(free, count)
        if rest and rest.records[0]["push"]:
            rows = rows.then(not_pushed(rest, near_ns))
        times = b.rows[0, :kept]["t_ns"].tolist()
        self._seen = [tick for tick in self._seen[:lift] if tick.t_ns in times]
        leg["lift_n"] = leg["row_n"] = kept
        leg["closed"] = True
        return rows

    def resolve(self) -> Rows:
        """The next stance has begun."""
        leg = self.place.record
        lift, count = int(leg["lift_n"]), int(leg["row_n"])
        rows = self._rows(lift, max(lift, count - LAST_TICKS))
        leg["row_n"], leg["closed"] = leg["lift_n"], True
        return rows

    def _rows(self, first: int, last: int) -> Rows:
        found = self.place.batch.rows[0, first:last]
        return rows_of(
            [
                row._replace(lift=bool(kept["lift"]), nis=float(kept["nis"]))
                for row, kept in zip(self._seen[first:last], found, strict=True)
            ]
        )


class Phases:
    """Follows the phases that a leg's samples say, as a tick does."""

    def __init__(self, robot: Robot, leg: Leg) -> None:
        self.place = place_of(robot, leg)

    def take(self, sample: ServoSample) -> None:
        """A sample's phase and command."""
        b, leg, height = self.place.batch, self.place.record, 0.0
        desired = np.array(sample.desired)
        if leg["has_lengths"]:
            place_foot(desired, b.links[0], b.axis_kinds[0], b.now)
            height = float(b.now[2])
        phase = _PHASES[sample.phase]
        take_phase(leg, phase, desired, height, b.phase_before[0], b.parts[0])

    @property
    def swapped(self) -> bool:
        """Stance is published as swing."""
        return bool(self.place.record["swapped"])
