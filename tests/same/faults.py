"""Faults of one line that the comparison must find, planted into copies of the working tree."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from .compare import compare
from .trees import PACKAGE, Tree, playing

__all__ = ["FAULTS", "Fault", "find", "planted"]


@dataclass(frozen=True)
class Fault:
    """A line of the decision code, and what it is made.

    Attributes:
        name: permanent.
        file: under ``adaptive_contact``.
        old: the line, or a part of it, that occurs once.
        new: instead.
        by: the recording that is tried first.
    """

    name: str
    file: str
    old: str
    new: str
    by: str


FAULTS: Final = (
    Fault(
        "threshold of a contact", "detect/contact.py",
        "if score <= 1.0:", "if score <= 1.02:", "pose-obstacles",
    ),
    Fault(
        "calm ticks to rearm", "detect/contact.py",
        "REARM_TICKS: Final = 4", "REARM_TICKS: Final = 5", "pose-obstacles",
    ),
    Fault(
        "sign of the onset's share", "detect/contact.py",
        "min(max(-along / power, 0.0)", "min(max(along / power, 0.0)", "pose-obstacles",
    ),
    Fault(
        "a window that is not there yet", "detect/contact.py",
        "if width + 1 > leg.usable:", "if width > leg.usable:", "caught-foot",
    ),
    Fault(
        "the first tick of a swing is not predicted", "detect/detector.py",
        "if ready and leg.ticks:", "if ready and leg.ticks > 4:", "walk-flat",
    ),
    Fault(
        "ticks before an onset", "detect/swing_labels.py",
        "GUARD_TICKS: Final = 3", "GUARD_TICKS: Final = 2", "pose-obstacles",
    ),
    Fault(
        "ticks at the end of a swing", "detect/swing_labels.py",
        "LAST_TICKS: Final = 6", "LAST_TICKS: Final = 5", "pose-free",
    ),
    Fault(
        "ticks around a hole", "detect/swing_labels.py",
        "HOLE_TICKS: Final = 8", "HOLE_TICKS: Final = 0", "lost-samples",
    ),
    Fault(
        "a push from the ground", "detect/swing_labels.py",
        "PUSHED_SIGMA: Final = 1.0", "PUSHED_SIGMA: Final = 1.2", "pose-joint6",
    ),
    Fault(
        "forgetting", "learn/rls.py",
        "(forgetting * (1.0 + weight * m))", "(1.0 + weight * m)", "pose-free",
    ),
    Fault(
        "lifts in doubt before a change", "learn/drift.py",
        "SUSPICIONS: Final = 2", "SUSPICIONS: Final = 3", "pose-friction4",
    ),
    Fault(
        "lifts until settled", "learn/drift.py",
        "SETTLED_SWINGS: Final = 3", "SETTLED_SWINGS: Final = 4", "pose-friction4",
    ),
    Fault(
        "lifts far off that are a hold", "learn/drift.py",
        "FAR_LEVEL: Final = 100.0", "FAR_LEVEL: Final = 120.0", "trailing-foot",
    ),
    Fault(
        "ticks until a refit takes effect", "learn/candidate.py",
        "REFIT_DUE_TICKS: Final = 50", "REFIT_DUE_TICKS: Final = 51", "walk-no-phase",
    ),
    Fault(
        "rows of the trial of a refit", "learn/candidate.py",
        "TRIAL_ROWS: Final = 200", "TRIAL_ROWS: Final = 199", "pose-free",
    ),
    Fault(
        "segment that a buffer gives up", "learn/replay_buffer.py",
        "self._cells[s.cell] == most", "self._cells[s.cell] <= most", "pose-obstacles",
    ),
    Fault(
        "reason of a refusal", "detect/stream.py",
        "return self._refuse(sample, Reject.DUPLICATE_SEQ)",
        "return self._refuse(sample, Reject.TIME_BACKWARDS)", "bad-samples",
    ),
    Fault(
        "samples until a publisher takes back", "detect/stream.py",
        "TAKE_BACK_SAMPLES: Final = 25", "TAKE_BACK_SAMPLES: Final = 24", "two-publishers",
    ),
    Fault(
        "a rate that is off", "detect/source.py",
        "MOST_OFF: Final = 0.10", "MOST_OFF: Final = 0.30", "other-rate",
    ),
    Fault(
        "what a substitute is worth", "detect/history.py",
        "UNSURE_VARIANCE: Final = 2.5", "UNSURE_VARIANCE: Final = 2.4", "lost-samples",
    ),
    Fault(
        "a foot that is held", "detect/swing.py",
        "LIFTED_M: Final = 0.006", "LIFTED_M: Final = 0.012", "caught-foot",
    ),
    Fault(
        "seed of when legs refit", "learn/candidate.py",
        "SPREAD * zlib.crc32(leg.encode())", "SPREAD * zlib.crc32(leg.encode()[:1])", "pose-free",
    ),
    Fault(
        "tail that follows", "learn/noise_tracker.py",
        "if not value > level:", "if not value > 1.1 * level:", "pose-free",
    ),
    Fault(
        "swings until a leg is known", "learn/active_model.py",
        "KNOWN_SWINGS: Final = 10", "KNOWN_SWINGS: Final = 11", "cold-start",
    ),
    Fault(
        "first lifts of an unfit baseline", "learn/drift.py",
        "UNFIT_LIFTS: Final = 3", "UNFIT_LIFTS: Final = 4", "unfit-baseline",
    ),
    Fault(
        "counts over a restart", "leg_learner.py",
        'self._guard.restore(saved.get("stream"), saved.get("missed"))', "pass", "service-restart",
    ),
    Fault(
        "a foot that moved before it touched", "detect/contact.py",
        "leg.fits |= fit >= MIN_LIFT_ROWS and", "leg.fits |= fit > 99 and", "pose-post",
    ),
)  # fmt: skip


@contextmanager
def planted(fault: Fault, sound: Tree, folder: Path) -> Iterator[Tree]:
    """A copy of a tree with a fault in it.

    Raises:
        SystemExit: the tree does not have the line, exactly once.
    """
    path = folder / "planted"
    shutil.rmtree(path, ignore_errors=True)
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(sound.path / PACKAGE, path / PACKAGE, ignore=ignored)
    file = path / PACKAGE / fault.file
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    if text.count(fault.old) != 1:
        raise SystemExit(
            f"fault '{fault.name}': found '{fault.old}' {text.count(fault.old)} times in "
            f"adaptive_contact/{fault.file}, expected once; "
            "adapt this fault in tests/same/faults.py"
        )
    file.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    try:
        yield Tree.at(fault.name, path)
    finally:
        shutil.rmtree(path, ignore_errors=True)


def find(
    fault: Fault, sound: Tree, faulty: Tree, recordings: Mapping[str, Path], outcomes: Path
) -> str | None:
    """The first recording on which a fault shows, and how; None where none does.

    Args:
        fault: its own recording is tried first.
        sound, faulty: trees without and with it.
        recordings: files, by name.
        outcomes: folder of those of the sound tree; the faulty one's are not kept.
    """
    names = sorted(recordings, key=lambda name: name != fault.by)
    for name in names:
        one = {name: recordings[name]}
        passing = faulty.path / "outcomes"
        with playing(sound, one, outcomes) as first, playing(faulty, one, passing) as second:
            (_, before), (_, after) = next(first.done()), next(second.done())
        of = compare(before, after)
        if of.same:
            continue
        kinds = dict.fromkeys(d.kind for d in of.differences)
        shown = [*([f"{len(of.flips)} decisions"] if of.flips else []), *kinds]
        return f"{name} ({', '.join(shown)})"
    return None
