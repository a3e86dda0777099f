"""Starts the process that refits; light, so that it can be started before anything else is loaded.

Its imports take more than a second of a core.  Beside the service's own they disturb nobody; later
they take a core from threads with an event in hand.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

import adaptive_contact
from adaptive_contact.service.refit_worker import HURRY

_MODULE: Final = "adaptive_contact.service.refit_worker"
# Read by the BLAS libraries when they are loaded, which is before the worker can say anything.
ONE_BLAS_THREAD: Final = {
    f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")
}


def start_process(*, hurry: bool = False) -> subprocess.Popen[bytes]:
    """Start a process that refits, for one :class:`~.refits.ProcessRefitter`.

    It ends with its stdin, and so with the process that started it.

    Args:
        hurry: nobody has an event in hand yet, and it need not stand behind others before it is
            there.

    Raises:
        OSError: there cannot be one more.
    """
    env = {**os.environ, **ONE_BLAS_THREAD}
    home = Path(adaptive_contact.__file__).parents[1]
    if home.name not in ("site-packages", "dist-packages"):  # run from a source tree
        env["PYTHONPATH"] = os.pathsep.join(filter(None, (str(home), env.get("PYTHONPATH"))))
    return subprocess.Popen(
        # Safe paths: the current folder, which may be anybody's, has nothing to say.
        [sys.executable, "-P", "-m", _MODULE, *((HURRY,) if hurry else ())],
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
