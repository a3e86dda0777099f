"""Lays out the state of several legs' ticks: one row of every array is one leg.

Scalars stand in one structured array, so that compiled code names them.  Vectors, which have as
many entries as a leg has joints, say, stand side by side in one array for each kind of number, so
that what a tick uses of a leg is close together.  Only what has more dimensions is an array of its
own.
"""

from __future__ import annotations

import ctypes
import struct
from collections import namedtuple
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.compiled import Handover, compiled, records
from adaptive_contact.model.labelled_swing import ROW
from adaptive_contact.robot.description import DetectorSettings
from adaptive_contact.robot.gait_phase import LOW_TICKS

DEPTH: Final = 3  # ticks of the longest window of the statistic
HEIGHTS: Final = 12  # of the foot, remembered
ASKED: Final = 4  # ways commanded, remembered
SWINGS: Final = 5  # lengths of swings, remembered
PATH_TICKS: Final = 400  # commands of a swing, remembered
RING: Final = 101  # ticks by which the rate is judged, at most
VALUES: Final = 8  # refused readings remembered
KEPT: Final = 3000  # samples kept for judgements of a whole motion, a minute at 50 Hz

# What a tick finds of a leg, as bits: what Python has to do for the leg.
RESTARTED: Final = 1  # the source began again
BROKE_OFF: Final = 2  # a gap or fault: the swing is not learned
RESOLVED: Final = 4  # the swing before has ended: its rows can be labelled
BEGAN: Final = 8  # a swing begins
WEIGHED: Final = 16  # a residual was weighed that may be learned
TOPPED: Final = 32  # the top of the lift has just been passed
DECIDED: Final = 64  # a contact began or ended: an event
TOUCHED: Final = 128  # and it began
RATE_OFF: Final = 512  # ticks are not as far apart as described
SOURCE: Final = 2048  # its readings or phases begin or cease to be false
TURNED: Final = 4096  # the command turns to stance
RELEASE_PENDING: Final = 1024  # a contact is to end that no tick can decide any more

f8, i8, i4, b1 = np.float64, np.int64, np.int32, np.bool_

# The vectors of one leg, by kind; lengths are numbers, or J joints, p terms, w places of a window.
VECTORS: Final[dict[Any, dict[str, int | str]]] = {
    f8: {
        "measured": "J",  # the sample, rad; both side by side at the start
        "desired": "J",
        "seam": "J",  # the command before, to unwrap by
        "lower": "J",  # where the servos stop, whatever is commanded
        "upper": "J",
        "command": "J",  # in force, and the one before
        "before": "J",
        "phase_before": "J",  # the command before, within a part of a swing
        "low": LOW_TICKS,  # m, heights of the commanded foot
        "last_desired": "J",
        "last_measured": "J",  # with substitutes
        "last_read": "J",  # as it was read
        "asked": ASKED,  # m, ways commanded
        "commanded": 3,  # m, places of the foot: commanded, measured, at the swing's start
        "foot": 3,
        "start": 3,
        "heights": HEIGHTS,  # m
        "window": "w",  # measured, then commands, then preview, newest first, rad
        "began_window": "w",  # as the swing began
        "increment": "J",  # predicted, rad
        "theta": "p",  # regressors of the prediction in hand
        "reach": "J",  # rad, largest movement in a tick
        "last_good": "J",  # the last reading that was not replaced
        "last": "J",  # and as it was read
        "values": VALUES + 1,  # refused, rad
        "sigma": "J",  # rad, deviation of residuals at the start
        "unit": "J",  # variance of this tick's residuals over the baseline's
        "scores": DEPTH,  # test ratios of this tick
        "reading": "J",  # rad, of this tick, repaired
        "shrink": "J",  # reciprocal roots of `unit`
        "gradient": "J",  # m per rad, of the foot's height
        "target": "J",  # rad, movement of this tick
        "ahead": "J",  # rad, movement predicted in a stance
        "lever": "J",  # m per rad, of the foot's height as it was read
        # of the command since it last turned: the furthest, m or rad, see `count_turns`
        "turn_at": "J",
    },
    i8: {
        "lengths_ticks": SWINGS,
        "counts": VALUES + 1,  # of refused values
        "stale": "J",  # ticks in a row that a reading was taken for stale
        "turning": "J",  # where the command of that is: 0 low, 1 lifted, 2 being lowered
        "turns": "J",  # lifts and lowerings commanded since a swing that was judged
        "axis_kinds": "J",  # how a joint turns, see `tabulate`
    },
    b1: {
        "valid": "J",  # readings of the sample
        "suspects": "J",  # suspect readings of the tick before
        "refused": "J",  # readings refused
    },
}  # fmt: skip
_NAMES: Final = [name for of_kind in VECTORS.values() for name in of_kind]
# Numbers of the vectors, by name.
SLOT: Final[Any] = namedtuple("SLOT", _NAMES)(*range(len(_NAMES)))

