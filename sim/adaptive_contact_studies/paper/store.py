"""Results of stages on disk, each under a key of everything that decides it.

A stage that was made is never made again: an interrupted run goes on where it stopped, and ends
with the same numbers, as every stage is a pure function of its key.  The key of recorded data
holds a fingerprint of the simulator's *behaviour* (a short run, hashed), that of an evaluation a
hash of the source that evaluates: a changed simulator or detector is never shown old numbers.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import adaptive_contact
import adaptive_contact_studies
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import write_file
from adaptive_contact_sim import truth

__all__ = [
    "Store",
    "physics_fingerprint",
    "plain",
    "require_unchanged_source",
    "source_fingerprint",
]

Arrays = dict[str, NDArray[Any]]

FORMAT: Final = 1
_ADVICE: Final = "free some space, or give another folder with --out"
# Packages whose source decides what an evaluation gives.
_EVALUATING: Final = ("model", "fit", "detect", "learn", "score", "robot")
# Of the experiments, what only counts and shows what was evaluated: a new table is no reason to
# evaluate ten robot-hours again.
_SHOWING: Final = frozenset(
    {
        "detection.py",
        "figures.py",
        "figures_detection.py",
        "figures_format.py",
        "report.py",
        "tables.py",
        "tables_detection.py",
        "tables_format.py",
        "tables_identification.py",
        "tables_limits.py",
        "tables_logs.py",
        "tables_workspace.py",
        "touched.py",
        "verdicts.py",
    }
)
# Of the other studies, what turns recordings into samples, rows and truth.
_MATCHING: Final = ("evaluate.py", "training.py")


class Store:
    """A folder of results.

    Args:
        root: made if need be.

    Raises:
        ConfigurationError: it cannot be made, or written to.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"{root}: cannot be made ({error.strerror}); give another folder with --out"
            ) from error

    def path(self, stage: str, key: object, suffix: str) -> Path:
        """Where the result of a stage with these settings lives."""
        text = json.dumps([FORMAT, stage, plain(key)], sort_keys=True, allow_nan=False)
        return self.root / f"{stage}-{hashlib.sha256(text.encode()).hexdigest()[:20]}{suffix}"

    def arrays(self, stage: str, key: object, make: Callable[[], Mapping[str, Any]]) -> Arrays:
        """The arrays of a stage, made now unless they are there."""
        path = self.path(stage, key, ".npz")
        found = read_arrays(path)
        if found is None:
            found = {name: np.asarray(value) for name, value in make().items()}
            write_arrays(path, found)
        return found

    def tree(self, stage: str, key: object, make: Callable[[], Any]) -> Any:
        """A stage's tree of numbers and texts, made now unless it is there.

        What comes back went through JSON either way, so that a resumed run sees what an
        uninterrupted one sees.
        """
        path = self.path(stage, key, ".json")
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            text = json.dumps(plain(make()), allow_nan=False)
            write_file(path, text, advice=_ADVICE)
            return json.loads(text)


def read_arrays(path: Path) -> Arrays | None:
    """Arrays of a file; None where there is none, or none that can be read."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        return None  # never written, or cut by a full disk: made anew


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a file, whole or not at all."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **dict(arrays))  # type: ignore[arg-type]  # of allow_pickle
    write_file(path, buffer.getvalue(), advice=_ADVICE)


def plain(value: Any) -> Any:
    """A tree of dicts, lists, numbers and texts; not-a-number and infinities become None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


@functools.cache
def physics_fingerprint() -> str:
    """Hash of a second of every kind of motion: what the simulator does, not how it is written."""
    from adaptive_contact_sim.obstacles import ObstacleSettings
    from adaptive_contact_sim.pose import PoseSettings
    from adaptive_contact_sim.simulation import SimulationSettings
    from adaptive_contact_studies.paper.gantry import record_gantry
    from adaptive_contact_studies.paper.plan import GantrySettings
    from adaptive_contact_studies.paper.recording import record_leg

    digest = hashlib.sha256()
    approaches: tuple[Any, ...] = ("descent", "slow", "forward", "graze")
    for approach in approaches:
        motion = PoseSettings(
            workspace="whole",
            approach=approach,
            obstacles=ObstacleSettings(probability=1.0, soft=0.5),
        )
        leg = record_leg(SimulationSettings(motion=motion, seed=12345), "rf", 2.0)
        for part in (leg.measured, leg.desired, leg.swing, leg.force_n):
            digest.update(np.ascontiguousarray(part).tobytes())
        digest.update(repr(leg.onsets).encode())
    for leg in record_gantry(GantrySettings(seed=12345), 1.0).values():
        for part in (leg.measured, leg.desired, leg.swing):
            digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()[:16]


@functools.cache
def source_fingerprint() -> str:
    """Hash of the source that evaluates, as this process found it first."""
    return _source_now()


def require_unchanged_source() -> None:
    """Refuse to go on with other source than the run began with.

    A process started now would load what is on disk now, and keep its results under another key.

    Raises:
        ConfigurationError: a file was changed meanwhile.
    """
    if _source_now() != source_fingerprint():
        raise ConfigurationError(
            "the source of adaptive-contact was changed while the run was going on; start the same "
            "command again (what still holds is kept)"
        )


def _source_now() -> str:
    """Of identification, detection, learner, score, and the experiments that evaluate."""
    product = Path(adaptive_contact.__file__).parent
    studies = Path(adaptive_contact_studies.__file__ or "").parent
    folders = [product / name for name in _EVALUATING] + [studies / "paper"]
    files = [
        file
        for folder in folders
        for file in sorted(folder.glob("*.py"))
        if not (folder.name == "paper" and file.name in _SHOWING)
    ]
    files += [studies / name for name in _MATCHING]
    files.append(Path(truth.__file__))
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]
