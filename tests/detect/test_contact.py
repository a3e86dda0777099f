"""Test ratios that are small for touches of their leg have to last; others are contacts at once."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.compiled import records
from adaptive_contact.core.detect.contact import add_push, begin_labels, let_go, swing_tick
from adaptive_contact.core.detect.layout import TOUCHED, new_legs, scalars_of

MS = 1_000_000


class Leg:
    """A leg in its descents, by the scalars of its state."""

    def __init__(self, period_ms: int = 20) -> None:
        legs = new_legs(1)
        self.of, self.record = scalars_of(legs, 0), records(legs)[0]
        self._ticks, self.of.period_ns = 0, period_ms * MS

    def descend(self, ratios: Sequence[float], *, lifts: bool = False) -> int | None:
        """Return in which tick of a swing a contact begins."""
        let_go(self.record)
        begin_labels(self.record)
        found = None
        for k, ratio in enumerate([0.0, 0.0, 0.0, *ratios]):
            self._ticks += 1
            self.of.found, self.of.at_ns = 0, self._ticks * self.of.period_ns
            swing_tick(self.record, ratio, ratio, self.of.at_ns - 5 * MS, not lifts)
            if self.of.found & TOUCHED and found is None:
                found = k - 3
        return found

    @property
    def onset_ms(self) -> float:
        """How long before the last tick the contact began."""
        return (self.of.at_ns - self.of.onset_ns) / MS


@pytest.mark.parametrize("usual", [1.2, 4.0, 7.0])
def test_a_leg_that_touches_softly_reports_at_once(usual: float) -> None:
    leg = Leg()
    for _ in range(30):
        assert leg.descend([0.1, usual]) == 1
    assert leg.descend([0.1, 1.01]) == 1


def test_a_jolt_is_no_touch_of_a_leg_that_comes_down_hard() -> None:
    leg = Leg(10)
    for k in range(30):
        if k in (0, 6):
            assert leg.descend([0.1, 1.5]) == 1, "eight contacts say what is usual"
        assert leg.descend([0.1, 20.0 + k % 3]) == 1
    assert 15.0 < leg.of.usual < 25.0
    assert leg.descend([1.5, 1.5, 0.3, 1.5, 40.0]) == 4
    assert leg.onset_ms == 15.0, "the jolts before are not of it"
    assert leg.descend([1.2, 1.2], lifts=True) == 0, "a strike in the lift does not wait"


@pytest.mark.parametrize("where", ["after the turn", "from a prior"])
def test_a_body_is_shaken_where_other_feet_come_down(where: str) -> None:
    """There what is well below the usual has to last, of a leg that carries."""
    leg = Leg(10)
    for _ in range(30):
        leg.descend([20.0])
    assert leg.descend([8.0, 8.0]) == 0, "it is no less than an eighth of the usual"
    leg.of.after, leg.of.from_prior = int(where == "after the turn"), where == "from a prior"
    assert leg.descend([8.0, 3.0, 0.5, 8.0, 19.0]) == 4
    assert leg.descend([8.0] * 6) == 5
    leg.of.has_lengths = True
    assert leg.descend([8.0]) == 0, "a leg that hangs is not shaken by feet that stand"
    leg.of.carried = True
    assert leg.descend([6.0]) is None


@pytest.mark.parametrize(("period_ms", "ticks"), [(20, 3), (10, 6), (5, 12)])
def test_what_lasts_is_a_touch_and_began_with_its_first_tick(period_ms: int, ticks: int) -> None:
    """Such as soft ground after hard."""
    leg = Leg(period_ms)
    for _ in range(30):
        leg.descend([30.0])
    assert leg.descend([1.5] * (ticks - 1)) is None
    assert leg.descend([1.5] * ticks) == ticks - 1
    assert leg.onset_ms == (ticks - 1) * period_ms + 5.0
    for _ in range(40):  # and is the usual touch soon
        leg.descend([1.5] * ticks)
    assert leg.descend([1.5]) == 0


@given(st.lists(st.floats(-4.0, 9.0), min_size=1, max_size=40))
def test_pushes_add_up_like_the_largest_sum_that_ends_here(opposed: list[float]) -> None:
    """Page's sum is the largest of the sums over the last ticks, or zero."""
    leg = Leg()
    begin_labels(leg.record)
    for k, of in enumerate(opposed):
        leg.of.opposed, leg.of.at_ns = of, k
        add_push(leg.record)
    gains = [min(of, 6.0) - 1.0 for of in opposed]
    sums = [sum(gains[k:]) for k in range(len(gains))]
    assert leg.of.push == pytest.approx(max(0.0, *sums), abs=1e-9)
    if leg.of.push > 1e-6:
        assert sums[leg.of.push_ns] == pytest.approx(leg.of.push, abs=1e-9)
