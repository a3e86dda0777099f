"""What is said where an extra is missing, or broken."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

from adaptive_contact.errors import MissingExtraError, installed_from, needs
from adaptive_contact.service.recording import RecordingWriter
from adaptive_contact.wire import ServoSample, servo_key


def test_a_module_that_is_not_installed_names_its_extra() -> None:
    with pytest.raises(MissingExtraError) as raised, needs("the simulator", "sim", "no_mujoco"):
        importlib.import_module("no_mujoco")
    source = installed_from() or "."
    assert str(raised.value).startswith(
        "the simulator needs the extra 'sim', which is not installed; "
        f"run: pip install '{source}[sim]'"
    )


@pytest.mark.parametrize("url", ["file://{}/my%20wheels/a.whl", "https://x/a.whl", "file:///gone"])
def test_an_extra_comes_from_where_the_package_came(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No index has the name: the command takes the same clone or wheel, or says to take one."""
    wheel = tmp_path / "my wheels" / "a.whl"
    wheel.parent.mkdir()
    wheel.touch()

    def distribution(name: str) -> SimpleNamespace:
        if name == "adaptive-contact":
            raise metadata.PackageNotFoundError
        return SimpleNamespace(read_text=lambda _: json.dumps({"url": url.format(tmp_path)}))

    monkeypatch.setattr(metadata, "distribution", distribution)
    here = url.startswith("file://{}")
    assert installed_from() == (str(wheel) if here else None)
    command = f"pip install '{wheel}[ros2]'" if here else "pip install '.[ros2]' in a clone"
    assert command in str(MissingExtraError("ROS 2", "ros2"))


def test_a_module_that_cannot_be_loaded_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault = "raise ImportError('libGL.so.1: no such file\\nand more', name='broken_mujoco.gl')"
    (tmp_path / "broken_mujoco.py").write_text(fault)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtraError) as raised, needs("it", "sim", "broken_mujoco"):
        importlib.import_module("broken_mujoco")
    assert "which cannot be loaded (libGL.so.1: no such file); run: pip" in str(raised.value)
    assert re.search(r"--force-reinstall '\S+\[sim\]'", str(raised.value))


def test_what_another_module_lacks_is_no_missing_extra() -> None:
    with pytest.raises(ModuleNotFoundError), needs("the simulator", "sim", "mujoco"):
        importlib.import_module("adaptive_contact.no_such_module")


# What `adaptive-contact-listen` does not bring.
WITHOUT = """
import sys
LACKS = ("numpy scipy numba pysindy sklearn threadpoolctl mujoco "
         "adaptive_contact_sim adaptive_contact_studies").split()
class Lacks:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in LACKS:
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Lacks())
from adaptive_contact.cli.main import main
main()
"""


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (("export", "walk.mcap", "--to", "csv"), 0, "ServoSample.csv: 1 messages"),
        (("export", "walk.mcap", "--to", "mcap", "--config", "hexapod"), 0, "1 messages"),
        (("watch", "--seconds", "nonsense"), 2, "--seconds"),
        (
            ("doctor", "--seconds", "1"),
            2,
            "doctor needs the extra 'doctor', which is not installed",
        ),
        (("bridge", "ros2"), 2, "ROS 2 needs the extra 'ros2'"),
        (("robot", "check", "--live"), 2, "--live needs the extra 'doctor', which is"),
        (("replay", "walk.mcap", "--events", "-"), 2, "needs the whole package, as 'numpy'"),
        (("serve",), 2, "serve needs the whole package, as 'threadpoolctl' is not installed"),
        (("sim", "walk"), 2, "sim needs the whole package"),
        (("--help",), 0, ""),
    ],
)
def test_what_listens_works_alone(
    words: tuple[str, ...], code: int, says: str, tmp_path: Path
) -> None:
    with RecordingWriter(tmp_path / "walk.mcap") as writer:
        sample = ServoSample(t_ns=1, seq=1, measured=[0.1, 0.2, 0.3], desired=[0.1, 0.2, 0.3])
        writer.write_message(servo_key("lf"), sample, 1)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, *words],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    assert says in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("words", [("doctor",), ("robot", "check", "--live")])
def test_numpy_is_all_that_what_listens_needs_to_find_faults(words: tuple[str, ...]) -> None:
    without = WITHOUT.replace("numpy ", "", 1)
    done = subprocess.run(
        [sys.executable, "-c", without, *words, "--connect", "127.0.0.1:1"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "unreachable" in done.stdout + done.stderr


def test_what_listens_is_part_of_the_whole() -> None:
    root = Path(__file__).parents[1]
    whole = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    part = tomllib.loads((root / "packaging/listen/pyproject.toml").read_text())["project"]
    assert set(part["dependencies"]) <= set(whole["dependencies"])
    for name in ("version", "scripts", "requires-python", "license"):
        assert part[name] == whole[name]
    extras = whole["optional-dependencies"] | {"doctor": ["numpy>=1.26"]}
    for name, needed in part["optional-dependencies"].items():
        assert set(needed) <= {*extras[name], "numpy>=1.26"}
