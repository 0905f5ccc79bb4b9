"""Nothing comes in; memory that a take has left unused goes back to the operating system.

A take's bytes come and go in many sizes and threads. What lies free in between stays with the
process, a little more after each take, until glibc is told to give it back.
"""

import ctypes


def give_back_free_memory() -> bool:
    """Between takes: milliseconds. False where the C library has no `malloc_trim` (not glibc)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is None:
        return False
    trim(ctypes.c_size_t(0))
    return True
