"""Defines the messages on the wire, one frozen struct each.

Field names are the wire's; units are in the names or in the docstring.  Times are ``int``
nanoseconds of the *source's* clock.  All payloads carry ``v`` (contract version).  Unknown
fields are ignored when read, so that fields can be added without a new version.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import msgspec

VERSION: Final = 1
# No library looks further ahead than 20 ticks.  A payload holds tens of thousands of rows, and
# every leg would wait while they are looked at.
MAX_PREVIEW_TICKS: Final = 64
# Of all times and stamps.
NS_PER_S: Final = 1_000_000_000
# A joint reads within a few turns of zero; what is further out is not an angle of a leg.
MAX_ANGLE_RAD: Final = 8 * math.pi

Phase = Literal["swing", "stance"]
Status = Literal["learning", "valid", "adapting", "ambiguous", "silent"]
# Why a leg is ambiguous.
Doubt = Literal[
    "angles",
    "echo",
    "stale",
    "phase",
    "held",
    "far",
    "unsettled",
    "descents",
    "publishers",
    "unjudged",
    "unlearned",
    "unproved",
]
DriftKind = Literal[
    "mass",
    "friction",
    "viscous",
    "supply",
    "compliance",
    "backlash",
    "offset",
    "winding",
    "dropout",
]
DriftShape = Literal["step", "ramp", "pulse", "walk"]


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="v", tag=VERSION):
    """Base of every payload; each carries ``v``, the version of the contract, on the wire."""


class ServoSample(Message, frozen=True, kw_only=True, omit_defaults=True):
    """Holds the readings and commands of one leg in control tick k.

    Attributes:
        t_ns: source clock, strictly increasing per leg within a run.
        seq: control tick number, +1 per tick; a gap shows loss.
        measured: (J,) rad, read at the start of tick k.
        desired: (J,) rad, written right after that read, in force until tick k + 1.
        preview: (M, J) rad, commands of the next M ticks (64 at most), where the controller knows
            them.
        phase: as the gait controller states it, None where it does not.
        valid: (J,) False for a servo that did not answer or a reading known to be stale.
        run: new at each start of the source; a new run clears the window and keeps the model.
    """

    t_ns: int
    seq: int
    measured: list[float]
    desired: list[float]
    preview: list[list[float]] | None = None
    phase: Phase | None = None
    valid: list[bool] | None = None
    run: int | None = None


class ContactEvent(Message, frozen=True, kw_only=True, omit_defaults=True):
    """Reports a change of a leg's contact state, or a contact that is withheld.

    Attributes:
        t_ns, seq: of the sample that decided.
        onset_ns: estimated first touch (or release), at most ``t_ns``.
        score: statistic over threshold, above 1 for a contact.
        residual: (J,) rad, measured minus predicted at the deciding sample.
        withheld: ``contact`` is False because the leg is ambiguous, whatever its residuals say, or
            because its samples have stopped (``status`` is ``silent``).
        doubt: why the leg is ambiguous.
        p: probability that the foot carries, as in :class:`LegState`; None while unknown.
        foot_m, foot_sd_m: (3,) where the foot is at the deciding sample of a contact, in the leg's
            frame, and its standard deviation; None where the chain is not known.
        push: (3,) unit vector, by which way the foot is off its predicted place, likewise.
        push_up: vertical share of the push, 0 to 1.
    """

    leg: str
    t_ns: int
    seq: int
    onset_ns: int
    contact: bool
    status: Status
    score: float
    residual: list[float]
    model_version: int
    withheld: bool = False
    doubt: Doubt | None = None
    p: float | None = None
    foot_m: list[float] | None = None
    foot_sd_m: list[float] | None = None
    push: list[float] | None = None
    push_up: float | None = None


class LegState(Message, frozen=True, kw_only=True):
    """States whether the foot carries in one tick, stance included; sent to subscribers only.

    Attributes:
        t_ns, seq: of the sample.
        contact: whether the foot carries, by ``p`` with hysteresis; False while unknown.
        p: probability that it carries, None while unknown.
        known: whether ``contact`` and ``p`` say anything.
    """

    t_ns: int
    seq: int
    contact: bool
    p: float | None
    known: bool


class BufferCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Counts the confirmed contact-free data that the learner holds."""

    swings: int = 0
    lift_ticks: int = 0
    descent_ticks: int = 0


class DriftLevel(msgspec.Struct, frozen=True, kw_only=True):
    """Measures how far the leg has moved from its model.

    ``level`` is the residual level of recent lifts over the model's own, 1.0 without drift.
    """

    level: float = 1.0
    since_ns: int | None = None
    kind: str | None = None


class RefitCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Counts what became of the periodic sparse refits."""

    promoted: int = 0
    refused: int = 0
    rolled_back: int = 0
    last_reason: str | None = None


class LearnerStatus(Message, frozen=True, kw_only=True):
    """Reports the state of a leg's learner, once a second and at each change of status.

    Attributes:
        residual_rms: (J,) rad, of recent free ticks.
        noise_floor: (J,) rad, of the model that the leg began with, on swings it was not fitted to.
        ticks: samples accepted since start.
        rejects: samples refused, by reason.
        missed: samples lost, from gaps in ``seq``.
        restarts: times the source restarted; samples lost there are not counted.
        contact: whether the leg touches, by its last event.
        contacts: contacts reported up to ``t_ns``; a subscriber with fewer has lost some.
        withheld: contacts withheld so far, as the leg was ambiguous.
        swings: that began so far.
        swings_withheld: of these, those that began while contacts were withheld.
        doubt: why the leg is ambiguous, None while it is not.
        jitter_ms: root mean square of what ``t_ns`` has been off an even grid of late, ms.
        untouched: swings without a touch up to 16 ticks after their turn to stance, of those that
            could have shown one: most likely a hole.
        untouched_ns: when the last of them was over, None while there was none.
        note: one line for the operator when something is wrong, None when all is well.
    """

    leg: str
    t_ns: int
    status: Status
    model_version: int
    residual_rms: list[float]
    noise_floor: list[float]
    buffer: BufferCounts = BufferCounts()
    drift: DriftLevel = DriftLevel()
    refits: RefitCounts = RefitCounts()
    ticks: int = 0
    rejects: dict[str, int] = {}
    missed: int = 0
    restarts: int = 0
    contact: bool = False
    contacts: int = 0
    withheld: int = 0
    swings: int = 0
    swings_withheld: int = 0
    doubt: Doubt | None = None
    jitter_ms: float = 0.0
    untouched: int = 0
    untouched_ns: int | None = None
    note: str | None = None


class LegHeartbeat(msgspec.Struct, frozen=True, kw_only=True):
    """Reports the age of a leg's newest sample.

    Attributes:
        t_ns: of the newest sample.
        age_s: since the last usable sample in which a servo answered.
        contact: whether the leg touches, by its last event.
    """

    t_ns: int
    age_s: float
    contact: bool


class Heartbeat(Message, frozen=True, kw_only=True):
    """Shows that the service runs, ten times a second; its end shows within half a second.

    Attributes:
        legs: those that have had a sample.
    """

    legs: dict[str, LegHeartbeat]


class ModelTerm(msgspec.Struct, frozen=True, kw_only=True):
    """Holds one term of a joint's equation: ``coefficient * name``."""

    name: str
    coefficient: float


class ModelReport(Message, frozen=True, kw_only=True):
    """Reports a leg's model, on request.

    Attributes:
        terms: one list of terms per joint.
        equations: the same as text, one per joint.
        first: per joint, terms of the movement δ that terms of a changed leg refer to: the
            movement of the leg as it was first known; empty while there are none.
        slope_rad: error at which the servos' law saturates, by which the leg is predicted: that of
            robot.toml, or what a refit has found in its place.
    """

    leg: str
    model_version: int
    joints: list[str]
    terms: list[list[ModelTerm]]
    equations: list[str]
    first: list[list[ModelTerm]] = []
    library: str = ""
    threshold: float | None = None
    origin: str | None = None
    slope_rad: float | None = None


class LegTrace(Message, frozen=True, kw_only=True):
    """Reports the last ticks of a leg as they were judged, on request; oldest first.

    Attributes:
        number: of the newest tick in it; ask for what came ``after`` that next time.
        t_ns, seq: (n,) of the samples.
        swing: (n,) as the sample says, or else its commands; None where neither shows it.
        measured, desired: (n, J) rad, in the source's angles, as the samples have them.
        predicted: (n, J) rad, likewise, what ``measured`` was expected to be; None for a tick that
            was not judged.
        test_ratio: (n,) statistic over threshold, above 1 for a contact; None likewise.
        p: (n,) probability that the foot carries, None while unknown.
        places_m: (J + 1, 3) of joints and foot at the newest tick, on the body; empty where the
            leg's geometry or its mount is not described.
    """

    leg: str
    number: int
    t_ns: list[int] = []
    seq: list[int] = []
    swing: list[bool | None] = []
    measured: list[list[float]] = []
    desired: list[list[float]] = []
    predicted: list[list[float] | None] = []
    test_ratio: list[float | None] = []
    p: list[float | None] = []
    places_m: list[list[float]] = []


