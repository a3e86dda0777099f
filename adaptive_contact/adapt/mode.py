"""What a learner may do to follow its leg."""

from __future__ import annotations

import enum

__all__ = ["LearnerMode"]


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
