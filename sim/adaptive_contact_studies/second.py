"""The product on robots of a second physics engine, against an ideal observer of the free path.

Nothing of the product was tuned to these robots, servos and gaits
(:mod:`adaptive_contact_bullet`).  Each walks from nothing, and with baselines fitted to one and to
four minutes of free swings; two change after a while; all hang from nothing, too.

``python -m adaptive_contact_studies.second FOLDER [SECONDS [ROBOT ...]]``; what each run gave is
kept in FOLDER.  ``--drawn 40`` tries forty robots that nobody chose
(:mod:`adaptive_contact_bullet.drawn`), each from nothing, instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import numpy as np
import typer

from adaptive_contact.core.detect.standing import Standing
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.errors import IdentificationError
from adaptive_contact.fit.train import learn
from adaptive_contact.model import Baseline
from adaptive_contact.score import summarise
from adaptive_contact.score.summary import AlarmFigures
from adaptive_contact_bullet.drawn import drawn, gait_of, is_drawn
from adaptive_contact_bullet.plant import Ground, Kind
from adaptive_contact_bullet.record import Drift, Plan, Recorded, record
from adaptive_contact_bullet.robots import SHAPES
from adaptive_contact_studies.evaluate import feed, parts_of, samples_of, score_run
from adaptive_contact_studies.show.pages import found_of, per_hour, percent, row
from adaptive_contact_studies.training import stretch_of
from adaptive_contact_studies.work import LEARNER, Work, rests_on

_ENGINE: Final = "adaptive_contact_bullet"
_SECONDS: Final = 900.0
_PARTS: Final = 3  # of a run, whose recalls are compared: does a leg lose what it found?
_FITS_S: Final = (0.0, 60.0, 240.0)  # free swings before; 0 for nothing
_WALKS: Final[tuple[tuple[str, str, Kind], ...]] = (
    ("hexapod", "tripod", "hard"),
    ("hexapod", "tripod-fast", "rough"),
    ("hexapod", "tripod-planned", "hard"),
    ("geared", "tripod", "hard"),
    ("geared", "ripple", "soft"),
    ("geared", "tripod", "tilted"),
    ("light", "tripod-slow", "hard"),
    ("worm", "tripod", "hard"),
    ("worm", "tripod-slow", "soft"),
    ("quadruped", "trot", "hard"),
    ("quadruped", "trot-planned", "rough"),
    ("arm", "steps", "none"),
)
_DRIFTS: Final[tuple[Drift, ...]] = ("friction", "joint", "supply", "play", "mass")
_FREE_SEED: Final = 1000  # further on: baselines are fitted to other runs
_SETTLED_S: Final = 20.0  # after a drift, in which a leg is followed
_HUNG_SWINGS: Final = 60  # after which a leg that hangs has to be silent


@dataclasses.dataclass(frozen=True)
class Trial:
    """One robot on one ground, from one start."""

    robot: str
    gait: str
    ground: Kind
    seconds: float
    seed: int  # of the robot, and of its motion
    fitted_s: float = 0.0
    drift: Drift | None = None

    @property
    def hangs(self) -> bool:
        """Whether nothing is touched."""
        return self.ground == "none" and self.robot != "arm"

    @property
    def plan(self) -> Plan:
        """What is recorded for it."""
        return Plan(
            self.robot, gait_of(self.gait), Ground(self.ground), self.seconds, self.seed,
            self.seed % _FREE_SEED,
            plates=0.6 if self.robot == "arm" else 0.0,
            drifts=() if self.drift is None else ((self.drift, self.seconds / 3.0),),
            twins=not self.hangs,
        )  # fmt: skip


class Found(NamedTuple):
    """What the product did in a trial; counts of all legs."""

    touches: tuple[int, ...]  # by parts of the run
    found: tuple[int, ...]
    seen: int  # touches with a twin that the observer finds
    seen_found: int  # of those, that the product found
    twins: int
    alarms: int  # false ones
    settled_alarms: int  # of those, later than `_SETTLED_S` after a drift
    judged: int  # ticks
    learned: int  # ticks
    learned_touching: int
    free: int  # ticks of swings that touch nothing
    hung_alarms: int  # after the first swings
    valid_alarms: int  # of those, by a leg that was `valid`


def trials(seconds: float = _SECONDS, seed: int = 1) -> list[Trial]:
    """List what is tried."""
    walks = [
        Trial(*walk, seconds, seed + number, fitted)
        for number, walk in enumerate(_WALKS)
        for fitted in _FITS_S
    ]
    drifts = [
        Trial(robot, "tripod", "hard", seconds, seed + 50 + number, _FITS_S[1], drift)
        for robot in ("hexapod", "geared")
        for number, drift in enumerate(_DRIFTS)
    ]
    hung = [
        Trial(robot, gait, "none", seconds, seed + 90, fitted)
        for robot, gait in (("hexapod", "tripod"), ("geared", "ripple"), ("quadruped", "trot"))
        for fitted in _FITS_S
    ]
    return walks + drifts + hung


@rests_on(_ENGINE)
def recorded(work: Work, plan: Plan) -> Recorded:
    """Record a plan."""
    return record(plan)


@rests_on(_ENGINE, *LEARNER)
def baseline(work: Work, free: Plan) -> Baseline | None:
    """Fit a baseline to free swings; None where they do not suffice."""
    made = work.one(recorded, free)
    robot = made.shape.description
    streams = {leg: [stretch_of(made.run, leg, robot.period_s)] for leg in robot.leg_ids}
    try:
        return learn(robot, streams, origin="free swings").baseline
    except IdentificationError:
        return None


@rests_on(_ENGINE, "adaptive_contact_studies.evaluate", *LEARNER)
def tried(work: Work, trial: Trial) -> Found | None:
    """Try the product; None where the robot fell, or no baseline could be fitted."""
    known = None
    if trial.fitted_s:
        free = Trial(trial.robot, trial.gait, "none", trial.fitted_s, trial.seed + _FREE_SEED)
        known = work.one(baseline, dataclasses.replace(free.plan, plates=0.0, twins=False))
        if known is None:
            return None
    try:
        made = work.one(recorded, trial.plan)
    except RuntimeError:
        if not is_drawn(trial.robot):
            raise
        return None
    run, robot = made.run, made.shape.description
    standing = Standing()
    learners = [ContactLearner(robot, leg, known, standing=standing) for leg in robot.leg_ids]
    learned: dict[str, list[int]] = {leg: [] for leg in robot.leg_ids}

    def drain(k: int) -> None:
        for learner in learners if k % 50 == 0 else ():
            learned[learner.leg.id] += learner.drain_confirmed()

    told = feed(learners, [samples_of(run, leg) for leg in robot.leg_ids], drain)
    events = dict(zip(robot.leg_ids, told, strict=True))
    outcomes = score_run(run, robot, events)
    whole, parts = summarise(outcomes), parts_of(run, outcomes, _PARTS)
    settled_ns = run.t_ns[0] + (trial.seconds / 3.0 + _SETTLED_S) * 1e9
    seen = seen_found = settled = count = touching = free_ticks = hung = valid = 0
    for outcome in outcomes:
        own, arrays = outcome.touches, run.legs[outcome.leg]
        twins = np.array(
            [o.onset_ns for o in made.observed if o.leg == outcome.leg and o.ratio > 1.0]
        )
        for onset_ns, counted, hit in zip(own.onset_ns, own.counted, own.found, strict=True):
            # Truth of a walk and of its twin tell one touch when they are no further apart.
            if counted and len(twins) and np.abs(twins - onset_ns).min() <= 30_000_000:
                seen, seen_found = seen + 1, seen_found + int(hit)
        settled += sum(alarm_ns > settled_ns for alarm_ns in outcome.alarms_ns)
        at = np.searchsorted(run.t_ns, learned[outcome.leg])
        count, touching = count + len(at), touching + int(arrays.contact[at].sum())
        free_ticks += int((arrays.swing & ~arrays.contact).sum())
        hung += int((outcome.alarm_swing >= _HUNG_SWINGS).sum())
        begun = outcome.swings.start_ns[min(_HUNG_SWINGS, len(outcome.swings.start_ns) - 1)]
        valid += sum(
            e.contact and e.status == "valid" and e.t_ns >= begun for e in events[outcome.leg]
        )
    return Found(
        tuple(part.counted.touches for part in parts), tuple(part.counted.found for part in parts),
        seen, seen_found, len(made.observed), whole.false_alarms, settled, whole.judged_ticks,
        count, touching, free_ticks, hung, valid,
    )  # fmt: skip


def table(made: Sequence[tuple[Trial, Found | None]]) -> str:
    """Write what was found as Markdown: walks and drifts, then what hangs."""
    head = [
        "| robot, gait, ground | start | touches | observer | found of the observer's (95 %) "
        "| recall by thirds, % | false alarms per robot-hour | ticks learned that touch "
        "| free ticks learned |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    rows = [_row(trial, found) for trial, found in made if not trial.hangs]
    hung = [
        "",
        f"| hangs | start | contacts after {_HUNG_SWINGS} swings, per robot-hour "
        "| of them `valid` |",
        "|---|---|---|---|",
        *(_hung(trial, found) for trial, found in made if trial.hangs),
    ]  # fmt: skip
    return "\n".join(head + rows + hung)


def drawn_trials(count: int, seconds: float) -> list[Trial]:
    """List drawn robots, each from nothing."""
    names = [f"drawn-{number}" for number in range(count)]
    return [
        Trial(name, name, drawn(name).kind, seconds, number) for number, name in enumerate(names)
    ]


def _summarize_drawn(made: Sequence[tuple[Trial, Found | None]]) -> str:
    """Summarize drawn robots in a line: how many walk, how much of theirs is found."""
    walked = [found for trial, found in made if is_drawn(trial.robot) and found is not None]
    seen, hits = sum(f.seen for f in walked), sum(f.seen_found for f in walked)
    shares = np.array([f.seen_found / f.seen for f in walked if f.seen])
    good, fair = int((shares >= 0.97).sum()), int((shares >= 0.9).sum())
    alarms = per_hour(sum(f.alarms for f in walked), sum(f.judged for f in walked))
    return (
        f"{len(walked)} drawn robots walk. Of the observer's touches found: "
        f"{found_of(hits, seen)}; of {good} robots 97 % and more, of {fair - good} 90 % and more, "
        f"of {len(shares) - fair} less. False alarms per robot-hour: {alarms}"
    )


def _start(trial: Trial) -> str:
    start = f"fit of {trial.fitted_s / 60:g} min" if trial.fitted_s else "nothing"
    return start if trial.drift is None else f"{start}; {trial.drift} after a third"


def _row(trial: Trial, found: Found | None) -> str:
    name = f"{trial.robot}, {trial.gait}, {'plates' if trial.robot == 'arm' else trial.ground}"
    if found is None:
        why = "it fell" if is_drawn(trial.robot) else "no baseline could be fitted"
        return row(name, _start(trial), why, *[""] * 6)
    touches = sum(found.touches)
    pairs = zip(found.found, found.touches, strict=True)
    false = per_hour(found.alarms, found.judged)
    if trial.drift is not None:
        false += f", {found.settled_alarms} of {found.alarms} {_SETTLED_S:g} s after it"
    return row(
        name, _start(trial), str(touches), f"{found.seen} of {touches}",
        found_of(found.seen_found, found.seen),
        ", ".join(f"{100 * hit / of:.0f}" if of else "–" for hit, of in pairs),
        false,
        percent(found.learned_touching / max(found.learned, 1), 2),
        percent((found.learned - found.learned_touching) / max(found.free, 1), 0),
    )  # fmt: skip


def _hung(trial: Trial, found: Found | None) -> str:
    name = f"{trial.robot}, {trial.gait}"
    if found is None:
        return row(name, _start(trial), "no baseline could be fitted", "")
    rate = AlarmFigures.from_counts(found.hung_alarms, max(found.judged, 1)).per_hour
    shown = f"{rate:.0f} ({found.hung_alarms})"
    return row(name, _start(trial), shown, str(found.valid_alarms))


def main(
    folder: Annotated[Path, typer.Argument(help="Where what each run gave is kept.")],
    seconds: Annotated[float, typer.Argument(help="Of each run.")] = _SECONDS,
    robots: Annotated[list[str] | None, typer.Argument(help=f"{', '.join(SHAPES)}.")] = None,
    count: Annotated[
        int, typer.Option("--drawn", help="So many drawn robots, in place of the others.")
    ] = 0,
) -> None:
    """Try the product on all robots, or on some, and print what was found."""
    if unknown := set(robots or ()) - set(SHAPES):
        raise typer.BadParameter(f"no robot {min(unknown)}; expected some of {', '.join(SHAPES)}")
    named = robots or ([] if count else list(SHAPES))
    wanted = [trial for trial in trials(seconds) if trial.robot in named]
    wanted += drawn_trials(count, seconds)
    done = Work(folder, 2, shown=True).each("trials", tried, wanted)
    made = list(zip(wanted, done, strict=True))
    print(table(made))
    if count:
        print(f"\n{_summarize_drawn(made)}")


if __name__ == "__main__":
    # By its own name, which workers know: what is kept rests on the module's source.
    from adaptive_contact_studies import second

    typer.run(second.main)