# The scalars of one leg, by what they are of.
LEG: Final = np.dtype(
    [
        # Of the sample; `SAMPLE` writes these.
        ("t_ns", i8),  # stamp
        ("seq", i8),
        ("lost", i8),  # samples before it, by its number
        ("phase", i4),  # that it states: -1 none, 0 stance, 1 swing
        ("accepted", b1),  # the leg has a sample in this tick
        ("restart", b1),  # it is the first of a source
        ("has_valid", b1),  # it says which readings are valid
        # Of free motion; `FREE` writes these.
        ("variance_scale", f8),  # in force
        ("changed", b1),  # the leg may differ from its model
        ("inflated", b1),  # the covariance is
        ("from_prior", b1),  # the leg began with a prior
        ("sure", b1),  # the leg is judged by a model that fits it
        ("after_known", b1),  # its noise after the turn to stance is
        # Description.
        ("has_lengths", b1),  # geometry is known: `lengths_m`
        ("leg_size", f8),  # of the leg, in the hexapod's; limits of lengths are in proportion
        ("quantum", f8),  # rad, position step of the servos
        ("max_step", f8),  # rad per tick, beyond which a reading is impossible
        ("length", i4),  # samples in a row before a prediction
        ("period_ns", i8),
        ("has_model", b1),  # a model is in force
        ("learning", b1),  # anything is learned at all
        # The owner's settings, see `DetectorSettings`.
        ("weak_share", f8),
        ("shaken_share", f8),
        ("lasting_ns", i8),
        ("touch_push", f8),
        ("strike_loss", f8),
        ("carries_push", f8),
        ("hangs_push", f8),
        ("touches_above", f8),
        ("touches_below", f8),
        # Stream and clock.
        ("at_ns", i8),  # scheduled time of the tick
        ("has_seam", b1),  # a command before is known, to unwrap by
        ("lateness", f8),  # of the stamp behind its schedule, ticks of the schedule
        ("pace", f8),  # periods from a tick of the schedule to the next; 1 unless a loop slips
        ("stretch", f8),  # of the last step beyond a period, periods
        ("late", i4),  # -1 unknown, 0 on time, 1 late
        ("rate_off", b1),  # ticks are not as far apart as described
        ("unfinished", b1),  # the second half of the tick is to come
        ("preview_n", i4),  # commands to come that the sample has
        ("due_ns", i8),  # scheduled time of the next tick
        ("found_ns", f8),  # mean distance of ticks; NaN while unknown
        ("rate_ticks", i4),  # ticks by which the rate is judged
        ("ring_n", i8),  # stamps taken into the ring
        ("burst", i4),  # ticks that arrive together, stamped on arrival; 0 for none
        ("bursts", i4),  # of these in a row
        ("burst_ns", i8),  # stamp and number of the first of the newest burst
        ("burst_seq", i8),
        ("stamp_ns", i8),  # newest, as it was sent
        ("lacking", i4),  # samples for which the lack of a preview is still reported
        ("kept_n", i8),  # samples kept since the source began
        ("missed", i8),  # ticks without a sample before this one; -1 after a pause
        ("accepted_n", i8),  # samples not yet counted by the learner
        ("total_n", i8),  # samples, never reset
        ("jitter_mean", f8),  # of deviations from the schedule, periods
        ("jitter_square", f8),  # and of their squares
        ("spread", f8),  # variance of the steps, periods²
        ("votes", f8),  # weight of ticks that show whether readings are late
        ("shown", f8),  # and what they show, 0 on time, 1 late
        ("misread", b1),  # angles are not counted as described
        # Swing: the command.
        ("ticks", i4),  # of the swing, 1 at its first, 0 in stance
        ("after", i4),  # of these after the turn to stance, while a touch is awaited
        ("same", i4),  # samples in a row that repeat the one before
        ("swing_phase", b1),  # the command shows a swing
        ("has_phase", b1),  # the samples carry a phase
        ("phase_lacking", i4),  # ticks for which the lack of a phase is remembered
        ("whole", b1),  # the swing began after a stance that was seen
        ("stood", b1),  # a stance was seen
        ("heights_n", i4),  # heights taken into the ring
        ("low_n", i4),  # heights of the command, for its low
        ("low_next", i4),  # and where the next one goes
        ("apex", f8),  # m, highest command of an inferred swing
        ("still", i4),  # ticks in a row without a change of that height
        ("has_desired", b1),  # a command is known
        ("has_measured", b1),  # a reading is known
        ("commanded_up", b1),  # the newest command rises
        ("descent", b1),  # direction of the command in force
        ("asked_n", i4),  # ways commanded that were taken
        ("lengths_n", i4),  # lengths of swings that were taken
        ("path_n", i4),  # commands of the swing that were kept
        ("path_first", i8),  # seq of the first of them
        ("path_last", i8),  # and of the last
        # Swing: the foot.
        ("rising", b1),  # the measured foot rises
        ("cleared", b1),  # the foot is off the ground by its height
        ("obstructed", b1),  # the foot does not follow its command
        ("rise", f8),  # m, highest above where the swing began
        ("moved", f8),  # m, furthest from there
        ("surface", f8),  # m, height to pass before it is cleared
        ("touch_at", f8),  # m, height at the last onset
        ("touch_before", f8),  # m, height three ticks before it
        ("top", f8),  # m, highest in the swing
        ("lowest_m", f8),  # m, lowest in the swing
        ("fallen", f8),  # m below the top at the first onset; NaN without
        # History.
        ("filled", i4),  # samples in the window, up to `length`
        ("predicted", b1),  # the reading to come, or just taken, has a prediction
        ("reading_variance", f8),  # factor on the variance, near replaced readings
        ("usable", i4),  # residuals in a row that may be judged
        ("sound", b1),  # a reading of this tick is usable
        ("bad", b1),  # a reading of this tick was replaced
        ("repeats", b1),  # a reading of this tick repeats itself where the model expects motion
        ("seen", b1),  # a raw reading before
        ("impossible", i4),  # impossible readings in a row
        ("unsure", i4),  # ticks left after a replaced reading
        ("refused_n", i8),  # readings replaced, not yet counted
        ("reach_ticks", i8),  # predictions by which the reach is known
        ("values_n", i4),  # refused values remembered
        ("thetas_n", i4),  # rows of regressors kept
        # Statistic.
        ("context", i4),  # index of the whitening
        ("has_domain", b1),  # a training domain is known
        ("root_n", i4),  # terms of a joint in its root
        ("opposed", f8),  # last residual against the predicted motion, deviations
        ("clock_most", f8),  # largest stretch in question, periods
        ("clock_left", i4),  # ticks it stays in question
        # Contact.
        ("contact", b1),  # the leg touches
        ("loaded", b1),  # not yet free since the swing began
        ("calm", i4),  # ticks in a row close to free motion
        ("calm_since", i8),  # ns, first of them
        ("usual", f8),  # median test ratio of contacts, and how many it is of
        ("usual_n", i4),
        ("struck", i4),  # first tick in which the lift looked like a strike, 0 for none
        ("struck_before", i4),  # and that of the swing before
        ("doubtful_n", i4),  # ticks in a row that show less than a touch of this leg does
        ("doubtful_ns", i8),  # and when that began
        # Labels of the swing in hand.
        ("unresolved", b1),  # the swing is not resolved
        ("lift_n", i4),  # rows of the lift
        ("commanded_n", i4),  # of these, those whose command went up
        ("row_n", i4),  # rows
        ("topped", b1),  # the top of the lift is past
        ("closed", b1),  # no more rows of the descent are taken
        ("broken", b1),  # the swing cannot be labelled
        ("top_seen", b1),  # the top was flagged
        ("fit_n", i4),  # ticks in a row up to now that fit the model
        ("fit_before", i4),  # and of the row before
        ("misfit_ns", i8),  # the tick that ended it
        ("fits", b1),  # the leg moved as its model says, in the lift or before a contact
        ("began_full", b1),  # the window was full as the swing began
        ("hole_ns", i8),  # -1 for none
        ("push", f8),  # evidence of a push that goes on, deviations
        ("push_ns", i8),  # the tick that it began with
        ("resolved_first", i4),  # first row of the descent that was resolved
        ("resolved_last", i4),  # and one after the last
        ("resolved_whole", b1),  # `whole`, `rise` and `fallen` of that swing
        ("resolved_rise", f8),
        ("resolved_fallen", f8),
        ("resolved_down", b1),  # whether the foot came down
        # Swings without a touch.
        ("quiet", i4),  # ticks in a row after the turn without a sign of a touch
        ("untouched", i8),  # swings that ended without a touch
        ("untouched_ns", i8),  # -1 before the first
        # What the source sends.
        ("phase_part", i4),  # -1 unknown, 0 stance, 1 swing
        ("part_whole", b1),  # the part in hand was seen from its start
        ("swapped", b1),  # swing and stance are swapped
        ("unjudged", i4),  # the most of `turns`, for as long as no swing ended that was judged
        ("weighed", b1),  # the descent of the swing is judged
        ("slow_swings", i4),  # in a row whose command is slower than in the stance
        ("has_before", b1),  # a command before is known
        ("false_readings", i4),  # by the last looks: 0 none, 1 copies, 3 old or held ones
        ("cause", i4),  # 0 none, 1 echo, 2 phase, 3 stale
        ("began_ns", i8),  # of the last swing but one
        ("began_n", i8),  # samples until then
        ("began_next_ns", i8),  # and of the last
        ("began_next_n", i8),
        ("began_count", i4),  # of these that are known, 1 or 2
        # State in every tick, see `state.py`.
        ("foreseen", b1),  # the reading to come has a prediction in a stance
        ("command_m", f8),  # height of the commanded foot
        ("lowest_command_m", f8),  # and its range of late
        ("highest_command_m", f8),
        ("high_ticks", i8),  # ticks by which the free sizes are known, and the loaded one
        ("low_ticks", i8),
        ("push_size", f8),  # m, of free motion; of the loaded leg
        ("loaded_push", f8),
        ("misfit_size", f8),
        ("push_sum", f8),  # of late, in its size
        ("misfit", f8),  # of this tick
        ("command_odds", f8),  # nats
        ("pressed_n", i4),  # ticks in a row that depart from the free path, low
        ("idle_n", i4),  # ticks of low commands without that
        ("stance_n", i4),  # ticks of the stance in hand whose push is summed up; below 0: none yet
        ("stance_push", f8),  # the sum
        ("stance_most", f8),  # the largest `push` in it
        ("pressed_stances", i4),  # in a row in which that was large
        ("load", f8),  # mean push of the last stances
        ("load_n", i4),  # stances in it
        ("carried_load", f8),  # the same while the leg carried
        ("carried_n", i4),
        ("kept_ticks", i4),  # ticks in a row that were not judged
        ("carried", b1),  # a stance has departed from the free path
        ("slight", b1),  # it carries by stances that go on pushing alone
        ("hanging", b1),  # the last stances showed no load
        ("stands", i4),  # by the loads of all legs the robot 1 stands, -1 hangs; 0 unknown
        ("p", f8),  # probability that the foot carries; NaN while unknown
        ("touches", b1),  # the state, by hysteresis
        # What is reported of contacts.
        ("reported", b1),  # the contact by the last event
        ("withholds", b1),  # contacts are not reported
        ("withholds_begun", b1),  # nor those of a swing that has just begun
        ("release_pending", b1),  # a release is to be sent
        # What this tick found.
        ("found", i8),  # flags, see the top of this file
        ("score", f8),  # test ratio at the decision
        ("onset_ns", i8),  # estimated begin or end of the contact
        ("squared", f8),  # length of the whitened residual, of one tick, squared
        ("free_n", i8),  # free residuals kept
    ],
    align=True,
)

