"""Work is kept, gone on with, the same however many do it, and void when its sources change."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, digest, rests_on


def square(_: Work, number: int) -> float:
    if number < 0:
        raise ValueError("no root")
    return float(np.square(number))


def of_square(work: Work, number: int) -> float:
    return work.one(square, number) + 1.0


def threads(_: Work, number: int) -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info()]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Of :func:`square`, in order."""
    seen: list[int] = []
    plain = np.square
    monkeypatch.setattr(np, "square", lambda number: seen.append(number) or plain(number))
    return seen


def test_what_was_made_is_kept_and_a_damaged_result_made_again(
    tmp_path: Path, calls: list[int]
) -> None:
    work = Work(tmp_path)
    assert work.each("squares", of_square, [3, 1, 2]) == [10.0, 2.0, 5.0]
    assert work.each("squares", of_square, [2, 3, 4]) == [5.0, 10.0, 17.0]
    assert calls == [3, 1, 2, 4]
    for file in tmp_path.rglob("output.pkl"):
        file.write_bytes(b"half")
    assert work.one(square, 3) == 9.0
    assert calls == [3, 1, 2, 4, 3]
    assert Work(None).each("squares", of_square, [5]) == [26.0]  # keeps nothing


def test_another_source_voids_results_and_another_word_does_not(
    tmp_path: Path, calls: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "deciding.py"
    monkeypatch.syspath_prepend(tmp_path)
    marked = rests_on("deciding")(square)
    for text, made in (
        ('"""It is so."""\nTWO = 2\n', 1),
        ('"""It was so."""\nTWO = 2  # surely\n', 1),
        ("TWO = 3\n", 2),
    ):
        source.write_text(text)
        digest.cache_clear()
        assert Work(tmp_path).one(marked, 3) == 9.0
        assert len(calls) == made
    digest.cache_clear()


def test_processes_give_the_same_in_one_thread_each() -> None:
    assert Work(None, 2).each("squares", square, [3, 1, 2]) == [9.0, 1.0, 4.0]
    with threadpool_limits(2):
        own = Work(None).each("threads", threads, [1])
    found = [*own, *Work(None, 2).each("threads", threads, [1, 2])]
    assert {count for of_item in found for count in of_item} == {1}


def test_all_that_decides_what_a_learner_does_is_among_its_sources() -> None:
    """Whatever the bank of learners imports, but messages, files, errors and their words."""
    code = """
import sys
import adaptive_contact.core.bank
print("\\n".join(name for name in sys.modules if name.startswith("adaptive_contact.")))
"""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    imported = {".".join(name.split(".")[:2]) for name in done.stdout.split()}
    others = imported - set(LEARNER)
    assert others <= {
        f"adaptive_contact.{name}" for name in ("errors", "files", "printable", "wire")
    }
    assert digest(*SIMULATOR) != digest(*LEARNER)
