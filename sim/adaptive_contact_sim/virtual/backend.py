"""What moves behind the virtual servos."""

from __future__ import annotations

from typing import Protocol


class Backend(Protocol):
    """A set of servos by index; angles in the servos' own frames, rad from the horn's centre.

    What the bus sets is ignored, and no other source writes goals, unless a backend says otherwise.
    """

    def advance(self, now_s: float) -> float:
        """Bring the servos up to a moment.

        Args:
            now_s: monotonic time.

        Returns:
            Monotonic time at which it wants to be called again at the latest.
        """

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""

    def set_goal(self, index: int, angle_rad: float) -> None:
        """Write a servo's goal."""
        return

    def goal(self, index: int) -> float | None:
        """A goal that another source (a gait inside) has written, or None."""
        return None

    def set_torque(self, index: int, on: bool) -> None:
        """Switch a servo's drive on or off."""
        return

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set the position error at which a servo drives with all it has."""
        return
