"""Parallel processing of cameras, one thread each."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

R = TypeVar("R")

MAX_THREADS = 8
_pools: list[ThreadPoolExecutor] = []
# A forked worker does not inherit its parent's threads, so it must not reuse their pools.
os.register_at_fork(after_in_child=_pools.clear)


def each_camera(work: Callable[[str], R], cameras: Iterable[str]) -> dict[str, R]:
    """Call `work` for every camera; a single camera is processed in the caller's thread."""
    names = list(cameras)
    if len(names) < 2:
        return {name: work(name) for name in names}
    if not _pools:
        _pools.append(ThreadPoolExecutor(MAX_THREADS, thread_name_prefix="camera"))
    return dict(zip(names, _pools[0].map(work, names), strict=True))
