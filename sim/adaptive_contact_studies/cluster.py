"""Work done by a Dask cluster instead of processes of this computer.

Workers write what they make where this process reads it: ``--out`` is a folder that all of them
see.  Before any work the cluster is checked: each worker sees the folder, has this very source, and
does one thing at a time, as the simulator and the learners are made for processes of one thread.
"""

from __future__ import annotations

import contextlib
import platform
import tempfile
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from pathlib import Path
from typing import Any, Final

import adaptive_contact
import adaptive_contact_sim
import adaptive_contact_studies
from adaptive_contact.errors import ConfigurationError, needs
from adaptive_contact_studies.cache import sources_digest

_CONNECT_S: Final = 10.0
# Tries of a task whose worker died; with more, the task itself is at fault.
_DEATHS: Final = 3


@contextlib.contextmanager
def cluster_pool(scheduler: str, folder: Path | None) -> Iterator[Executor]:
    """Make a cluster look like a pool of processes.

    What a worker had in hand when it died is done by another one.

    Raises:
        MissingExtraError: Dask is not installed here.
        ConfigurationError: there is no such cluster, or a worker cannot do the work.
    """
    with needs("--scheduler", "cluster"):
        import dask
        from distributed import Client, KilledWorker
        from distributed.comm.core import CommClosedError
    try:
        # Each address is tried for as long as this, and no dashboard is looked for.
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigurationError(
            f"--scheduler {scheduler}: no scheduler of Dask answers there; start `dask scheduler` "
            "and `dask worker ADDRESS --nthreads 1`, and give the address that it prints"
        ) from error
    with contextlib.closing(client), dask.config.set({"distributed.scheduler.allowed-failures": 3}):
        _check(client, scheduler, folder)
        pool = client.get_executor(pure=False, retries=_DEATHS)
        try:
            yield pool
        except (CancelledError, CommClosedError) as error:
            raise ConfigurationError(
                f"--scheduler {scheduler}: it went away; start it again, and run the same command "
                "again to go on"
            ) from error
        except KilledWorker as error:
            raise ConfigurationError(
                f"--scheduler {scheduler}: a task ended {_DEATHS} workers (out of memory?); run "
                "the same command again to go on, with more memory a worker"
            ) from error
        finally:
            pool.shutdown(wait=False)


def _check(client: Any, scheduler: str, folder: Path | None) -> None:
    """Refuse a cluster whose workers cannot do the work.

    Raises:
        ConfigurationError: with the first that cannot, and why.
    """
    threads: dict[str, int] = client.nthreads()
    if not threads:
        raise ConfigurationError(
            f"--scheduler {scheduler}: it has no workers; start `dask worker {scheduler} "
            "--nthreads 1`, one for each core"
        )
    for worker, count in sorted(threads.items()):
        if count != 1:
            raise ConfigurationError(
                f"--scheduler {scheduler}: worker {worker} has {count} threads; start it with "
                "--nthreads 1"
            )
    ours = same_here()
    with contextlib.ExitStack() as stack:
        token = None
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(
                tempfile.NamedTemporaryFile(dir=folder.resolve(), prefix=".seen-by-workers-")
            )
            token = file.name
        answers = client.run(_prepare, token, on_error="return")
    found = {f"worker {address}": answer for address, answer in answers.items()}
    try:  # which reads the tasks that it hands on
        found["the scheduler"] = {**client.run_on_scheduler(same_here), "sees": True}
    except Exception as error:  # of any kind that a foreign process may raise
        found["the scheduler"] = error
    for who, answer in sorted(found.items()):
        why = why_not(answer, ours, folder)
        if why is not None:
            raise ConfigurationError(f"--scheduler {scheduler}: {who} {why}")


def why_not(answer: Any, ours: dict[str, str], folder: Path | None) -> str | None:
    """Say what is wrong with a worker, and what to do; None if nothing is."""
    if isinstance(answer, ModuleNotFoundError):
        return (
            f"lacks {answer.name}; install there what is installed here: pip install "
            "'adaptive-contact[studies,cluster]'"
        )
    if isinstance(answer, BaseException):
        return f"cannot be asked ({answer}); see its log"
    for what, value in ours.items():
        if answer[what] != value:
            return f"has another {what} ({answer[what]}, here {value}); install the same there"
    if not answer["sees"]:
        return f"does not see {folder}; give an --out on a file system that all workers share"
    return None


def _prepare(token: str | None) -> dict[str, Any]:
    """In a worker: what it is, and whether it sees a file; one BLAS thread from here on."""
    import mujoco  # noqa: F401 - a worker without it is reported before any work
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    return {**same_here(), "sees": token is None or Path(token).exists()}


def same_here() -> dict[str, str]:
    """Return what has to be the same in all processes that work together, by name."""
    packages = (adaptive_contact, adaptive_contact_sim, adaptive_contact_studies)
    roots = [Path(str(package.__file__)).parent for package in packages]
    digest = sources_digest(file for root in roots for file in sorted(root.rglob("*.py")))
    return {"Python": platform.python_version(), "adaptive-contact": digest.hexdigest()[:12]}
