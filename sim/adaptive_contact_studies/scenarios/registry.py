"""The scenarios: permanent names, in the order of the table."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from adaptive_contact.errors import ConfigurationError
from adaptive_contact_studies.scenarios.changes import compound, slow_changes, steps
from adaptive_contact_studies.scenarios.conditions import (
    contacts,
    starts,
    steady,
    trouble,
    walking_contacts,
)
from adaptive_contact_studies.scenarios.other_robots import other_robots
from adaptive_contact_studies.scenarios.runs import FULL_SIZES, Sizes
from adaptive_contact_studies.scenarios.spec import Scenario

__all__ = ["named", "scenarios"]


def scenarios(sizes: Sizes = FULL_SIZES) -> dict[str, Scenario]:
    """All scenarios, by name, in the order of the table."""
    made = [
        *steps(sizes),
        *slow_changes(sizes),
        *compound(sizes),
        *contacts(sizes),
        *walking_contacts(sizes),
        *trouble(sizes),
        *starts(sizes),
        *steady(sizes),
        *other_robots(sizes),
    ]
    return {scenario.name: scenario for scenario in made}


def named(names: Iterable[str], sizes: Sizes = FULL_SIZES) -> list[Scenario]:
    """Scenarios by their names, each once.

    Raises:
        ConfigurationError: there is no such scenario.
    """
    known = scenarios(sizes)
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else "`scenarios list` shows them"
            raise ConfigurationError(f"no scenario '{name}'; {hint}")
    return [known[name] for name in dict.fromkeys(names)]
