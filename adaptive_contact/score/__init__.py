"""Scores events against truth: recall, latency, precision, false alarms per robot-hour.

The rules are in ``docs/scoring.md``.  With arrays: a :class:`LegStream` and a detector's
:class:`Events` go into :func:`match`, its outcomes into :func:`summarise`.  With messages:
:func:`score_messages`.
"""

from __future__ import annotations

from adaptive_contact.score.contacts import (
    Contacts,
    TruthChanges,
    contacts_of,
    find_swings,
    lift_by_halves,
    lift_by_height,
    truth_changes,
)
from adaptive_contact.score.matching import match
from adaptive_contact.score.outcome import (
    COUNTED,
    ROWS,
    Events,
    LegOutcome,
    LegStream,
    Row,
    SwingTable,
)
from adaptive_contact.score.score import Score, score_messages
from adaptive_contact.score.streams import Gatherer
from adaptive_contact.score.summary import (
    RowFigures,
    Summary,
    clopper_pearson,
    is_harmful,
    poisson_mean,
    summarise,
    swings_to_recovery,
)

__all__ = [
    "COUNTED",
    "ROWS",
    "Contacts",
    "Events",
    "Gatherer",
    "LegOutcome",
    "LegStream",
    "Row",
    "RowFigures",
    "Score",
    "Summary",
    "SwingTable",
    "TruthChanges",
    "clopper_pearson",
    "contacts_of",
    "find_swings",
    "is_harmful",
    "lift_by_halves",
    "lift_by_height",
    "match",
    "poisson_mean",
    "score_messages",
    "summarise",
    "swings_to_recovery",
    "truth_changes",
]