_C_TYPES: Final[dict[Any, Any]] = {
    f8: ctypes.c_double,
    i8: ctypes.c_int64,
    i4: ctypes.c_int32,
    b1: ctypes.c_bool,
}


class LegScalars(ctypes.Structure):
    """Names the scalars of one leg for Python: numpy takes fifteen times as long for each."""

    __slots__ = ()  # a name that there is not is refused
    _fields_ = [(name, _C_TYPES[LEG[name].type]) for name in LEG.names or ()]


assert ctypes.sizeof(LegScalars) == LEG.itemsize


def scalars_of(legs: NDArray[np.void], row: int) -> Any:
    """Return the scalars of a leg, of several, to be read and written by name."""
    return LegScalars.from_buffer(legs.data, row * LEG.itemsize)


# Write the first scalars of a leg in one call each; one by one they take four times as long.
SAMPLE: Final = struct.Struct("3qi3?")
FREE: Final = struct.Struct("d5?")
assert LEG.fields is not None
FREE_AT: Final[int] = LEG.fields["variance_scale"][1]


# Of the state in every tick.
STATE: Final = (
    "foreseen", "command_m", "lowest_command_m", "highest_command_m", "high_ticks", "low_ticks",
    "push_size", "loaded_push", "misfit_size", "push_sum", "misfit", "command_odds", "pressed_n",
    "idle_n", "stance_n", "stance_push", "stance_most", "pressed_stances", "load", "load_n",
    "carried_load", "carried_n", "kept_ticks", "carried", "slight", "hanging", "stands", "p",
    "touches",
)  # fmt: skip

