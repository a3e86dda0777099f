"""Compiles the arithmetic of a tick, once per installation, and hands arrays over to it.

What is kept is machine code that later starts load: it lies in a folder that belongs to this user,
that no other user may write to, and whose name holds a digest of the sources it was made from.
Without such a folder everything is compiled at each start; without numba nothing is, and the same
code runs as plain Python.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import hashlib
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

# Names a folder for what is compiled; empty for none.
CACHE_VARIABLE: Final = "ADAPTIVE_CONTACT_CACHE"
# What a change of any of them makes void.
_SOURCES: Final = ("core/detect", "core/learn", "model", "robot")
# There once all of a tick has been compiled, touched by each start; holds the CPU time of that, s.
_WHOLE: Final = "whole"


@functools.cache
def _numba() -> Any:
    """Import numba, which has no types and takes as long as all else of a learner, when needed."""
    try:
        import numba
    except ImportError:  # there is none for this computer: pyproject.toml names those it is for
        return None
    return numba


def compiles() -> bool:
    """Return whether anything is compiled: it needs numba, and ``NUMBA_DISABLE_JIT`` unset."""
    return _numba() is not None and not _numba().core.config.DISABLE_JIT


@functools.cache
def cache_folder() -> Path | None:
    """Return the folder that keeps what was compiled, made if need be; None where there is none.

    The first of these that can be used: the one that :data:`CACHE_VARIABLE` names, systemd's
    ``CacheDirectory=``, the user's cache, and one of this user in the folder for temporary files.
    """
    named = os.environ.get(CACHE_VARIABLE)
    if named == "":
        return None
    user = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    candidates = [
        named,
        os.environ.get("CACHE_DIRECTORY", "").split(":")[0],
        f"{user}/adaptive-contact",
        f"{tempfile.gettempdir()}/adaptive-contact-{os.getuid()}",
    ]
    for candidate in candidates:
        place = _expanded(candidate)
        folder = None if place is None else _owned(place)
        if folder is not None:
            folder = _owned(folder / f"compiled-{_digest()}")
        if folder is not None:
            return folder
    return None


def is_cached() -> bool:
    """Return whether a whole tick has been compiled before, by this installation and processor.

    Files of machine code alone do not show it: who stops early leaves some of them.
    """
    folder = cache_folder()
    return folder is not None and (folder / _WHOLE).exists()


def mark_cache_complete() -> None:
    """Mark the cache as whole and in use; remove those of versions that no longer start."""
    folder = cache_folder()
    if folder is None or not compiles():
        return
    with contextlib.suppress(OSError):  # the next start compiles ahead again, from the cache
        (folder / _WHOLE).touch()
        for other in folder.parent.glob("compiled-*"):
            used = other / _WHOLE
            last_s = (used if used.exists() else other).stat().st_mtime
            # What earlier versions compiled is removed after so long.
            if time.time() - last_s > (90 * 86400.0):
                shutil.rmtree(other, ignore_errors=True)


def records(scalars: Any) -> Any:
    """Return rows of scalars as compiled code takes them; as a recarray when uncompiled."""
    return scalars if compiles() else scalars.view(np.recarray)


class Compiled:
    """A function of arrays: compiled when it is first called, or loaded as compiled before.

    IEEE's floating-point rules stay: with others, results would depend on the machine.

    Args:
        function: to compile.
        inlined: into the compiled functions that call it.
    """

    def __init__(self, function: Callable[..., Any], *, inlined: bool) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._inlined = inlined

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        return self.made(*args)

    @functools.cached_property
    def made(self) -> Any:
        """What numba makes of it; uncompiled, the function, which warns of no division by zero."""
        if not compiles():
            return np.errstate(all="ignore")(self.py_func)
        config = _numba().core.config
        folder = cache_folder()
        before, config.CACHE_DIR = config.CACHE_DIR, "" if folder is None else str(folder)
        try:
            return _numba().njit(
                error_model="numpy", no_cfunc_wrapper=True, nogil=True, cache=folder is not None
            )(self.py_func)
        finally:
            config.CACHE_DIR = before

    @functools.cached_property
    def _numba_type_(self) -> Any:
        """What compiled code that calls it takes it for: a part, which numba does not keep."""
        self._part = _numba().njit(
            error_model="numpy", no_cfunc_wrapper=True, no_cpython_wrapper=True,
            forceinline=self._inlined, pipeline_class=_part_compiler(),
        )(self.py_func)  # fmt: skip
        return self._part._numba_type_


@functools.cache
def _part_compiler() -> Any:
    """Return numba's compiler of functions that compiled code calls.

    By itself it makes machine code of each, and again of all that it calls: of a tick's hundred
    functions that takes a third of the time.  Here they become machine code with what Python calls.
    """
    core = _numba().core

    def finalize(part: Any) -> None:
        for library in dict.fromkeys(part._linking_libraries):
            part._final_module.link_in(library._get_module_for_linking(), preserve=True)
        part._finalized = True

    # What has no machine code has no place in it for Python's objects.
    own = {"finalize": finalize, "codegen": SimpleNamespace(set_env=lambda *_: None)}
    library = type("Part", (core.codegen.JITCodeLibrary,), own)
    return lambda typing, target, _, *rest: core.compiler.Compiler(
        typing, target, library(target.codegen(), "part"), *rest
    )


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function of arrays when it is first called, or load what was compiled before."""
    return Compiled(function, inlined=False)


