"""What names of the paper's results depend on besides their settings.

The name of recorded data holds a fingerprint of the simulator's *behaviour* (a short run, hashed),
that of an evaluation a hash of the source that evaluates: a changed simulator or detector is never
shown old numbers.
"""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import Any, Final

import numpy as np

import adaptive_contact
from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim import arrays, truth
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_studies import evaluate, training
from adaptive_contact_studies.cache import sources_digest
from adaptive_contact_studies.paper.gantry import record_gantry
from adaptive_contact_studies.paper.plan import GantrySettings
from adaptive_contact_studies.paper.recording import record_leg

__all__ = ["physics_fingerprint", "require_unchanged_source", "source_fingerprint"]

# Packages whose source decides what an evaluation gives.
_EVALUATING: Final = ("model", "fit", "detect", "learn", "score", "robot")
# Of the experiments, what only counts and shows what was evaluated: a new table is no reason to
# evaluate ten robot-hours again.
_SHOWING: Final = frozenset(
    {
        "detection.py",
        "figures.py",
        "figures_detection.py",
        "report.py",
        "tables.py",
        "tables_detection.py",
        "tables_identification.py",
        "tables_limits.py",
        "tables_logs.py",
        "tables_workspace.py",
        "touched.py",
        "verdicts.py",
    }
)
# What turns recordings into samples, rows and truth.
_MATCHING: Final = [Path(str(m.__file__)) for m in (evaluate, training, arrays, truth)]


@functools.cache
def physics_fingerprint() -> str:
    """Hash of a second of every kind of motion: what the simulator does, not how it is written."""
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
    files = [f for name in _EVALUATING for f in sorted((product / name).glob("*.py"))]
    here = sorted(Path(__file__).parent.glob("*.py"))
    files += [file for file in here if file.name not in _SHOWING]
    files += _MATCHING
    return sources_digest(files).hexdigest()[:16]