# The arrays of a `LegBatch`, as each half receives them.
_SHARED: Final[dict[str, tuple[Any, int]]] = {
    "kind": (i8, 1), "first": (i8, 1), "entry": (i8, 1), "weight": (f8, 1), "knee": (f8, 1),
    "law": (i8, 1), "depths": (i8, 1), "some": (b1, 2), "room": (f8, 2), "now": (f8, 1),
    "sums": (f8, 2), "forms": (f8, 1),
}  # fmt: skip
SHARED: Final = tuple(_SHARED)  # by all legs: their library, and scratch
TICK: Final = Handover(
    legs=(LEG, 1), floats=(f8, 2), ints=(i8, 2), bools=(b1, 2), places=(i8, 2),
    preview_in=(f8, 3), ring=(i8, 3), kept_angles=(f8, 3), kept_stamps=(i8, 3),
    parts=(f8, 3), links=(f8, 3), path=(f8, 3),
    history=(f8, 4), thetas=(f8, 3), xi0=(f8, 3), coefficients=(f8, 3), whiten=(f8, 5),
    limits=(f8, 3), index=(i8, 3), per_scale=(f8, 3), root=(f8, 4), domain=(f8, 3), rows=(ROW, 2),
    row_values=(f8, 3), free_ring=(f8, 3), **_SHARED,
)  # fmt: skip
receive_tick: Final = TICK.receive


