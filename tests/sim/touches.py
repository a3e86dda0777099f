"""Runs of the simulator, and ticks of touches in them."""

import threading
from pathlib import Path

from adaptive_contact.service.recording import Record, read_recording
from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim import SimulationSettings, run
from adaptive_contact_sim.arrays import Run


def recorded(settings: SimulationSettings, seconds: float, path: Path) -> dict[str, list[Record]]:
    """Record a run without a network; what it leaves, by key."""
    run(settings, threading.Event(), seconds=seconds, record=path)
    by_key: dict[str, list[Record]] = {}
    for record in read_recording(path):
        by_key.setdefault(record.key, []).append(record)
    return by_key


def tick_of(run: Run, change: ContactTruth) -> int:
    """The tick during whose physics a contact began or ended."""
    return max(int(run.t_ns.searchsorted(change.t_ns)) - 1, 0)


def touches_of(run: Run, leg: str) -> list[tuple[int, ContactTruth]]:
    """Contacts of a leg that began, each with its tick."""
    return [(tick_of(run, onset), onset) for onset in run.legs[leg].onsets]
