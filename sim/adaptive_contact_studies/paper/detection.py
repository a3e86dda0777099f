"""Detection over the whole workspace: every detector's figures on the same streams."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive_contact.robot import ROBOT_HOUR_TICKS, Robot, shipped_robot
from adaptive_contact.score import LegOutcome, Row, summarise
from adaptive_contact.score.summary import AlarmFigures
from adaptive_contact_sim.servo import ServoParameters
from adaptive_contact_studies.cache import Store
from adaptive_contact_studies.paper.comparison_rules import Calibration
from adaptive_contact_studies.paper.detectors import DETECTORS, Bench
from adaptive_contact_studies.paper.evaluation import (
    AIM,
    AIMS,
    DEFAULT,
    FACTORS,
    MODELS,
    NEAR_TURN_TICKS,
    ONLINE,
    TOP_SCORE,
    aim_name,
    jobs_of,
    online_events,
    read_job,
)
from adaptive_contact_studies.paper.models import learned
from adaptive_contact_studies.paper.plan import Plan, Role
from adaptive_contact_studies.paper.touched import (
    SLIP_MS,
    Touched,
    binned,
    by_kind,
    headline_streams,
    late_events,
    misses,
    outcome_of,
    peaks,
    row_figures,
    rows_of,
    slips,
    touched_streams,
    what_alarms_are,
)

_SPEED_EDGES_M_S: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 2.5)
FORCE_EDGES_N: Final = (0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 13.0, float("inf"))


def detection(root: Path, plan: Plan, progress: Callable[[float], None]) -> dict[str, Any]:
    """Gather the evaluated streams into figures."""
    store = Store(root)
    known = learned(store, plan)
    quiet = {role: _quiet(root, plan, role) for role in ("free", "stand")}
    touched = touched_streams(store, root, plan)
    figures: dict[str, Any] = {}
    outcomes: dict[str, list[LegOutcome]] = {}
    for name in (*ONLINE, *DETECTORS):
        outcomes[name] = [outcome_of(t, name) for t in touched]
        figures[name] = _figures(name, touched, outcomes[name], quiet)
        progress(1.0)
    figures[DEFAULT]["misses"] = misses(touched, outcomes, slow=False)
    figures[DEFAULT]["slow_misses"] = misses(touched, outcomes, slow=True)
    figures[DEFAULT]["slips"] = slips(touched) | {"within_ms": SLIP_MS}
    robot = shipped_robot()
    return {
        "detectors": ONLINE | {name: d.title for name, d in DETECTORS.items()},
        "figures": figures,
        "tails": {name: _tail(name, known.bench, touched, quiet) for name in DETECTORS},
        "tail_ticks": {"top_score": TOP_SCORE, "near_turn": NEAR_TURN_TICKS},
        "residual_deg": _residual_figures(quiet),
        "worst_leg_run": _worst_leg_runs(quiet),
        "learned": {k: v for k, v in known.figures.items() if k != "legs"},
        "leg_runs": len(plan.leg_runs),
        "legs": known.figures["legs"],
        "limits": limits_of(robot),
        "edges": {"speed_m_s": _SPEED_EDGES_M_S, "force_n": FORCE_EDGES_N},
        "aim_per_hour": known.bench.aim_per_hour,
    }


def _quiet(root: Path, plan: Plan, role: Role) -> dict[str, Any]:
    """Sums over the free streams of a role."""
    total: dict[str, Any] = {
        "ticks": 0,
        "alarms": {name: np.zeros(len(FACTORS), dtype=np.int64) for name in DETECTORS},
        "online": Counter(),
        "online_ticks": Counter(),
        "above": {name: np.zeros(len(FACTORS), dtype=np.int64) for name in DETECTORS},
        "known": Counter(),
        "near": Counter(),
        "top": {name: np.zeros(2, dtype=np.int64) for name in DETECTORS},
        "squares": {},
        "rows": Counter(),
        "kinds": {},
    }
    played = (*ONLINE, *(aim_name(aim) for aim in AIMS))
    for job in jobs_of(root, plan, plan.pieces(role)):
        result = read_job(job)
        for index, piece in enumerate(job.pieces):
            prefix = f"{index}/"
            ticks = int(result[prefix + "swing"])
            total["ticks"] += ticks
            for name in played:
                events = online_events(result, index, name)
                if events is not None:
                    total["online"][name] += int(np.count_nonzero(events.contact))
                    total["online_ticks"][name] += ticks
            kind = total["kinds"].setdefault(piece.kind, Counter())
            reported = online_events(result, index, DEFAULT)
            assert reported is not None
            kind["ticks"] += ticks
            kind["alarms"] += int(np.count_nonzero(reported.contact))
            for name in DETECTORS:
                sweep = result[f"{prefix}alarms/{name}"]
                both = total["alarms"][name]
                # A threshold too low to be counted on one stream is too low on all.
                total["alarms"][name] = np.where((sweep < 0) | (both < 0), -1, both + sweep)
                for part in ("above", "top"):
                    total[part][name] += result[f"{prefix}{part}/{name}"]
                for part in ("known", "near"):
                    total[part][name] += int(result[f"{prefix}{part}/{name}"])
            for model in MODELS:
                key = (piece.leg_run.name, model)
                sums = result[f"{prefix}squares/{model}"]
                total["squares"][key] = total["squares"].get(key, 0.0) + sums
                total["rows"][key] += int(result[f"{prefix}rows/{model}"])
    return total


def _figures(
    name: str,
    touched: Sequence[Touched],
    outcomes: Sequence[LegOutcome],
    quiet: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    summary = summarise(outcomes)
    alarms = {}
    for role, total in quiet.items():
        count = total["online"][name] if name in ONLINE else total["alarms"][name][AIM]
        alarms[role] = rate_of(int(count), total["ticks"])
    counts = [alarms[role]["count"] for role in quiet]
    alarms["all"] = rate_of(
        -1 if min(counts) < 0 else sum(counts), sum(t["ticks"] for t in quiet.values())
    )
    alarms["touch"] = rate_of(summary.false_alarms, summary.judged_ticks)
    kinds = by_kind(touched, outcomes)
    for figures in kinds.values():
        figures["alarms"] = rate_of(figures.pop("false_alarms"), figures.pop("judged_ticks"))
    found: dict[str, Any] = {
        "summary": {
            "rows": rows_of(touched, outcomes),
            "counted": row_figures(summary.counted),
            "precision": summary.precision,
            "precision_interval": list(summary.precision_interval),
            "neutral": summary.neutral,
            "outside": summary.outside,
            "swings": summary.swings,
        },
        "kinds": kinds,
        "false_alarms": alarms,
        "alarms_are": what_alarms_are(outcomes),
        "by_speed": binned(
            touched, outcomes, "speed_m_s", _SPEED_EDGES_M_S, (Row.SOFT, Row.GRAZING)
        ),
        "by_force": binned(touched, outcomes, "force_n", FORCE_EDGES_N, (Row.GRAZING,)),
        "mid": late_events(outcomes, Row.MID),
    }
    if name == DEFAULT:
        found["free_kinds"] = {
            role: {k: rate_of(v["alarms"], v["ticks"]) for k, v in total["kinds"].items()}
            for role, total in quiet.items()
        }
        found["roc"] = curve_of_aims(touched, quiet)
    elif name not in ONLINE:
        found["roc"] = curve_of(name, touched, quiet)
    return found


def rate_of(count: int, ticks: int) -> dict[str, Any]:
    """Alarms per robot-hour; a count of -1 means a threshold too low to be counted."""
    alarms = AlarmFigures.of(count, ticks) if count >= 0 and ticks else None
    return {
        "count": count,
        "hours": ticks / ROBOT_HOUR_TICKS,
        "per_hour": alarms and alarms.per_hour,
        "interval": list(alarms.interval) if alarms else [None, None],
    }


def _point(touched: Sequence[Touched], name: str, factor: float, rate: Any) -> dict[str, Any]:
    """One point of a curve: the headline row at a threshold."""
    row = summarise([outcome_of(t, name, factor) for t in touched]).rows[Row.HEADLINE]
    return {
        "per_hour": rate["per_hour"],
        "hours": rate["hours"],
        "touches": row.touches,
        "recall": row.recall,
        "median_ms": row.latency.median_ms if row.latency else None,
    }


def curve_of(
    name: str, touched: Sequence[Touched], quiet: dict[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Headline recall against false alarms per robot-hour, over the swept thresholds."""
    ticks = sum(total["ticks"] for total in quiet.values())
    fast = headline_streams(touched)
    points = []
    for i, factor in enumerate(FACTORS):
        counts = [int(total["alarms"][name][i]) for total in quiet.values()]
        if min(counts) >= 0:
            point = _point(fast, name, float(factor), rate_of(sum(counts), ticks))
            points.append({"factor": float(factor), **point})
    return points


