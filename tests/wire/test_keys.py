"""Keys name one leg each, and nothing that Zenoh would expand."""

from __future__ import annotations

import pytest

from adaptive_contact import wire
from adaptive_contact.service.status import SERVICE_STATUS
from adaptive_contact.wire.messages import LEG_MESSAGES


@pytest.mark.parametrize("leg", ["rf", "leg_1", "L-2.b", "a" * 32])
def test_a_key_tells_its_leg(leg: str) -> None:
    for make in (
        wire.servo_key, wire.contact_key, wire.learner_key,
        wire.model_key, wire.truth_key, wire.command_key,
    ):  # fmt: skip
        assert wire.leg_of_key(make(leg)) == leg


@pytest.mark.parametrize(
    "leg", ["", "*", "**", "$*", "a*", "a/b", "a b", "é", "-x", "a" * 33, "rf\n", "?", "#"]
)
def test_wildcards_and_separators_name_no_leg(leg: str) -> None:
    assert not wire.is_leg_id(leg)
    assert wire.leg_of_key(f"robot/leg/{leg}/servo") is None


def test_other_keys_have_no_leg() -> None:
    for key in ("robot/sim/drift", "robot/leg/rf", "robot/leg/rf/other", "x/robot/leg/rf/servo"):
        assert wire.leg_of_key(key) is None


@pytest.mark.parametrize("before", ["", "hexapod1/", "site/hexapod1/"])
@pytest.mark.parametrize(
    "key",
    [
        SERVICE_STATUS, wire.HEARTBEAT, wire.MARK, wire.SIM_DRIFT, wire.SIM_BODY,
        wire.bridge_status_key("servos"),
        *(f"robot/leg/rf/{kind}" for kind in LEG_MESSAGES),
    ],
)  # fmt: skip
def test_a_key_of_the_contract_is_no_misspelling(before: str, key: str) -> None:
    assert wire.meant_key(before + key) is None