# The arrays of one leg, by what they are of.  Shapes and units stand at their names above, and in
# :class:`~adaptive_contact.core.detect.leg_batch.LegBatch`.
Sample = namedtuple("Sample", "measured desired valid preview_in seam lower upper command before")
Source = namedtuple(
    "Source",
    "ring kept_angles kept_stamps parts phase_before turn_at turning turns",
)
Swing = namedtuple(
    "Swing",
    "links axis_kinds low lengths_ticks last_desired last_measured last_read path asked commanded "
    "foot start heights gradient lever now",
)
Past = namedtuple(
    "Past",
    "window began_window history thetas theta increment reach last_good last suspects stale "
    "refused values counts reading ahead some room",
)
Model = namedtuple("Model", "kind first entry weight knee law xi0 coefficients domain depths forms")
Noise = namedtuple(
    "Noise",
    "sigma unit whiten index per_scale root limits scores shrink sums",
)
Kept = namedtuple("Kept", "rows row_values target free_ring")

# Each vector's array, and its number.
SOURCES: Final = ("floats", "ints", "bools")
PLACES: Final = {
    name: (source, getattr(SLOT, name))
    for source, names in zip(SOURCES, VECTORS.values(), strict=True)
    for name in names
}
sample_of: Final = TICK.part(Sample, PLACES, SHARED)
source_of: Final = TICK.part(Source, PLACES, SHARED)
swing_of: Final = TICK.part(Swing, PLACES, SHARED)
past_of: Final = TICK.part(Past, PLACES, SHARED)
model_of: Final = TICK.part(Model, PLACES, SHARED)
noise_of: Final = TICK.part(Noise, PLACES, SHARED)
kept_of: Final = TICK.part(Kept, PLACES, SHARED)


