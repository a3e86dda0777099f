"""Names and seeds are permanent: a published figure can be made again."""

from __future__ import annotations

import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact_studies.scenarios.registry import named, scenarios
from adaptive_contact_studies.scenarios.runs import QUICK_SIZES

NAMES = [
    "step-friction4",
    "step-supply94",
    "step-compliance2",
    "step-joint6",
    "step-mass50",
    "step-mass100",
    "step-viscous4",
    "step-winding16",
    "step-backlash1",
    "step-offset3",
    "step-dropout3",
    "walk-friction4",
    "walk-supply94",
    "walk-compliance2",
    "walk-joint6",
    "ramp-mud",
    "ramp-battery",
    "walk-of-friction",
    "pulse-mud",
    "two-at-once",
    "step-in-contacts",
    "contacts-hard",
    "contacts-soft",
    "contacts-level",
    "walk-contacts-hard",
    "walk-contacts-soft",
    "walk-contacts-level",
    "stand-10min",
    "caught-30s",
    "trailing-2N",
    "readings-3pct",
    "start-cold",
    "start-other-leg",
    "start-other-robot",
    "steady-pose",
    "steady-walk",
    "quadruped12-trot",
    "quadruped12-walk",
    "quadruped12-friction4",
    "leg5-plates",
    "leg5-friction4",
]


def test_names_are_pinned() -> None:
    assert list(scenarios()) == NAMES
    assert list(scenarios(QUICK_SIZES)) == NAMES


def test_a_twin_differs_by_what_the_scenario_does_alone() -> None:
    for scenario in scenarios().values():
        for own, twin in zip(scenario.replays, scenario.references, strict=True):
            assert twin.recording.settings.seed == own.recording.settings.seed
            assert twin.recording.seconds == own.recording.seconds
            assert twin.recording.settings.drift == ()
            assert twin.baseline == "shipped"
            if own.recording.settings.drift:
                assert twin.recording != own.recording


@pytest.mark.parametrize(
    ("name", "hint"),
    [("step-friction", "did you mean 'step-friction4'?"), ("moon", "`scenarios list` shows them")],
)
def test_a_bad_name_is_told_in_one_line(name: str, hint: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        named(["step-mass50", name])
    message = str(caught.value)
    assert message == f"no scenario '{name}'; {hint}"


def test_a_name_given_twice_is_one_scenario() -> None:
    assert [s.name for s in named(["steady-pose", "start-cold", "steady-pose"])] == [
        "steady-pose",
        "start-cold",
    ]
