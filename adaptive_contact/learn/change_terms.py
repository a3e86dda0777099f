"""Adds to a baseline the terms of what may happen to its leg (decision 21)."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import with_changes
from adaptive_contact.model.model_file import LegBaseline

__all__ = ["ready_for_changes"]

# What a servo half as stiff does otherwise in a tick, over the noise: 5 to 7, walking and in pose.
SOFT_NOISES: Final = 5.0


def ready_for_changes(known: LegBaseline) -> LegBaseline:
    """Add terms for changes to a leg's baseline, with coefficients of zero.

    Args:
        known: of q terms.

    Returns:
        The same with (q + added, J) coefficients, scales of all terms, and a domain and a spread
        that say nothing of the added ones.
    """
    model = known.model
    library = with_changes(model.library, model.coefficients)
    added = library.size - len(known.scale)
    joints = len(library.joints)
    scale = np.ones(added)  # friction saturates at 1
    if library.knows_law:
        scale[-joints:] = SOFT_NOISES * known.noise.rms
    return dataclasses.replace(
        known,
        model=LegModel(library, np.pad(model.coefficients, ((0, added), (0, 0))), model.version),
        scale=np.concatenate([known.scale, scale]),
        spread=None if known.spread is None else np.pad(known.spread, ((0, 0), (0, 0), (0, added))),
        domain=known.domain and dataclasses.replace(known.domain, beyond=added),
    )