@compiled
def copy_vector(of: Any, to: Any) -> None:
    """Copy a vector; numba takes half a second to compile what assigns it to a slice."""
    for k in range(len(of)):
        to[k] = of[k]


def vectors(count: int, lengths: Mapping[str, int]) -> tuple[list[NDArray[Any]], NDArray[np.int64]]:
    """Make the vectors of legs that have seen nothing.

    Args:
        count: of legs, L.
        lengths: J, p, w and t.

    Returns:
        One array of L rows for each kind, and the place of each vector in its row.
    """
    arrays: list[NDArray[Any]] = []
    places: list[Any] = []
    for kind, of_kind in VECTORS.items():
        ends = np.cumsum([lengths[n] if isinstance(n, str) else n for n in of_kind.values()])
        places += zip([0, *ends[:-1]], ends, strict=True)
        arrays.append(np.zeros((count, int(ends[-1])), dtype=kind))
    return arrays, np.array(places)


def new_legs(count: int, detector: DetectorSettings | None = None) -> Any:
    """Make scalars of legs that have seen nothing, by their owner's settings or the defaults."""
    detector = detector or DetectorSettings()
    legs = records(np.zeros(count, dtype=LEG))
    settings = {name: getattr(detector, name) for name in SETTINGS}
    settings["lasting_ns"] = round(1e6 * detector.lasting_ms)
    for name, value in {**BEGINNING, **settings}.items():
        legs[name] = value
    return legs


# Of the owner's settings, those that a tick reads as they are.
SETTINGS: Final = (
    "weak_share", "shaken_share", "touch_push", "strike_loss", "carries_push", "hangs_push",
    "touches_above", "touches_below",
)  # fmt: skip
# What a leg begins with, other than zeros.
BEGINNING: Final = {
    "late": -1, "rate_ticks": 9, "found_ns": np.nan, "descent": True, "reading_variance": 1.0,
    "sound": True, "leg_size": 1.0, "pace": 1.0, "variance_scale": 1.0, "loaded": True,
    "hole_ns": -1,
    "surface": -np.inf,
    "touch_at": -np.inf, "touch_before": -np.inf, "top": -np.inf, "fallen": np.nan,
    "apex": -np.inf, "asked_n": 1, "lowest_m": np.inf, "untouched_ns": -1, "phase_part": -1,
    "resolved_fallen": np.nan, "began_count": 1,
    "lowest_command_m": 1e3, "highest_command_m": -1e3, "p": np.nan,
    "stance_n": -1,
}  # fmt: skip
