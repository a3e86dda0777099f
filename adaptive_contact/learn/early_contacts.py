"""Counts early contacts: the sign of a change that no lift shows.

Lifts show whether a leg has changed (``drift.py``).  A change that shows on descents only leaves
every lift as it was, and makes each descent look like a contact: nothing is learned from there on.
The foot's height shows it: a foot cannot meet the ground in swing after swing where it has hardly
begun to come down.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final

__all__ = ["EarlyContacts"]

# Of so many swings, how many set `told`, and with how many it ends.  Legs in pose that meet
# obstacles up to the top of every second swing come to 16, walking ones to 5 (decision 17).
SWINGS: Final = 30
BEGIN: Final = 22
END: Final = 15


class EarlyContacts:
    """Counts the last swings of one leg that reported an early contact.

    Attributes:
        told: early contacts are too many to be contacts.
    """

    def __init__(self) -> None:
        self.told = False
        self._lately: deque[bool] = deque(maxlen=SWINGS)

    def take(self, early: bool) -> bool:
        """Count a swing; True if it is the one with which the count becomes too high.

        Args:
            early: it reported an early contact.
        """
        self._lately.append(early)
        count, before = sum(self._lately), self.told
        self.told = count > END if before else count >= BEGIN
        return self.told and not before

    def forget(self) -> None:
        """Drop the counts, as the leg is known to have changed."""
        self.told = False
        self._lately.clear()

    @property
    def note(self) -> str | None:
        """One line for a person, None when all is well."""
        if not self.told:
            return None
        return (
            f"in {sum(self._lately)} of {len(self._lately)} swings a touch was reported at the top "
            "of the swing: a change that only descents show, or something that is always in the way"
        )

    def snapshot(self) -> dict[str, Any]:
        """Return the counts, for :meth:`restore`."""
        return {"lately": [int(early) for early in self._lately], "told": self.told}

    def restore(self, saved: Any) -> None:
        """Take over saved counts; what is not usable is left."""
        if not isinstance(saved, dict) or not isinstance(saved.get("lately"), list):
            return
        self.forget()
        self._lately.extend(bool(early) for early in saved["lately"])
        self.told = saved.get("told") is True and sum(self._lately) > END
