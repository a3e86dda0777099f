"""Events against truth: recall, latency, precision, false alarms per robot-hour.

The rules are in ``docs/scoring.md``.  With arrays: a :class:`LegStream` and a detector's
:class:`Events` go into :func:`match`, its outcomes into :func:`summarise`.  With messages:
:func:`score_messages`.
"""

from __future__ import annotations

from adaptive_contact.score.contacts import Contacts, TruthChanges, contacts_of, truth_changes
from adaptive_contact.score.intervals import Interval, clopper_pearson, poisson_mean
from adaptive_contact.score.matching import match
from adaptive_contact.score.outcome import (
    COUNTED,
    ROWS,
    Events,
    LegOutcome,
    LegStream,
    Outcome,
    Row,
    SwingTable,
    TouchTable,
)
from adaptive_contact.score.recovery import is_harmful, swings_to_recovery
from adaptive_contact.score.score import Score, score_messages
from adaptive_contact.score.streams import Gatherer
from adaptive_contact.score.summary import Latency, RowFigures, Summary, summarise
from adaptive_contact.score.swings import Swings, find_swings, lift_by_halves, lift_by_height

__all__ = [
    "COUNTED",
    "ROWS",
    "Contacts",
    "Events",
    "Gatherer",
    "Interval",
    "Latency",
    "LegOutcome",
    "LegStream",
    "Outcome",
    "Row",
    "RowFigures",
    "Score",
    "Summary",
    "SwingTable",
    "Swings",
    "TouchTable",
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
