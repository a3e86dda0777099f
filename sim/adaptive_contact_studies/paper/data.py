"""Streams of one leg with their truth, from the runs of the plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from adaptive_contact.fit.train import Stretch
from adaptive_contact_sim.arrays import LegArrays, Run
from adaptive_contact_studies.training import PlannedRun, recorded, stretch_of
from adaptive_contact_studies.work import Work


@dataclass(frozen=True, eq=False)
class Stream:
    """One leg's stream with its truth, row k being control tick k."""

    planned: PlannedRun  # what was simulated
    run: Run
    leg: str

    @property
    def arrays(self) -> LegArrays:
        """The leg's samples and truth."""
        return self.run.legs[self.leg]

    @property
    def leg_run(self) -> str:
        """Such as ``0-rf``: one leg of one robot."""
        return f"{self.planned.settings.robot_seed}-{self.leg}"

    @cached_property
    def stretch(self) -> Stretch:
        """To learn from; ticks near a touch are marked as not free."""
        return stretch_of(self.run, self.leg)


def streams_of(work: Work, runs: Sequence[PlannedRun]) -> list[Stream]:
    """The streams of all legs that move; simulated now unless they are kept."""
    made = [(planned, work.one(recorded, planned)) for planned in runs]
    return [Stream(planned, run, leg) for planned, run in made for leg in run.legs]