def stage(function: Callable[..., Any]) -> Any:
    """Put a function into the one compiled function that calls it, as a step to be read by itself.

    What it receives and returns then costs nothing.
    """
    return Compiled(function, inlined=True)


class Handover:
    """Hands arrays over to compiled code in one table, by their addresses.

    Each array that is passed by itself takes an eighth of a microsecond: forty take longer than
    many a function.

    Args:
        kinds: by name, type and number of dimensions of each array.

    Attributes:
        names: of the arrays, in the order in which they are received.
        receive: returns the arrays, in compiled code, from the first argument of a function that
            was bound.  They have no count of references, which every slice would raise and lower.
    """

    def __init__(self, **kinds: tuple[Any, int]) -> None:
        self.names = tuple(kinds)
        self._of = _named("Arrays", self.names)
        self._kinds = [(np.dtype(kind), dimensions) for kind, dimensions in kinds.values()]
        self.receive: Any = _Written(lambda: _receiving(self._kinds, self._of), self._of._make)

    def part(self, of: Any, slots: Mapping[str, tuple[str, int]], shared: Sequence[str]) -> Any:
        """Make the function that takes, of what was received, the arrays of one row.

        Neither the row nor the ends of vectors are checked.

        Args:
            of: a named tuple of these arrays.
            slots: of vectors that stand side by side in a row, the name of the array and their
                number; the array ``places`` has the (n, 2) ends of each.
            shared: those that are of all rows.

        Raises:
            TypeError: one is not among those received.
        """
        for name in of._fields:
            if (slots[name][0] if name in slots else name) not in self.names:
                raise TypeError(f"{of.__name__}.{name}: found no such array; expected {self.names}")

        def part(given: Any, row: int) -> Any:
            found = []
            for name in of._fields:
                if name in slots:
                    source, slot = slots[name]
                    first, last = given.places[slot]
                    found.append(getattr(given, source)[row, first:last])
                else:
                    array = getattr(given, name)
                    found.append(array if name in shared else array[row])
            return of(*found)

        return _Written(lambda: _parting(of, slots, shared), part)

    def bind(self, function: Compiled, arrays: Mapping[str, Any]) -> Any:
        """Bind a compiled function to arrays, its first argument.

        Args:
            function: compiled.
            arrays: by name, those it receives and any others.  They are kept with what is
                returned: who puts another array in the place of one binds the function again.

        Returns:
            The function of its other arguments.

        Raises:
            TypeError: an array is not as it was declared.
        """
        kept = self._of._make(arrays[name] for name in self.names)
        if not compiles():
            return functools.partial(function, kept)
        table = np.zeros((len(kept), _CELLS), dtype=np.int64)
        for name, cells, array, kind in zip(self.names, table, kept, self._kinds, strict=True):
            if (array.dtype, array.ndim) != kind or not array.flags.carray:
                raise TypeError(
                    f"{name}: found {array.ndim} dimensions of {array.dtype}; expected {kind[1]} "
                    f"of {kind[0]}, contiguous and writable"
                )
            cells[: 1 + array.ndim] = array.ctypes.data, *array.shape
        bound: Any = functools.partial(function.made, table)
        bound.arrays = kept
        return bound


class _Written:
    """A function whose machine code is written by hand; uncompiled, the one that it stands for.

    Args:
        write: makes it for compiled code.
        plain: for Python.
    """

    def __init__(self, write: Callable[[], Any], plain: Callable[..., Any]) -> None:
        self._write, self._plain = write, plain

    def __call__(self, *args: Any) -> Any:
        """Call the function uncompiled."""
        return self._plain(*args)

    @functools.cached_property
    def _numba_type_(self) -> Any:
        """What compiled code that calls it takes it for."""
        typing = _code().typing
        written = self._write()
        typing.refresh()
        return typing.resolve_value_type(written)


_named: Final[Any] = collections.namedtuple  # of names that are known at run time
_CELLS: Final = 6  # of an array in a table: its address, and up to five lengths


def _code() -> Any:
    """Return the parts of numba that write machine code, which have no types."""
    from llvmlite import ir
    from numba import extending
    from numba.core import cgutils, registry, types
    from numba.np import arrayobj, numpy_support

    return SimpleNamespace(
        arrays=arrayobj,
        cgutils=cgutils,
        from_dtype=numpy_support.from_dtype,
        intrinsic=extending.intrinsic,
        ir=ir,
        types=types,
        typing=registry.cpu_target.typing_context,
    )


