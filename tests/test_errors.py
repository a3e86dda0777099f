"""What is said where an extra is missing, or broken."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from adaptive_contact.errors import MissingExtraError, needs


def test_a_module_that_is_not_installed_names_its_extra() -> None:
    with pytest.raises(MissingExtraError) as raised, needs("the simulator", "sim", "no_mujoco"):
        importlib.import_module("no_mujoco")
    assert str(raised.value) == (
        "the simulator needs the extra 'sim', which is not installed; "
        "run: pip install 'adaptive-contact[sim]'"
    )


def test_a_module_that_cannot_be_loaded_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault = "raise ImportError('libGL.so.1: no such file\\nand more', name='broken_mujoco.gl')"
    (tmp_path / "broken_mujoco.py").write_text(fault)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtraError) as raised, needs("it", "sim", "broken_mujoco"):
        importlib.import_module("broken_mujoco")
    assert "which cannot be loaded (libGL.so.1: no such file); run: pip" in str(raised.value)
    assert "--force-reinstall 'adaptive-contact[sim]'" in str(raised.value)


def test_what_another_module_lacks_is_no_missing_extra() -> None:
    with pytest.raises(ModuleNotFoundError), needs("the simulator", "sim", "mujoco"):
        importlib.import_module("adaptive_contact.no_such_module")
