"""What a learner may do to follow its leg, and to report of one that is ambiguous."""

from __future__ import annotations

import enum

__all__ = ["LearnerMode", "WhenAmbiguous"]


class LearnerMode(enum.StrEnum):
    """How a learner follows its leg; the lesser ones are there for comparison."""

    FROZEN = "frozen"
    UNGATED = "ungated"
    REFIT = "refit"
    RLS = "rls"
    FULL = "full"

    @property
    def recursive(self) -> bool:
        """Whether it moves by recursive least squares over confirmed ticks."""
        return self in (LearnerMode.RLS, LearnerMode.FULL)

    @property
    def refits(self) -> bool:
        """Whether it asks for sparse refits."""
        return self in (LearnerMode.REFIT, LearnerMode.FULL)

    @property
    def gated(self) -> bool:
        """Whether it learns from what is confirmed only, and lifts are heard as witnesses."""
        return self.recursive or self.refits


class WhenAmbiguous(enum.StrEnum):
    """What becomes of the contacts of a leg whose status is ``ambiguous`` (decision 24).

    WITHHOLD reports none where the readings do not follow the leg, or something holds its foot, and
    releases one that stands.  It reports those of a leg that only fits its model badly
    (``unsettled``), whose threshold is as wide as its lifts are far, and of a foot that counts as
    held in a swing whose lift fits.  STRICT withholds these, too.  PUBLISH withholds none.
    """

    WITHHOLD = "withhold"
    STRICT = "strict"
    PUBLISH = "publish"
