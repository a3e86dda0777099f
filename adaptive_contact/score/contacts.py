"""From the simulator's truth to contacts: when a leg touched, and when it let go.

The truth stream carries changes of state.  A contact begins when the force passes 0.5 N after at
least 60 ms in the air, so that chatter is one contact; the simulator knows the force at every step
and applies the force limits, the time in the air is applied here, to whatever comes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.wire import ContactTruth

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Least time in the air before a touch is a new contact.
AIR_NS: Final = 60_000_000
# Release of a contact that holds when the stream ends.
FOREVER_NS: Final = np.iinfo(np.int64).max


class TruthChanges(NamedTuple):
    """One leg's truth stream as arrays, (m,) each.

    Attributes:
        t_ns: when the state changed.
        contact: the state from then on.
        speed_m_s: at touch, NaN where it was not told.
        soft: whether the surface is soft; unknown counts as hard.
        grazing: whether the motion was nearly tangent to the surface.
        force_n: mean over 20 ms, N.
    """

    t_ns: Times
    contact: Flags
    speed_m_s: Floats
    soft: Flags
    grazing: Flags
    force_n: Floats


class Contacts(NamedTuple):
    """One leg's contacts in order of time, (c,) each; they do not overlap.

    Attributes:
        onset_ns: when it began.
        release_ns: when it ended, :data:`FOREVER_NS` where it did not.
        touch: whether the leg was seen in the air for 60 ms before; False only for a contact that
            the stream begins with.
        speed_m_s, soft, grazing, force_n: as told at the onset.
    """

    onset_ns: Times
    release_ns: Times
    touch: Flags
    speed_m_s: Floats
    soft: Flags
    grazing: Flags
    force_n: Floats


def truth_changes(messages: Iterable[ContactTruth]) -> TruthChanges:
    """Gather a leg's truth messages, in any order."""
    rows = sorted(messages, key=lambda message: message.t_ns)
    return TruthChanges(
        t_ns=np.array([m.t_ns for m in rows], dtype=np.int64),
        contact=np.array([m.contact for m in rows], dtype=bool),
        speed_m_s=np.array(
            [np.nan if m.speed_m_s is None else m.speed_m_s for m in rows], dtype=np.float64
        ),
        soft=np.array([m.surface == "soft" for m in rows], dtype=bool),
        grazing=np.array([m.grazing for m in rows], dtype=bool),
        force_n=np.array([m.force for m in rows], dtype=np.float64),
    )


def contacts_of(truth: TruthChanges, start_ns: int) -> Contacts:
    """Contacts of a truth stream.

    Args:
        truth: changes in order of time; repeats of a state are ignored.
        start_ns: time of the first sample.  A stream of changes whose first says "contact" tells
            that the leg was in the air from ``start_ns`` on; one whose first says "no contact"
            tells that it was loaded until then.

    Returns:
        The contacts; those less than 60 ms apart are one.
    """
    if len(truth.t_ns) == 0:
        return _pick(truth, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
    fresh = np.concatenate(([True], truth.contact[1:] != truth.contact[:-1]))
    changes = TruthChanges._make(column[fresh] for column in truth)
    first_ns = int(changes.t_ns[0])
    # Row of the change that begins each contact; -1 where the stream begins loaded.
    begins = np.flatnonzero(changes.contact)
    if not changes.contact[0]:
        begins = np.concatenate(([-1], begins))
    earliest_ns = min(start_ns, first_ns)
    onset = np.where(begins < 0, earliest_ns, changes.t_ns[begins])
    ends = begins + 1
    release = np.full(len(begins), FOREVER_NS)
    closed = ends < len(changes.t_ns)
    release[closed] = changes.t_ns[ends[closed]]

    apart = np.concatenate(([True], onset[1:] - release[:-1] >= AIR_NS))
    heads = np.flatnonzero(apart)
    tails = np.concatenate((heads[1:], [len(onset)])) - 1
    contacts = _pick(changes, begins[heads], onset[heads], release[tails])
    contacts.touch[0] = begins[0] >= 0 and first_ns - earliest_ns >= AIR_NS
    return contacts


def _pick(truth: TruthChanges, rows: Times, onset_ns: Times, release_ns: Times) -> Contacts:
    """Contacts with the attributes of the given rows of the truth; row -1 has none."""
    told = rows >= 0
    return Contacts(
        onset_ns=onset_ns,
        release_ns=release_ns,
        touch=np.ones(len(rows), dtype=bool),
        speed_m_s=np.where(told, truth.speed_m_s[rows], np.nan),
        soft=told & truth.soft[rows],
        grazing=told & truth.grazing[rows],
        force_n=np.where(told, truth.force_n[rows], np.nan),
    )
