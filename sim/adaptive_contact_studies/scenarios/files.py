"""Arrays in files named by what decides them; written whole or not at all."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import io
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import msgspec
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.files import write_file

__all__ = ["Arrays", "code_digest", "name_of", "read_arrays", "write_arrays"]

Arrays = dict[str, NDArray[Any]]


def name_of(*parts: object) -> str:
    """Hash of settings: numbers, texts, tuples, dataclasses and messages of such."""
    text = json.dumps([_plain(part) for part in parts], allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


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


def read_arrays(path: Path) -> Arrays | None:
    """Arrays of a file; None where there is none, or none that can be read."""
    try:
        # numpy leaves a file open that it finds wanting.
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, BadZipFile, zlib.error):
        return None  # never written, or cut by a full disk: made anew


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a file, whole or not at all.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **dict(arrays))  # type: ignore[arg-type]
    advice = "free some space, or give another folder with --out"
    write_file(path, buffer.getvalue(), advice=advice)


def _plain(value: object) -> Any:
    # Not msgspec's own encoding: it leaves out defaults only where they are the very same object,
    # which they no longer are in a message that went to another process.
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        own = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {type(value).__name__: own}
    if isinstance(value, msgspec.Struct):
        return {name: _plain(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value
