r"""From the wire's angles to the description's, and back.

A source may count its joints' angles another way than ``robot.toml`` does: the other way round, or
from another zero.  ``[leg.angles]`` says how, joint by joint:

.. math:: q = d\,w + o, \qquad d \in \{1, -1\}

with the wire's angle :math:`w`, the description's :math:`q`, and the description's angle :math:`o`
of a joint whose source says 0.  A sample is turned once, where it enters a learner or is gathered
for a fit.  Everything behind that point, models and residuals included, is in the description's
frame; keys of the wire (samples, commands) are in the source's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from adaptive_contact.robot.description import Angles, Leg
from adaptive_contact.wire import ServoSample

__all__ = ["AngleFrame", "angles_text"]

# Offsets are written with so many digits: finer than the step of any servo (0.0001 rad).
_DIGITS: Final = 4


class AngleFrame:
    """Turns one leg's samples into the description's frame.

    Args:
        leg: its description.

    Attributes:
        directions: (J,) 1 or -1.
        offsets_rad: (J,) rad.
        same: the wire's angles are the description's, so that nothing is to be done.
    """

    def __init__(self, leg: Leg) -> None:
        joints = len(leg.joints)
        angles = Angles() if leg.angles is None else leg.angles
        self.directions = angles.directions or (1,) * joints
        self.offsets_rad = angles.offsets_rad or (0.0,) * joints
        self.same = all(d == 1 for d in self.directions) and not any(self.offsets_rad)
        self._joints = joints

    def sample(self, sample: ServoSample) -> ServoSample:
        """Turn a sample of the wire into the description's frame.

        A sample with another number of values is left as it is; the checks refuse it.
        """
        if self.same:
            return sample
        preview = sample.preview
        return msgspec.structs.replace(
            sample,
            measured=self.angles(sample.measured),
            desired=self.angles(sample.desired),
            preview=None if preview is None else [self.angles(row) for row in preview],
        )

    def angles(self, wire: list[float]) -> list[float]:
        """(J,) rad of the description for (J,) rad of the wire."""
        if len(wire) != self._joints:
            return wire
        turned = zip(self.directions, wire, self.offsets_rad, strict=True)
        return [d * w + o for d, w, o in turned]

    def wire(self, angles: Sequence[float]) -> list[float]:
        """(J,) rad of the wire for (J,) rad of the description."""
        turned = zip(self.directions, angles, self.offsets_rad, strict=True)
        return [d * (q - o) for d, q, o in turned]


def angles_text(directions: Sequence[int], offsets_rad: Sequence[float], table: str) -> str:
    """What to write into ``robot.toml``, in one line.

    Args:
        directions: (J,) 1 or -1.
        offsets_rad: (J,) rad; left out where all are 0.
        table: ``[leg.angles]`` or ``[leg.servos]``.
    """
    text = f"{table} directions = {list(directions)}"
    if any(round(o, _DIGITS) for o in offsets_rad):
        listed = ", ".join(f"{round(o, _DIGITS):g}" for o in offsets_rad)
        text += f", offsets_rad = [{listed}]"
    return text
