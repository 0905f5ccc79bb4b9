"""Pools of worker processes that end with the process that made them, however that ends."""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager


@contextmanager
def worker_pool(
    num_workers: int, prepare: Callable[[], object] | None = None
) -> Iterator[ProcessPoolExecutor]:
    """Fresh interpreters, which share no threads and locks with this process.

    If the block fails, waiting jobs are cancelled. If this process is killed, its workers end at
    once; those of a bare pool would go on with their jobs.

    Args:
        num_workers: processes.
        prepare: called once in each worker; picklable.
    """
    spawned = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(num_workers, spawned, _begin, (prepare,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(prepare: Callable[[], object] | None) -> None:
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    if prepare is not None:
        prepare()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
