"""After a drift the learner recovers, and it does not learn contacts: on a few seeds.

The full table is ``make scenarios``; this is the smoke detector that goes off in between.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.score import summarise
from adaptive_contact_sim.trials.figures import Judgement, judge_scenario
from adaptive_contact_sim.trials.judge import within
from adaptive_contact_sim.trials.registry import scenarios
from adaptive_contact_sim.trials.runner import Folders, jobs, run
from adaptive_contact_sim.trials.runs import QUICK_SIZES, Sizes
from adaptive_contact_sim.trials.spec import Variant

# Seeds of tests, apart from those that are tuned on or reported.
SIZES = replace(
    QUICK_SIZES, leg_runs=4, before_s=12.0, after_s=28.0, contact_swings=60, first_seed=9500
)
PAIR = (Variant.FROZEN, Variant.FULL)


def judged(name: str, folder: Path, sizes: Sizes = SIZES) -> Judgement:
    scenario = replace(scenarios(sizes)[name], variants=PAIR)
    folders = Folders.of(folder)
    assert run(jobs([scenario], folders), folders, processes=1) == []
    return judge_scenario(scenario, folders)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shared, so that the twins without drift are simulated once."""
    return tmp_path_factory.mktemp("recovery")


@pytest.mark.parametrize(
    "name", ["step-friction4", "step-supply94", "step-compliance2", "step-joint6"]
)
def test_a_leg_recovers_from_a_step(name: str, folder: Path) -> None:
    judgement = judged(name, folder)
    until = judgement.scenario.phases[-1].to_s
    after = judgement.scenario.phase("after").from_s
    alarms = []
    for frozen, full in zip(*judgement.variants.values(), strict=True):
        recovery = full.recovery["step"]
        alarms.append(recovery.alarms)
        assert recovery.swings is not None, name
        assert recovery.swings <= 20
        lost = summarise([within(frozen.outcome, after, until)])
        kept = summarise([within(full.outcome, after, until)])
        assert kept.lost_swings <= 3
        assert kept.lost_swings < 0.2 * max(lost.lost_swings, 1)
    assert np.median(alarms) <= 2


@pytest.mark.slow
def test_contacts_only_neither_blind_it_nor_are_learned(folder: Path) -> None:
    # Long enough for one learned tick in a thousand to be more than none.
    judgement = judged("contacts-level", folder, replace(SIZES, contact_swings=200))
    for full in judgement.variants[Variant.FULL]:
        contacts = judgement.scenario.phase("contacts")
        figures = summarise([within(full.outcome, contacts.from_s, contacts.to_s)])
        assert figures.counted.touches >= 100
        assert figures.counted.found >= figures.counted.touches - 2
        assert figures.false_alarms <= 1
        assert full.confirmed > 1000
        assert full.touched <= 0.001 * full.confirmed
