"""Arrays of a leg by itself."""

from __future__ import annotations

from typing import Any, NamedTuple, get_type_hints

import numpy as np

from adaptive_contact.detect import layout
from adaptive_contact.detect.history import MAX_STEP_RAD_S
from adaptive_contact.detect.leg_batch import LegBatch, LegPlace
from adaptive_contact.model import leg_library
from adaptive_contact.model.library import with_changes
from adaptive_contact.robot import Leg, Robot

PERIOD_NS = 20_000_000


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
