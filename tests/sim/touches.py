"""Ticks of touches in runs of the simulator."""

from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim.arrays import Run


def tick_of(run: Run, change: ContactTruth) -> int:
    """The tick during whose physics a contact began or ended."""
    return max(int(run.t_ns.searchsorted(change.t_ns)) - 1, 0)


def touches_of(run: Run, leg: str) -> list[tuple[int, ContactTruth]]:
    """Contacts of a leg that began, each with its tick."""
    return [(tick_of(run, onset), onset) for onset in run.legs[leg].onsets]