class ContactTruth(Message, frozen=True, kw_only=True, omit_defaults=True):
    """Reports the simulator's truth: a leg touches, or lets go.

    Attributes:
        t_ns: time of the physics step at which the state changed.
        force: N, mean over 20 ms from the change on (0 at release).
        speed_m_s: speed of the touching part against the surface at touch.
        surface: ``hard`` or ``soft``.
        part: the part of the leg that touches: ``foot`` or a link's name.
        grazing: the motion was nearly tangent to the surface.
    """

    t_ns: int
    contact: bool
    force: float
    speed_m_s: float | None = None
    surface: str | None = None
    part: str | None = None
    grazing: bool = False


class BodyPose(Message, frozen=True, kw_only=True):
    """States where the simulated robot's body is, in recordings of the simulator.

    Attributes:
        t_ns: of the pose, the start of a control tick.
        position_m: (3,) of the body's frame, z up.
        quaternion_wxyz: (4,) its attitude, w first.
    """

    t_ns: int
    position_m: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]


class Command(Message, frozen=True, kw_only=True, omit_defaults=True):
    """Commands a leg: (J,) rad, and optionally the next M ticks, 64 at most."""

    desired: list[float]
    preview: list[list[float]] | None = None


class Drift(Message, frozen=True, kw_only=True, omit_defaults=True):
    """Changes the simulated robot; ``value`` is absolute against nominal.

    Attributes:
        leg, joint: which, None for all.
        value: in the kind's unit (kg, factor, V, rad, probability).
        duration_s: length of a ramp, a pulse or a random walk.
        seed: of a random walk.
    """

    kind: DriftKind
    value: float
    leg: str | None = None
    joint: str | None = None
    shape: DriftShape = "step"
    duration_s: float = 0.0
    seed: int = 0


class DriftReply(Message, frozen=True, kw_only=True, omit_defaults=True):
    """Answers a drift: whether it was taken, and what is in force.

    Attributes:
        holds: drift in force, or under way, ``{kind: {leg: {joint: value}}}``; nominal
            values are left out.
        error: one line when the drift was refused.
    """

    ok: bool
    t_ns: int
    holds: dict[str, dict[str, dict[str, float]]]
    error: str | None = None


class Mark(Message, frozen=True, kw_only=True):
    """Marks a moment for people, as the live page writes it into its recordings.

    Attributes:
        t_ns: wall clock of the moment.
        label: what a person has called it.
    """

    t_ns: int
    label: str


State = Literal["running", "holding", "lost"]


class Quantiles(msgspec.Struct, frozen=True, kw_only=True):
    """Holds the distribution of a time over the last ten seconds, ms."""

    p50: float = 0.0
    p90: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class ServoCounts(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Counts the faults of one servo since the start of the bridge.

    Attributes:
        silent: it does not answer now.
        alarms: its alarms now, such as ``overload``; ``shutdown`` where it has switched its drive
            off for that.
        faults: how often, by kind: ``no_answer``, ``corrupt``, ``refused``, ``stale`` (an old
            position again), ``unpunctual`` (read too far from its moment), ``carried_back`` (read
            off its moment, and put right by the servo's own speed), ``foreign_goal`` (its goal
            was not the one written: another program, or a reset), and the names of error bits.
    """

    silent: bool = False
    alarms: list[str] = msgspec.field(default_factory=list)
    faults: dict[str, int] = msgspec.field(default_factory=dict)


class BridgeStatus(Message, frozen=True, kw_only=True):
    """Reports the state of a port of the bridge, once a second.

    Attributes:
        t_ns: wall clock.
        state: ``running``, ``holding`` (commands stopped), ``lost`` (the port is gone).
        rate_hz: achieved over the last second; ``wanted_hz`` is the robot's.
        cycle_ms: from the first byte written to the last sample published.
        jitter_ms: of publication, against an even grid.
        cycles, missed: control ticks made and not made, since the start.
        reconnects: times the port was lost and found again.
        commands_refused: commands that could not be used, and ``note`` names the last.
        commands_limited: commands that joint limits or the largest step have cut down.
        servos: those with something to report, by id.
    """

    port: str
    t_ns: int
    mode: Literal["observe", "drive"]
    state: State
    rate_hz: float
    wanted_hz: float
    cycle_ms: Quantiles
    jitter_ms: Quantiles
    cycles: int
    missed: int
    reconnects: int = 0
    commands_refused: int = 0
    commands_limited: int = 0
    holding: list[str] = msgspec.field(default_factory=list)
    servos: dict[str, ServoCounts] = msgspec.field(default_factory=dict)
    note: str | None = None


# Last part of a leg's key -> its message.
LEG_MESSAGES: Final[dict[str, type[Message]]] = {
    "servo": ServoSample,
    "contact": ContactEvent,
    "state": LegState,
    "learner": LearnerStatus,
    "model": ModelReport,
    "trace": LegTrace,
    "truth": ContactTruth,
    "command": Command,
}