def _receiving(kinds: list[tuple[Any, int]], named: Any) -> Any:
    """Make the function that reads a table, for compiled code."""
    code = _code()
    arrays, cgutils, ir, types = code.arrays, code.cgutils, code.ir, code.types
    of_kinds = [types.Array(code.from_dtype(kind), ndim, "C") for kind, ndim in kinds]
    result = types.NamedTuple(of_kinds, named)

    def receive(_context: Any, table: Any) -> Any:
        def make(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            cells = arrays.make_array(table)(context, builder, values[0]).data
            word = ir.IntType(64)
            found = []
            for at, (of_kind, (kind, ndim)) in enumerate(zip(of_kinds, kinds, strict=True)):
                address, *shape = (
                    builder.load(builder.gep(cells, [ir.Constant(word, _CELLS * at + k)]))
                    for k in range(1 + ndim)
                )
                strides = [ir.Constant(word, kind.itemsize)]
                for length in reversed(shape[1:]):
                    strides.insert(0, builder.mul(length, strides[0]))
                array = arrays.make_array(of_kind)(context, builder)
                arrays.populate_array(
                    array,
                    data=builder.inttoptr(address, array.data.type),
                    shape=cgutils.pack_array(builder, shape),
                    strides=cgutils.pack_array(builder, strides),
                    itemsize=ir.Constant(word, kind.itemsize),
                    meminfo=None,
                )
                found.append(array._getvalue())
            return context.make_tuple(builder, result, found)

        return result(table), make

    return code.intrinsic(receive)


def _parting(of: Any, slots: Mapping[str, tuple[str, int]], shared: Sequence[str]) -> Any:
    """Make the function that takes a row's arrays out of those of all rows, for compiled code."""
    code = _code()
    arrays, cgutils, ir, types = code.arrays, code.cgutils, code.ir, code.types
    word = ir.IntType(64)

    def part(_context: Any, given: Any, row: Any) -> Any:
        kinds = dict(zip(given.fields, given.types, strict=True))
        sources = [slots[name][0] if name in slots else name for name in of._fields]

        def kind_of(name: str, source: str) -> Any:
            kind = kinds[source]
            return kind if name in shared else types.Array(kind.dtype, kind.ndim - 1, "C")

        results = [kind_of(name, source) for name, source in zip(of._fields, sources, strict=True)]
        result = types.NamedTuple(results, of)

        def make(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            def array_of(name: str) -> Any:
                at = given.fields.index(name)
                value = builder.extract_value(values[0], at)
                return arrays.make_array(kinds[name])(context, builder, value)

            ends = array_of("places").data
            found = []
            for name, source, kind in zip(of._fields, sources, results, strict=True):
                array = array_of(source)
                if name in shared:
                    found.append(array._getvalue())
                    continue
                shape, strides = (
                    cgutils.unpack_tuple(builder, tuple_) for tuple_ in (array.shape, array.strides)
                )
                start, shape = builder.mul(values[1], strides[0]), shape[1:]
                if name in slots:
                    slot = slots[name][1]
                    first, last = (
                        builder.load(builder.gep(ends, [ir.Constant(word, 2 * slot + k)]))
                        for k in range(2)
                    )
                    start = builder.add(start, builder.mul(first, strides[1]))
                    shape = [builder.sub(last, first)]
                view = arrays.make_array(kind)(context, builder)
                arrays.populate_array(
                    view,
                    data=cgutils.pointer_add(builder, array.data, start),
                    shape=shape,
                    strides=strides[1:],
                    itemsize=strides[-1],
                    meminfo=None,
                )
                found.append(view._getvalue())
            return context.make_tuple(builder, result, found)

        return result(given, types.int64), make

    return code.intrinsic(part)


def _expanded(name: str | None) -> Path | None:
    """Return an absolute path, or None: a user without a home has none of its own."""
    if not name:
        return None
    try:
        path = Path(name).expanduser()
    except RuntimeError:
        return None
    return path if path.is_absolute() else None


def _owned(folder: Path) -> Path | None:
    """Return a folder, made if need be, if it is this user's and no other may write to it."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.mkdir(mode=0o700, exist_ok=True)
        found = os.lstat(folder)
    except OSError:
        return None
    others = stat.S_IWGRP | stat.S_IWOTH
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & others:
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


def _digest() -> str:
    """Return a digest of what machine code depends on: sources, numba, Python, processor.

    And of where the sources lie and when they were written, by which numba distinguishes them: of
    the same sources in another place nothing has been compiled.
    """
    here = Path(__file__).parent
    made = [getattr(_numba(), "__version__", None), sys.version, here]
    if _numba() is not None:
        from llvmlite import binding

        made += [binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()]
    found = hashlib.sha256(" ".join(map(str, made)).encode())
    sources = [path for package in _SOURCES for path in sorted((here / package).glob("*.py"))]
    for source in [Path(__file__), *sources]:
        found.update(f"{source.name} {source.stat().st_mtime_ns} ".encode())
        found.update(source.read_bytes())
    return found.hexdigest()[:16]
