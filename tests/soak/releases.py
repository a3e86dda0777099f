"""Releases judged: a leg that is said to be free must not stand loaded.

A gait controller that believes a wrong release lifts the wrong foot.  A release may come late
without being wrong: a leg in stance is let go of at its next lift-off, and only once it has been
calm for some ticks.  So what is held against the truth is what it says of the present.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.score import LegStream
from adaptive_contact.score.contacts import contacts_of
from adaptive_contact.score.outcome import Events

__all__ = ["HOLDS_NS", "Releases", "judge_releases"]

# A foot that comes off so soon after the word was just leaving: the calm ticks that decide may
# be those in which its load goes, and truth is told by the last tenth of a newton.
HOLDS_NS: Final = 250_000_000


class Releases(NamedTuple):
    """One leg's releases.

    Attributes:
        leg: its id.
        t_ns: (r,) of the deciding samples.
        wrong: (r,) whether the leg touched all along, and went on for more than 0.25 s.
    """

    leg: str
    t_ns: NDArray[np.int64]
    wrong: NDArray[np.bool_]


def judge_releases(stream: LegStream, events: Events) -> Releases:
    """Hold the releases of a leg against the truth.

    A leg that was free at the release's onset and touches anew at its deciding sample was truly
    released; the touch is another matter, and is found or missed.

    Args:
        stream: samples and truth.
        events: of the leg; those that tell a contact are passed over.
    """
    t_ns = events.t_ns[~events.contact]
    onset_ns = np.minimum(events.onset_ns[~events.contact], t_ns)
    contacts = contacts_of(stream.truth, int(stream.t_ns[0]) if len(stream.t_ns) else 0)
    if len(contacts.onset_ns) == 0:
        return Releases(stream.leg, t_ns, np.zeros(len(t_ns), dtype=bool))
    which = np.searchsorted(contacts.onset_ns, onset_ns, side="right") - 1
    # A contact that holds when the stream ends is not known to have held on.
    ends_ns = np.minimum(contacts.release_ns, stream.t_ns[-1])
    wrong = (which >= 0) & (ends_ns[which] > t_ns + HOLDS_NS)
    return Releases(stream.leg, t_ns, wrong)
