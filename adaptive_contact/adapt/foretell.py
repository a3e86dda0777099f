"""Where a leg would have gone by its model, had nothing touched it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.tracker import push
from adaptive_contact.identify import LegModel

__all__ = ["foretold"]

Array = NDArray[np.float64]


def foretold(
    model: LegModel, window: Array, commands: Sequence[Sequence[float]]
) -> Iterator[Array]:
    """Run a model on by itself, each prediction taken for the next reading.

    Args:
        model: of the leg free of contact; of a library without preview.
        window: (w,) rad, measured and desired up to the tick before, as a prediction is made from.
        commands: (J,) rad each, from the next tick on.

    Yields:
        (J,) rad, where the leg would be at each of those ticks.
    """
    shape = model.library.window
    joints = len(model.library.joints)
    flat = window.copy()
    past = flat.reshape(-1, joints)
    measured, desired = past[: shape.past_measured + 1], past[shape.past_measured + 1 :]
    for command in commands:
        now = measured[0] + model.library.evaluate_flat(flat) @ model.coefficients
        yield now
        push(measured, now)
        push(desired, command)
