"""Contact truth from the physics: when a leg touched, how fast, how hard.

A contact begins at the first physics step whose force is above 0.5 N and whose mean over the
20 ms from there on is too, in a leg that was in the air; it ends at the first step of at least
60 ms below 0.1 N.  Chatter is thus one contact, a brush too light to matter is none, and the
force reported is not the solver's peak.  Looking 20 and 60 ms ahead delays the *report*, never its
time stamp; who needs a touch at once (a gait that reacts to it) asks :meth:`TruthTracker.recent`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.plant import Touch

TOUCH_FORCE_N: Final = 0.5
AIR_FORCE_N: Final = 0.1


class Change(NamedTuple):
    """A leg's contact began or ended."""

    leg: int  # index
    step: int  # physics step of the change
    contact: bool  # began, or ended
    force_n: float  # mean over the 20 ms from the step on, 0 at an end
    touch: Touch | None  # what touched, where that is known

    def message(
        self, t_ns: int, parts: Sequence[str], surface: Callable[[int], str]
    ) -> ContactTruth:
        """As it is published.

        Args:
            t_ns: of the step.
            parts: names of the legs' parts.
            surface: what a touched geometry, by its id, is made of.
        """
        touch = self.touch
        return ContactTruth(
            t_ns=t_ns,
            contact=self.contact,
            force=self.force_n,
            speed_m_s=None if touch is None else touch.speed_m_s,
            surface=None if touch is None else surface(touch.other),
            part=None if touch is None else parts[touch.part],
            grazing=touch is not None and touch.grazing,
        )


class TruthTracker:
    """Follows the legs' forces, a control tick at a time."""

    def __init__(self, step_s: float, substeps: int, legs: int = len(LEGS)) -> None:
        self._mean_steps = round(0.020 / step_s)
        self._air_steps = round(0.060 / step_s)
        # How long before the onset the touch may have been seen: contacts begin with little force.
        self._search_steps = round(0.030 / step_s)
        self._substeps = substeps
        self._legs = legs
        # Forces not yet judged: the last 20 ms, then the tick just made.
        self._pending = np.zeros((self._mean_steps + substeps, legs))

    def start(self, forces: Array, steps: int) -> list[Change]:
        """Begin with a robot at rest on its legs.

        Args:
            forces: (L,) N at present.
            steps: physics steps made so far.

        Returns:
            The state of every leg, as changes.
        """
        self._pending[:] = forces
        self.contact = [bool(f > TOUCH_FORCE_N) for f in forces]
        self._quiet = [0] * self._legs  # steps below AIR_FORCE_N, while in contact
        # physics step at which each leg's force last came up from the air, None in the air; unlike
        # `contact` up to date with the tick just made, and any touch above 0.5 N counts
        self.recent = [steps if c else None for c in self.contact]
        return [
            Change(i, steps, self.contact[i], float(forces[i]) if self.contact[i] else 0.0, None)
            for i in range(self._legs)
        ]

    def update(self, forces: Array, touches: Sequence[deque[Touch]], steps: int) -> list[Change]:
        """Take one tick's forces.

        Args:
            forces: (substeps, L) N, one row per physics step.
            touches: per leg, the latest touches.
            steps: physics steps made so far; the last row belongs to step ``steps``.

        Returns:
            Changes that are now certain, in order of time per leg.
        """
        window, n = self._pending, self._substeps
        window[:-n] = window[n:]
        window[-n:] = forces
        self._judged = steps - window.shape[0]  # physics steps behind the start of the window
        largest = window.max(axis=0)
        smallest = window.min(axis=0)
        newest = forces.max(axis=0)
        changes: list[Change] = []
        for leg in range(self._legs):
            if newest[leg] <= AIR_FORCE_N:
                self.recent[leg] = None
            elif self.recent[leg] is None and newest[leg] > TOUCH_FORCE_N:
                first = int(np.argmax(forces[:, leg] > TOUCH_FORCE_N))
                self.recent[leg] = steps - n + 1 + first
            if self.contact[leg]:
                if smallest[leg] >= AIR_FORCE_N:
                    self._quiet[leg] = 0
                    continue
            elif largest[leg] <= TOUCH_FORCE_N:
                continue
            changes.extend(self._find_changes(leg, window[:, leg], touches[leg]))
        return changes

    def _find_changes(self, leg: int, force: Array, touches: deque[Touch]) -> list[Change]:
        """Find the changes of one leg's tick that left the look-ahead, step by step."""
        total = np.concatenate([[0.0], np.cumsum(force)])
        mean = (total[self._mean_steps :] - total[: -self._mean_steps]) / self._mean_steps
        changes: list[Change] = []
        # Row i of the window is physics step judged + i + 1.
        for i in range(self._substeps):
            step = self._judged + i + 1
            if self.contact[leg]:
                self._quiet[leg] = self._quiet[leg] + 1 if force[i] < AIR_FORCE_N else 0
                if self._quiet[leg] == self._air_steps:
                    self.contact[leg] = False
                    changes.append(Change(leg, step - self._air_steps + 1, False, 0.0, None))
            elif force[i] > TOUCH_FORCE_N and mean[i] > TOUCH_FORCE_N:
                self.contact[leg] = True
                self._quiet[leg] = 0
                touch = self._touch_of(touches, step)
                changes.append(Change(leg, step, True, float(mean[i]), touch))
        return changes

    def _touch_of(self, touches: deque[Touch], step: int) -> Touch | None:
        """The touch that led to a contact: the first not too long before, else the latest."""
        latest = None
        for touch in touches:
            if touch.step > step:
                break
            latest = touch
            if touch.step >= step - self._search_steps:
                break
        return latest
