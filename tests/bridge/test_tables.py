"""Control tables: each register against others' tables, and what names and numbers mean."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from adaptive_contact.bridge.tables import (
    MODELS,
    models_named,
    number_name,
)
from adaptive_contact.errors import ConfigurationError


def test_every_register_is_where_others_tools_have_it() -> None:
    """Each register of each model, against tables that nobody here has typed."""
    path = Path(__file__).parent / "control_tables.json"
    told = json.loads(path.read_text(encoding="utf-8"))["tables"]
    for model in MODELS:
        compared: set[str] = set()
        for table in told:
            if model.number not in table["models"]:
                continue
            for name, place in table["registers"].items():
                register = model.registers[name]
                assert [register.address, register.size] == place, (model.name, name, table)
                compared.add(name)
        assert compared == set(model.registers), model.name


def test_a_family_of_two_control_tables_is_none() -> None:
    assert [m.name for m in models_named("XM-540")] == ["XM540-W150", "XM540-W270"]
    with pytest.raises(ConfigurationError, match=r"may be MX-106 or MX-106\(2\.0\), which have"):
        models_named("MX-10")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("xc430w250", "did you mean '2XC430-W250'"),
        ("AX-12B", "did you mean 'AX-12"),
        ("foo", "expected one such as AX-12A or XL430-W250; all that are known are in docs"),
        ("", "expected one such as"),
        ("EX-106+", "servo model 'EX-106+' has no control table here"),
    ],
)
def test_a_name_of_no_model(name: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        models_named(name)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 200


def test_models_that_are_named_though_there_is_no_table() -> None:
    assert number_name(107, 1) == "EX-106+, model number 107"
    assert number_name(117, 1) == "DX-117, model number 117"
    assert number_name(35073, 1) == "RH-P12-RN, model number 35073"
    assert number_name(999, 1) == "model number 999"
