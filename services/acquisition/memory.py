"""Give-back of memory that a take has left unused to the operating system.

A take's bytes come and go in many sizes and threads. What lies free in between stays with the
process, a little more after each take, until glibc is told to give it back. What holds itself in
a circle, as the requests and answers of an upload do, is not even free before it is looked for.
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
    """Take everything that exists for lasting: call it once, in a process that is one station.

    Looking for circles then passes over modules, classes and devices, which would hold up all
    threads for tens of milliseconds, and is done by itself after fewer takes. numpy's cache of
    small arrays, which would fill up over many takes as ever other sizes come by, is full (4 MB).
    """
    small = [np.empty(n, np.uint8) for n in range(CACHED_BYTES) for _ in range(CACHED_ARRAYS)]
    small.clear()
    gc.collect()
    gc.freeze()
    # Python looks again when what is young has grown by a quarter of what it found here.
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
