r"""Detects two faults of a source that its samples alone give away.

*Echo*: a joint's reading is a copy of its command, of the same tick or of up to three before.  With
:math:`e_k = (y_k - u_{k-L}) / q` in position steps, an echo keeps :math:`e` within one step,
whatever its rounding, while the command speeds up and slows down.  A servo at a steady speed may
do so, too; one that accelerates moves off.  The evidence of a run of such ticks is

.. math:: n \, (\max \dot u - \min \dot u),

with n ticks in which the command moved and :math:`\dot u` in steps a tick (decision 24).

*Swapped phase*: ``swing`` is published for stance and the reverse.  A leg goes as far in its swing
as in its stance, in less time; where the command moves slower in swings than in stances, and comes
down less, they are swapped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from adaptive_contact.compiled import records
from adaptive_contact.detect.echo import (
    COMMANDS,
    ECHO_WIDTH,
    LAGS,
    begin_echo,
    take_command,
    take_readings,
)
from adaptive_contact.detect.layout import new_legs
from adaptive_contact.detect.leg_batch import LegPlace
from adaptive_contact.robot import Leg
from adaptive_contact.wire import Doubt

__all__ = ["EchoWatch", "SourceWatch"]

# Step of the coarsest servo known here (AX-12A), by which movements are counted where a servo's own
# is not known; copies are then detected by equality, to the precision of a 32-bit float.
UNKNOWN_STEP_RAD: Final = 0.005118
EQUAL_RAD: Final = 2e-6


class EchoWatch:
    """Detects joints whose readings copy their commands, of one leg.

    Args:
        joints: J.
        quantum_rad: position step of the servos; None if not known, then only copies without
            rounding are found.
    """

    def __init__(self, joints: int, quantum_rad: float | None) -> None:
        self._legs = new_legs(1)
        self._step_rad = UNKNOWN_STEP_RAD if quantum_rad is None else quantum_rad
        self._most_rad = EQUAL_RAD if quantum_rad is None else ECHO_WIDTH * self._step_rad
        self._commands = np.zeros((COMMANDS, joints))
        self._runs = np.zeros((joints, LAGS, 5))
        self._off = np.zeros(joints, dtype=np.int64)
        self._echoing = np.zeros(joints, dtype=np.bool_)
        self.begin()

    @property
    def echoing(self) -> set[int]:
        """Joints, by number, found to echo and not yet to have stopped."""
        return set(np.flatnonzero(self._echoing).tolist())

    @property
    def suspected(self) -> bool:
        """Whether a joint may be echoing, by the swing so far."""
        return bool(self._legs[0]["suspected"])

    def begin(self) -> None:
        """Restart the counts: a swing begins, or what comes does not connect."""
        begin_echo(self._runs)

    def restart(self) -> None:
        """Forget the commands before, which are not known."""
        self.begin()
        self._legs[0]["echo_n"] = 0

    def command(self, desired: Sequence[float]) -> None:
        """Take in a sample's command; to be called for every sample, before :meth:`take`."""
        take_command(records(self._legs)[0], np.array(desired), self._commands)

    def take(self, measured: Sequence[float], valid: Sequence[bool] | None = None) -> None:
        """Compare a sample's readings with the commands up to its own.

        Args:
            measured: (J,) rad.
            valid: (J,) False where nothing was read.
        """
        flags = np.ones(len(measured), dtype=np.bool_) if valid is None else np.array(valid)
        take_readings(
            records(self._legs)[0], np.array(measured), flags, valid is not None, self._step_rad,
            self._most_rad, self._commands, self._runs, self._off, self._echoing,
        )  # fmt: skip


class SourceWatch:
    """Reports what is wrong with the source of one leg's samples.

    Args:
        leg: its description.
        place: its arrays.
    """

    def __init__(self, leg: Leg, place: LegPlace) -> None:
        self._leg = leg
        self._place = place

    @property
    def cause(self) -> Doubt | None:
        """``echo`` or ``phase`` while the samples say nothing of the leg, else None."""
        return _CAUSES[int(self._place.leg["cause"])]

    @property
    def note(self) -> str | None:
        """One line for a person, None when all is well."""
        cause = self.cause
        if cause == "echo":
            echoing = np.flatnonzero(self._place.batch.echoing[self._place.row]).tolist()
            names = ", ".join(self._leg.joints[joint] for joint in echoing)
            return (
                f"measured copies desired ({names}): publish the positions that the servos report; "
                "no contacts are reported until then"
            )
        if cause == "phase":
            return (
                "phase is swapped: the foot swings while the samples say stance; no contacts are "
                "reported until it is right"
            )
        return None


_CAUSES: Final[tuple[Doubt | None, ...]] = (None, "echo", "phase")
