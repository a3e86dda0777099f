"""Which joints of a leg answer: a source that goes on telling of servos that do not is no leg."""

from __future__ import annotations

from typing import Final

__all__ = ["Answers"]

_TOLD_AFTER_NS: Final = 500_000_000


class Answers:
    """Follows ``valid`` of one leg's samples.

    Args:
        joints: J, of every sample.
    """

    def __init__(self, joints: int) -> None:
        self._mute_since_ns: list[int | None] = [None] * joints
        self._any_mute = False

    def follow(self, valid: list[bool] | None, now_ns: int) -> bool:
        """Take in which readings of a sample are good, (J,); whether any is."""
        if valid is None or all(valid):
            if self._any_mute:
                self._mute_since_ns = [None] * len(self._mute_since_ns)
                self._any_mute = False
            return True
        self._any_mute = True
        for joint, good in enumerate(valid):
            if good:
                self._mute_since_ns[joint] = None
            elif self._mute_since_ns[joint] is None:
                self._mute_since_ns[joint] = now_ns
        return any(valid)

    def note(self, now_ns: int) -> str | None:
        """One line on the joints that have not answered for half a second; None without any."""
        if not self._any_mute:
            return None
        mute = {
            joint: (now_ns - since_ns) / 1e9
            for joint, since_ns in enumerate(self._mute_since_ns, start=1)
            if since_ns is not None and now_ns - since_ns > _TOLD_AFTER_NS
        }
        if not mute:
            return None
        for_s = f"{min(mute.values()):.1f} s"
        if len(mute) == len(self._mute_since_ns):
            return f"no servo has answered for {for_s}"
        which = ", ".join(map(str, mute))
        joints = f"joint {which} has" if len(mute) == 1 else f"joints {which} have"
        return f"{joints} not answered for {for_s}: judged by the others"
