"""Runs refits in a process: jobs come in on stdin, results go out on stdout.

Each is a pickle, which is safe here: both ends are ours and the pipe is private.  The process ends
with its stdin.

Light, so that the process can be started before anything else is loaded: what fits need takes more
than a second of a core to import.  Beside the service's own imports that disturbs no thread; later
it takes a core from threads with an event in hand.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Final

import adaptive_contact
from adaptive_contact.priority import yield_priority

# Option: do not import in advance, as jobs come at once and few are fits.  The sender waits for
# each job, so the process keeps its priority.
UNPREPARED: Final = "--unprepared"


def main() -> None:
    """Run jobs until the service is gone."""
    # Prints go to stderr: they must not come between the results.
    results = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    if UNPREPARED not in sys.argv:
        yield_priority(5)  # a robot's other core is the tick loop's; a refit can wait
        # Fits need modules that take seconds to import: before the first job, not while it waits.
        for module in ("pysindy.optimizers", "adaptive_contact.fit.refit_job"):
            importlib.import_module(module)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            pickle.dump(pickle.load(sys.stdin.buffer).run(), results)
            results.flush()


# BLAS libraries read these when they are loaded, before the worker could set them.
ONE_BLAS_THREAD: Final = {
    f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")
}


def start_process(*, prepared: bool = True) -> subprocess.Popen[bytes]:
    """Start a process that refits, for one :class:`~.refits.ProcessRefitter`.

    It ends with its stdin, and so with the process that started it.

    Args:
        prepared: it imports what fits need before it takes a job, and stands behind other work.

    Raises:
        OSError: there cannot be one more.
    """
    words = [] if prepared else [UNPREPARED]
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
