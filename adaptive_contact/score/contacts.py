"""Derives contacts from the simulator's truth: when a leg touched, and when it let go.

The truth stream carries changes of state.  A contact begins when the force passes 0.5 N after at
least 60 ms in the air, so that chatter is one contact; the simulator knows the force at every step
and applies the force limits, the time in the air is applied here, to whatever comes.

A leg's swings are its runs of swing samples, each with its lift and the ticks that follow its turn.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.wire import ContactTruth

# Least time in the air before a touch is a new contact.
AIR_NS: Final = 60_000_000
# Release of a contact that holds when the stream ends.
FOREVER_NS: Final = np.iinfo(np.int64).max


class TruthChanges(NamedTuple):
    """Holds one leg's truth stream as arrays, (m,) each."""

    t_ns: Ints  # when the state changed
    contact: Mask  # the state from then on
    speed_m_s: Array  # at touch, NaN where it was not given
    soft: Mask  # whether the surface is soft; unknown counts as hard
    grazing: Mask  # whether the motion was nearly tangent to the surface
    force_n: Array  # mean over 20 ms, N


class Contacts(NamedTuple):
    """Holds one leg's contacts in order of time, (c,) each; they do not overlap."""

    onset_ns: Ints  # when it began
    release_ns: Ints  # when it ended, `FOREVER_NS` where it did not
    # whether the leg was seen in the air for 60 ms before; False only for a contact that the stream
    # begins with
    touch: Mask
    # speed_m_s, soft, grazing, force_n: as given at the onset
    speed_m_s: Array
    soft: Mask
    grazing: Mask
    force_n: Array


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
    """Find the contacts of a truth stream.

    Args:
        truth: changes in order of time; repeats of a state are ignored.
        start_ns: time of the first sample.  A stream of changes whose first says "contact"
            means that the leg was in the air from ``start_ns`` on; one whose first says "no
            contact" means that it was loaded until then.

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


def _pick(truth: TruthChanges, rows: Ints, onset_ns: Ints, release_ns: Ints) -> Contacts:
    """Make contacts with the attributes of the given rows of the truth; row -1 has none."""
    given = rows >= 0
    return Contacts(
        onset_ns=onset_ns,
        release_ns=release_ns,
        touch=np.ones(len(rows), dtype=bool),
        speed_m_s=np.where(given, truth.speed_m_s[rows], np.nan),
        soft=given & truth.soft[rows],
        grazing=given & truth.grazing[rows],
        force_n=np.where(given, truth.force_n[rows], np.nan),
    )


class Swings(NamedTuple):
    """Holds swings in order of time."""

    start: Ints  # (s,) index of the first swing sample
    stop: Ints  # (s,) index after the last one
    of_tick: Ints  # (n,) which swing a sample belongs to, -1 in stance
    # (n,) which swing a stance sample follows, without a hole since; -1 elsewhere
    after_tick: Ints


def longest_gap(t_ns: Ints) -> int:
    """Return the longest time between two samples, ns, that still counts as one stretch."""
    if len(t_ns) < 2:
        return 0
    # A hole this long in the samples (in median ticks) ends a swing: what happened inside is
    # unknown.
    return int(10 * np.median(np.diff(t_ns)))


def find_swings(t_ns: Ints, swing: Mask) -> Swings:
    """Split a leg's samples into swings.

    Args:
        t_ns: (n,) strictly increasing.
        swing: (n,) whether the sample's tick is commanded swing.

    Returns:
        The maximal runs of swing samples without a gap longer than :func:`longest_gap`.
    """
    n = len(t_ns)
    if n == 0:
        nothing = np.zeros(0, np.int64)
        return Swings(nothing, nothing, nothing, nothing)
    broken = np.concatenate(([True], np.diff(t_ns) > longest_gap(t_ns)))
    before = np.concatenate(([False], swing[:-1]))
    begins = swing & (broken | ~before)
    start = np.flatnonzero(begins)
    after = np.concatenate((~swing[1:] | broken[1:], [True]))
    stop = np.flatnonzero(swing & after) + 1
    newest = np.cumsum(begins) - 1
    of_tick = np.where(swing, newest, -1)
    after_tick = np.full(n, -1)
    if len(start):
        # A swing that a hole in the samples ends was not seen to turn.
        last = stop[newest] - 1
        stretch = np.cumsum(broken)
        follows = (newest >= 0) & ~swing & (stretch == stretch[last])
        after_tick[follows] = newest[follows]
    return Swings(start, stop, of_tick, after_tick)


def lift_by_height(swings: Swings, height_m: Array) -> Mask:
    """Find lift ticks by the height of the command.

    Args:
        swings: of n samples.
        height_m: (n,) m, height of the commanded foot position.

    Returns:
        (n,) True from a swing's first tick until the command first comes within a millimetre of
        the highest it reaches in that swing.
    """
    n = len(swings.of_tick)
    if len(swings.start) == 0:
        return np.zeros(n, dtype=bool)
    in_swing = swings.of_tick >= 0
    # Ticks of stance lie between the starts of two swings; they are given values that never win.
    top = np.maximum.reduceat(np.where(in_swing, height_m, -np.inf), swings.start)
    # The lift is over once the command comes this close to the highest point of its swing.  A
    # swing's top is flat: its last ticks rise by fractions of a millimetre.
    near = in_swing & (height_m >= top[swings.of_tick] - 0.001)
    ticks = np.arange(n)
    first_near = np.minimum.reduceat(np.where(near, ticks, n), swings.start)
    return in_swing & (ticks < first_near[swings.of_tick])


def lift_by_halves(swings: Swings) -> Mask:
    """Find lift ticks, (n,), without geometry: the first half of every swing."""
    half = (swings.start + swings.stop) // 2
    if len(half) == 0:
        return np.zeros(len(swings.of_tick), dtype=bool)
    return (swings.of_tick >= 0) & (np.arange(len(swings.of_tick)) < half[swings.of_tick])
