"""Seeds of the paper's plan."""

from __future__ import annotations

import dataclasses
from typing import get_args

import pytest

from adaptive_contact_studies.paper.plan import FULL, QUICK, Plan, Role

ROLES = get_args(Role)


@pytest.mark.parametrize("plan", [FULL, QUICK], ids=lambda p: p.name)
@pytest.mark.parametrize("seed", [0, 7])
def test_no_two_roles_share_a_seed(plan: Plan, seed: int) -> None:
    plan = dataclasses.replace(plan, seed=seed)
    by_role = [{p.settings.seed for p in plan.runs(role)} for role in ROLES]
    assert sum(map(len, by_role)) == len(set().union(*by_role))
    other = dataclasses.replace(plan, seed=seed + 1)
    assert not set().union(*by_role) & {p.settings.seed for r in ROLES for p in other.runs(r)}
