"""Runs refits in a process: jobs come in on stdin, results go out on stdout.

A frame is 8 bytes of length, big endian, and a pickle.  Pickles are safe here because both ends are
ours and the pipe is private.  The process ends with its stdin.

Light, so that the process can be started before anything else is loaded: what fits need takes more
than a second of a core to import.  Beside the service's own imports that disturbs no thread; later
it takes a core from threads with an event in hand.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import struct
import subprocess
import sys
from pathlib import Path
from typing import IO, Final

import adaptive_contact
from adaptive_contact.priority import yield_priority

# Option: import at full priority, as no tick is disturbed yet.
HURRY: Final = "--hurry"
# Option: do not import in advance, as jobs come at once and few are fits.  The sender waits for
# each job, so the process keeps its priority.
UNPREPARED: Final = "--unprepared"

_LENGTH: Final = struct.Struct(">Q")
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
    """Run jobs until the service is gone."""
    # Prints go to stderr: they must not come between the frames.
    results = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    hurry = HURRY in sys.argv
    yield_priority(0 if hurry else _NICE)
    if UNPREPARED not in sys.argv:
        # Fits need modules that take seconds to import: before the first job, not while it waits.
        for module in ("pysindy.optimizers", "adaptive_contact.fit.refit_job"):
            importlib.import_module(module)
        if hurry:
            yield_priority(_NICE)
    with contextlib.suppress(BrokenPipeError):
        while (frame := read_frame(sys.stdin.buffer)) is not None:
            write_frame(results, pickle.dumps(pickle.loads(frame).run()))


# BLAS libraries read these when they are loaded, before the worker could set them.
ONE_BLAS_THREAD: Final = {
    f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")
}


def start_process(*, hurry: bool = False, prepared: bool = True) -> subprocess.Popen[bytes]:
    """Start a process that refits, for one :class:`~.refits.ProcessRefitter`.

    It ends with its stdin, and so with the process that started it.

    Args:
        hurry: no thread has an event in hand yet, and it need not stand behind others before it is
            there.
        prepared: it imports what fits need before it takes a job, and is in a hurry no longer.

    Raises:
        OSError: there cannot be one more.
    """
    words = [word for word, said in ((HURRY, hurry), (UNPREPARED, not prepared)) if said]
    env = {**os.environ, **ONE_BLAS_THREAD}
    home = Path(adaptive_contact.__file__).parents[1]
    if home.name not in ("site-packages", "dist-packages"):  # run from a source tree
        env["PYTHONPATH"] = os.pathsep.join(filter(None, (str(home), env.get("PYTHONPATH"))))
    return subprocess.Popen(
        # Safe paths: the current folder, which may be anybody's, has nothing to say.
        [sys.executable, "-P", "-m", "adaptive_contact.service.refit_process", *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=env,
        start_new_session=True,  # a Ctrl-C is the service's to handle
    )


def end_process(process: subprocess.Popen[bytes]) -> None:
    """Kill a process, reap it, and close its pipes; also one that has ended already."""
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with contextlib.suppress(OSError):  # what was never flushed has no reader
                stream.close()


if __name__ == "__main__":
    main()
