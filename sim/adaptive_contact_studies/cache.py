"""What was made once and is kept: results on disk, each under a name of all that decides it.

What is there is never made again: an interrupted run goes on where it stopped, and ends with the
same numbers.  Files are written whole or not at all, and one that cannot be read counts as absent.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

import adaptive_contact
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import write_file

Arrays = dict[str, NDArray[Any]]

FORMAT: Final = 1
_ADVICE: Final = "free some space, or give another folder with --out"


class Store:
    """A folder of results.

    Raises:
        ConfigurationError: it cannot be made, or written to.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"{root}: cannot be made ({error.strerror}); give another folder with --out"
            ) from error

    def path(self, stage: str, key: object, suffix: str) -> Path:
        """Where the result of a stage with these settings lives."""
        text = json.dumps([FORMAT, stage, plain(key)], sort_keys=True, allow_nan=False)
        return self.root / f"{stage}-{_name(text)}{suffix}"

    def arrays(self, stage: str, key: object, make: Callable[[], Mapping[str, Any]]) -> Arrays:
        """The arrays of a stage, made now unless they are there."""
        path = self.path(stage, key, ".npz")
        found = read_arrays(path)
        if found is None:
            found = {name: np.asarray(value) for name, value in make().items()}
            write_arrays(path, found)
        return found

    def tree(self, stage: str, key: object, make: Callable[[], Any]) -> Any:
        """A stage's tree of numbers and texts, made now unless it is there.

        What comes back went through JSON either way, so that a resumed run sees what an
        uninterrupted one sees.
        """
        path = self.path(stage, key, ".json")
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            text = json.dumps(plain(make()), allow_nan=False)
            write_file(path, text, advice=_ADVICE)
            return json.loads(text)


def read_arrays(path: Path) -> Arrays | None:
    """Arrays of a file; None where there is none, or none that can be read."""
    try:
        # numpy leaves a file open that it finds wanting.
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error):
        return None  # never written, or cut by a full disk: made again


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a file, whole or not at all.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **dict(arrays))  # type: ignore[arg-type]
    write_file(path, buffer.getvalue(), advice=_ADVICE)


def name_of(*parts: object) -> str:
    """Hash of settings: numbers, texts, tuples, dataclasses and messages of such."""
    text = json.dumps([_typed(part) for part in parts], allow_nan=False)
    return _name(text)


# Modules and packages of the product that decide what a learner does with a recording.
_LEARNER: Final = (
    "arrays.py", "bank.py", "compiled.py", "leg_learner.py", "leg_report.py", "conventions/*.py",
    "detect/*.py", "diagnose/*.py", "fit/*.py", "learn/*.py", "model/*.py", "robot/*.py",
)  # fmt: skip


def learner_sources() -> list[Path]:
    """List the source files of the learner."""
    product = Path(adaptive_contact.__file__).parent
    return [file for name in _LEARNER for file in sorted(product.glob(name))]


def sources_digest(files: Iterable[Path]) -> hashlib._Hash:
    """Hash of what modules do, to be gone on with; see :func:`code_digest`."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.name} {_code_of(file, file.stat().st_mtime_ns)} ".encode())
    return digest


@functools.cache
def _code_of(file: Path, _written_ns: int) -> str:
    return code_digest(file.read_text(encoding="utf-8"))


def code_digest(source: str, *, imports: bool = True) -> str:
    """Hash of what a module does; its comments, docstrings and layout may change.

    Args:
        source: of the module.
        imports: that it imports something from elsewhere counts as a change.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            node.body = node.body[1:]
    if not imports:
        tree.body = [
            node for node in tree.body if not isinstance(node, ast.Import | ast.ImportFrom)
        ]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def plain(value: Any) -> Any:
    """A tree of dicts, lists, numbers and texts; not-a-number and infinities become None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _name(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _typed(value: object) -> Any:
    # Not msgspec's own encoding: it leaves out defaults only where they are the very same object,
    # which they no longer are in a message that went to another process.
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        own = {f.name: _typed(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {type(value).__name__: own}
    if isinstance(value, msgspec.Struct):
        return {name: _typed(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, tuple):
        return [_typed(item) for item in value]
    return value
