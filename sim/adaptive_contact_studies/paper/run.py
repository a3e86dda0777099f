"""All experiments in one run: stage by stage, resumable, with progress.

Every stage is kept under a key of what decides it (:mod:`~adaptive_contact_studies.cache`).
Interrupted, the same command goes on from there and ends with the same numbers.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from rich.console import Console

from adaptive_contact.errors import RecordingError
from adaptive_contact.robot import shipped_robot
from adaptive_contact_studies.cache import Store, plain
from adaptive_contact_studies.paper.collisions import ten_collisions
from adaptive_contact_studies.paper.compression import compare_all
from adaptive_contact_studies.paper.data import Stream, join, load, parallel, record_all
from adaptive_contact_studies.paper.detection import detection
from adaptive_contact_studies.paper.detectors import DETECTORS
from adaptive_contact_studies.paper.evaluation import ONLINE, evaluate, jobs_of
from adaptive_contact_studies.paper.identification import identification, responses
from adaptive_contact_studies.paper.logs import run_logs
from adaptive_contact_studies.paper.models import learn_robot, learned
from adaptive_contact_studies.paper.plan import Piece, Plan, Role
from adaptive_contact_studies.paper.recording import physics_fingerprint, source_fingerprint
from adaptive_contact_studies.paper.tables import write_report
from adaptive_contact_studies.paper.workspace import (
    study_leg_run,
    workspace,
    workspace_pieces,
)
from adaptive_contact_studies.show.progress import Advance, progress

STAGES: Final = (
    "dataset",
    "identification",
    "compression",
    "collisions",
    "detection",
    "workspace",
    "logs",
)
_PAPER_ROLES: Final[tuple[Literal["train", "tune"], ...]] = ("train", "tune")
_ROLES: Final[tuple[Role, ...]] = ("train", "tune", "touch", "stand", "free")


def run_paper(
    out: Path,
    plan: Plan,
    *,
    workers: int = 0,
    stages: Sequence[str] = STAGES,
    logs: Path | None = None,
    console: Console | None = None,
    command: str | None = None,
) -> dict[str, Any]:
    """Run the experiments and write results, figures and report.

    Args:
        out: folder; ``cache`` in it holds what later runs reuse.
        plan: how much of everything.
        workers: processes, 0 for one per core.
        stages: which, of :data:`STAGES`.
        logs: recordings of real servos; the stage is skipped with a reason where absent.
        console: where progress goes.
        command: what was typed, with all its options, for the report.

    Returns:
        The tree written to ``results.json``.

    Raises:
        ConfigurationError: the folder cannot be written.
        SimulationDivergedError: the physics blew up.
    """
    console = console or Console()
    runner = Runner(out, plan, workers or os.cpu_count() or 1, logs, console)
    results: dict[str, Any] = {
        "v": 1,
        "plan": plain(plan),
        "command": command or f"adaptive-contact paper{' --quick' if plan.name == 'quick' else ''}",
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
        },
        "physics": physics_fingerprint(),
        "source": source_fingerprint(),
    }
    for stage in stages:
        results[stage] = getattr(runner, stage)()
        if stage == "identification":
            results["responses"] = runner.responses(results[stage])
    tree = json.loads(json.dumps(plain(results), allow_nan=False))
    write_report(tree, out)
    return dict(tree)


class Runner:
    """The stages of one run."""

    def __init__(
        self, out: Path, plan: Plan, workers: int, logs: Path | None, console: Console
    ) -> None:
        self.root = out / "cache"
        self.store = Store(self.root)
        self.plan = plan
        self.workers = workers
        self.logs_path = logs
        self.console = console
        self.robot = shipped_robot()

    def dataset(self) -> dict[str, Any]:
        """The paper's two datasets (4.1)."""
        parts = self._paper_parts()
        return {
            "leg": parts[0][0].leg,
            "segments": [self.plan.train_segments, self.plan.test_segments],
            # As recorded: two to a swing, an ascent and a descent.
            "recorded": [2 * sum(_swings(s) for s in own) for own in parts],
            "ticks": [sum(len(s.swing) for s in own) for own in parts],
            # At time 0 the leg stands: that is where it comes from, no touch.
            "touches": sum(o.t_ns > 0 for own in parts for s in own for o in s.arrays.onsets),
        }

    def identification(self) -> Any:
        """Section 4.2."""
        train, test = self._paper_streams()
        return self._kept(
            "identification",
            "identification: sweeps of λ, windows, libraries",
            lambda add: identification(self.robot, train, test, add),
        )

    def responses(self, identified: Any) -> Any:
        """Figure 2, with the λ that the held-out selection picked."""
        picked = {s["library"]: s["picked"] or 0.0 for s in identified["selection"]}
        train, test = self._paper_streams()
        key = [*self._paper_key(), picked]
        return self.store.tree("responses", key, lambda: responses(self.robot, train, test, picked))

    def compression(self) -> Any:
        """The compressed fit against PySINDy's own."""
        train, _ = self._paper_streams()
        return self._kept(
            "compression",
            "compressed regression against raw rows",
            lambda add: compare_all(self.robot, train, add),
        )

    def collisions(self) -> Any:
        """Section 4.3, the ten collisions."""
        train, test = self._paper_streams()
        count = self.plan.collisions
        return self._kept(
            "collisions",
            "ten collisions",
            lambda add: ten_collisions(self.robot, train, test, count, add),
            count,
        )

    def detection(self) -> Any:
        """What ten trials cannot show."""
        pieces = [p for role in _ROLES for p in self.plan.pieces(role)]
        self._record("collisions and free motion", pieces)
        items = [(self.root, self.plan, robot) for robot in self.plan.robots]
        with self._bar("learning the legs of each robot", len(items)) as add:
            for _ in parallel(learn_robot, items, self.workers):
                add(1.0)
        with self._bar("choosing lags, joints, gains and thresholds on tuning streams", 1.0):
            learned(self.store, self.plan)
        jobs = [
            job
            for role in ("touch", "stand", "free")
            for job in jobs_of(self.root, self.plan, self.plan.pieces(role))
        ]
        with self._bar("every detector on every stream", sum(len(j.pieces) for j in jobs)) as add:
            for _, done in parallel(evaluate, jobs, self.workers):
                add(float(done))
        with self._bar("scoring, thresholds swept", len(DETECTORS) + len(ONLINE)) as add:
            return plain(detection(self.root, self.plan, add))  # half a minute: made again

    def workspace(self) -> Any:
        """One model or several, of every leg-run."""
        self._paper_parts()
        flat = [
            piece
            for leg_run in self.plan.leg_runs
            for own in workspace_pieces(self.plan, leg_run).values()
            for piece in own
        ]
        self._record("the whole workspace", flat)
        items = [(self.root, self.plan, leg_run) for leg_run in self.plan.leg_runs]
        found: dict[str, Any] = {}
        with self._bar("one model of the workspace, or several", len(items)) as add:
            for _, (name, tree) in parallel(study_leg_run, items, self.workers):
                found[name] = tree
                add(1.0)
        return plain(workspace({run.name: found[run.name] for run in self.plan.leg_runs}))

    def logs(self) -> Any:
        """Real servos, where their recordings are."""
        if self.logs_path is None or not self.logs_path.exists():
            reason = (
                "no recordings of real servos were given (--logs PATH)"
                if self.logs_path is None
                else f"{self.logs_path}: no such file or folder"
            )
            return {"skipped_stage": reason}
        path = self.logs_path
        stamps = [
            [
                str(p.relative_to(path)) if path.is_dir() else p.name,
                p.stat().st_size,
                p.stat().st_mtime_ns,
            ]
            for p in sorted(path.rglob("*") if path.is_dir() else [path])
            if p.is_file()
        ]
        with self._bar("recordings of real servos", 1.0) as add:
            try:
                return self.store.tree(
                    "logs", [source_fingerprint(), str(path), stamps], lambda: run_logs(path, add)
                )
            except RecordingError as error:
                return {"skipped_stage": str(error)}

    # -- private -------------------------------------------------------------------------------

    def _paper_key(self) -> list[Any]:
        pieces = [plain(self.plan.paper_pieces(role)) for role in _PAPER_ROLES]
        return [[physics_fingerprint(), pieces], source_fingerprint()]

    def _kept(self, stage: str, what: str, make: Callable[[Advance], Any], *key: object) -> Any:
        """A stage on the paper's dataset, made with a bar unless it is there."""
        with self._bar(what, 1.0) as add:
            return self.store.tree(stage, [*self._paper_key(), *key], lambda: make(add))

    def _paper_parts(self) -> list[list[Stream]]:
        pieces = [self.plan.paper_pieces(role) for role in _PAPER_ROLES]
        self._record("the paper's dataset", [p for own in pieces for p in own])
        return [[load(self.store, piece) for piece in own] for own in pieces]

    def _paper_streams(self) -> tuple[Stream, Stream]:
        train, test = (join(own) for own in self._paper_parts())
        return train, test

    def _record(self, what: str, pieces: Sequence[Piece]) -> None:
        seconds = sum(piece.seconds for piece in pieces)
        with self._bar(f"simulating {what}", seconds) as add:
            record_all(self.store, pieces, self.workers, add)

    def _bar(self, what: str, total: float) -> AbstractContextManager[Advance]:
        return progress(self.console, what, total)


def _swings(stream: Stream) -> int:
    """How many swings a stream holds."""
    return int(np.count_nonzero(np.diff(stream.swing.astype(np.int8), prepend=0) == 1))