def curve_of_aims(
    touched: Sequence[Touched], quiet: dict[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """The same of the default, played at several target rates."""
    fast = headline_streams(touched)
    points = []
    for aim in AIMS:
        name = aim_name(aim)
        count = sum(total["online"][name] for total in quiet.values())
        ticks = sum(total["online_ticks"][name] for total in quiet.values())
        points.append({"aim": aim, **_point(fast, name, 1.0, rate_of(count, ticks))})
    return points


def _tail(
    name: str, bench: Bench, touched: Sequence[Touched], quiet: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Where free ticks and touches score, over the target rate's threshold, and what set that."""
    calibration: Calibration = bench.calibrations[name]
    known = sum(total["known"][name] for total in quiet.values())
    top, near_top = (int(v) for v in sum(total["top"][name] for total in quiet.values()))
    near = sum(total["near"][name] for total in quiet.values())
    return {
        "ticks": known,
        "factors": FACTORS,
        "above": sum(total["above"][name] for total in quiet.values()) / max(known, 1),
        "peaks": peaks(touched, name),
        "shape": max(calibration.tails[c].shape for c in calibration.channels),
        "top": top,
        "top_near_turn": near_top / top if top else None,
        "near_turn": near / known if known else None,
    }


def _residual_figures(quiet: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """One-step residuals of every model, pooled over leg-runs' judged free ticks, degrees."""
    return {
        role: {
            model: _rms_deg(
                sum(v for (_, m), v in total["squares"].items() if m == model),
                sum(n for (_, m), n in total["rows"].items() if m == model),
            )
            for model in MODELS
        }
        for role, total in quiet.items()
    }


def _worst_leg_runs(quiet: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The same of the leg-run whose worst joint is the worst."""
    found: dict[str, Any] = {}
    for role, total in quiet.items():
        for model in MODELS:
            own = {
                run: _rms_deg(squares, total["rows"][run, m])
                for (run, m), squares in total["squares"].items()
                if m == model
            }
            if own:
                worst = max(own, key=lambda run: max(own[run]))
                found.setdefault(role, {})[model] = {"leg_run": worst, "rms_deg": own[worst]}
    return found


def _rms_deg(squares: Any, rows: int) -> list[float]:
    """(3,) degrees, of sums of squares."""
    return [float(v) for v in np.degrees(np.sqrt(squares / max(rows, 1)) * np.ones(3))]


def limits_of(robot: Robot) -> dict[str, Any]:
    """What one step of a servo is at the foot of a stretched leg.

    A step of a joint moves the foot by the step times the length beyond that joint; against the
    servo's proportional drive it takes the torque of one step over the same length.
    """
    leg = robot.legs[0]
    assert leg.lengths_m is not None
    beyond = [sum(leg.lengths_m[joint:]) for joint in range(len(leg.lengths_m))]
    step_rad = robot.quantum(leg.id)
    servo = ServoParameters()
    torque_nm = servo.stall_torque_nm[:3] / servo.slope_steps[:3]
    return {
        "step_rad": step_rad,
        "period_s": robot.period_s,
        "step_m": {j: step_rad * b for j, b in zip(leg.joints, beyond, strict=True)},
        "step_n": {j: float(t / b) for j, t, b in zip(leg.joints, torque_nm, beyond, strict=True)},
    }
