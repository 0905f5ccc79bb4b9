"""Release of unused memory to the operating system after a take.

A take allocates and frees memory in many sizes and threads. glibc keeps free memory in the process,
a little more after each take, until `malloc_trim` is called. Objects in reference cycles, such as
the requests and responses of an upload, are only freed by the garbage collector.
"""

import ctypes
import gc

import numpy as np

# What numpy keeps of small arrays that were freed, for each size in bytes, to give it out again
# (numpy/_core/src/multiarray/alloc.c).
CACHED_BYTES, CACHED_ARRAYS = 1024, 7
# Looked up once: every handle of the C library is a class of its own, which only the collector of
# cycles removes.
_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None)


def keep_for_life() -> None:
    """Exclude all existing objects from garbage collection; call once, in a station's process.

    Otherwise each collection would visit modules, classes and devices and block all threads for
    tens of milliseconds. Automatic collections then also run after fewer takes. It also fills
    numpy's cache of small arrays (4 MB), which would otherwise grow over many takes.
    """
    small = [np.empty(n, np.uint8) for n in range(CACHED_BYTES) for _ in range(CACHED_ARRAYS)]
    small.clear()
    gc.collect()
    gc.freeze()
    # The next full collection starts when young objects exceed a quarter of these.
    gc.collect()


def give_back_free_memory() -> bool:
    """Between takes: milliseconds. False where the C library has no `malloc_trim` (not glibc).

    Circles are looked for after `keep_for_life` only: without it that would hold up readers in the
    middle of a take, if it is an upload that calls this.
    """
    if gc.get_freeze_count():
        gc.collect()
    if _TRIM is None:
        return False
    _TRIM(ctypes.c_size_t(0))
    return True
