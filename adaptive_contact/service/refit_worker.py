"""The process that refits: jobs come in on stdin, results go out on stdout, until stdin ends.

Started by :mod:`adaptive_contact.service.refit_process`; a frame is 8 bytes of length, big endian,
and a pickle.  Pickles are safe here because both ends are ours and the pipe is private.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import struct
import sys
from typing import IO, Final

from adaptive_contact.priority import yield_priority

# Says that nobody is disturbed yet by what it imports.
HURRY: Final = "--hurry"

_LENGTH: Final = struct.Struct(">Q")
# What fits need, seconds to import: while nobody waits, not while the first job does.
_NEEDED: Final = ("pysindy.optimizers", "adaptive_contact.learn.cold_start")
# A robot's other core is the tick loop's; a refit can wait.
_NICE: Final = 5


def write_frame(stream: IO[bytes], data: bytes) -> None:
    """Write one frame."""
    stream.write(_LENGTH.pack(len(data)) + data)
    stream.flush()


def read_frame(stream: IO[bytes]) -> bytes | None:
    """Read one frame, None where the other side is gone."""
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    length = int(_LENGTH.unpack(head)[0])
    data = stream.read(length)
    return data if len(data) == length else None


def main() -> None:
    """Do jobs until the service is gone."""
    # Whatever prints must not print between the frames.
    results = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    hurry = HURRY in sys.argv
    yield_priority(0 if hurry else _NICE)
    for module in _NEEDED:
        importlib.import_module(module)
    if hurry:
        yield_priority(_NICE)
    with contextlib.suppress(BrokenPipeError):
        while (frame := read_frame(sys.stdin.buffer)) is not None:
            write_frame(results, pickle.dumps(pickle.loads(frame).run()))


if __name__ == "__main__":
    main()
