"""Processes that work for another one."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextvars import ContextVar
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

from threadpoolctl import threadpool_limits

from adaptive_contact.service.refit_process import ONE_BLAS_THREAD

T = TypeVar("T")
R = TypeVar("R")

# How a worker ends that was interrupted.
_INTERRUPTED: Final = 130


class _Cluster(NamedTuple):
    scheduler: str
    folder: Path | None


_cluster: ContextVar[_Cluster | None] = ContextVar("cluster", default=None)


@contextlib.contextmanager
def on_cluster(scheduler: str | None, folder: Path | None) -> Iterator[None]:
    """Let :func:`worker_pool` hand its work to a Dask cluster, in this block.

    Args:
        scheduler: address; None leaves the work to this computer.
        folder: that all workers have to see.
    """
    token = _cluster.set(None if scheduler is None else _Cluster(scheduler, folder))
    try:
        yield
    finally:
        _cluster.reset(token)


def alone(processes: int, items: int) -> bool:
    """Return whether work is done in this process, as others would not speed it up."""
    return items <= 1 or (processes <= 1 and _cluster.get() is None)


@contextlib.contextmanager
def worker_pool(processes: int, *, finish: bool = False) -> Iterator[Executor]:
    """Open the processes that work is handed to: a cluster's, or some of this computer.

    Args:
        processes: at most so many of this computer.
        finish: on Ctrl-C the items in hand are finished instead, and those that wait are not begun.
    """
    cluster = _cluster.get()
    if cluster is None:
        with _local_pool(processes, finish=finish) as pool:
            yield pool
        return
    from adaptive_contact_studies.cluster import cluster_pool

    with cluster_pool(*cluster) as far:
        yield far


def completed(
    work: Callable[[T], R], items: Sequence[T], processes: int, *, finish: bool = False
) -> Iterator[tuple[T, R]]:
    """Do work on items, in order of completion; in this process where others do not speed it up.

    Args:
        work: a module-level function, or a partial of one.
        items: what to do it on.
        processes: at most so many of this computer.
        finish: as of :func:`worker_pool`.

    Yields:
        Items with their results; a failed one ends the others early.
    """
    if alone(processes, len(items)):
        for item in items:
            with threadpool_limits(1):  # as in a worker
                result = work(item)
            yield item, result
        return
    with worker_pool(min(processes, len(items)), finish=finish) as pool:
        futures = {pool.submit(work, item): item for item in items}
        for future in as_completed(futures):
            yield futures[future], future.result()


@contextlib.contextmanager
def _local_pool(processes: int, *, finish: bool) -> Iterator[ProcessPoolExecutor]:
    """Spawned processes of one BLAS thread each, which end when this one does, however it ends.

    Matrices as small as a leg's gain nothing from threads, and threads that wait for each other
    by spinning take the cores from the other processes.  Ctrl-C goes to the whole group: workers
    leave silently and the parent reports; what they write is written under another name first.
    The environment says one thread for as long as the pool is open, as workers start when there is
    something to do.
    """
    before = {name: os.environ.get(name) for name in ONE_BLAS_THREAD}
    os.environ.update(ONE_BLAS_THREAD)
    pool = ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_serve,
        initargs=(finish,),
    )
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _serve(finish: bool) -> None:
    """In a worker: end with the parent; a killed one would leave it behind."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()
    if finish:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    else:
        signal.signal(signal.SIGINT, lambda *_: os._exit(_INTERRUPTED))


def _leave_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
