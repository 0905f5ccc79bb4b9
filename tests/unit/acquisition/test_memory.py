"""Memory that is free in the process goes back to the system."""

import gc
import os
import platform
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest

from services.acquisition.recorder import give_back_free_memory, keep_for_life


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.long
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told")
def test_free_memory_goes_back():
    # Pieces below the size that the system gets back by itself, the newest one kept.
    pieces = [np.ones(100_000, dtype=np.uint8) for _ in range(600)]
    kept, before = pieces[-1], resident_bytes()
    del pieces
    assert give_back_free_memory()
    assert resident_bytes() < before - 40_000_000
    assert kept.all()


class Circle:
    """Holds itself."""

    def __init__(self):
        self.itself = self


@pytest.fixture
def no_collector():
    # The tests' own configuration has frozen what was imported.
    gc.unfreeze()
    gc.disable()
    yield
    gc.enable()
    gc.freeze()


@pytest.mark.long
def test_what_holds_itself_in_a_circle_is_free_then(no_collector):
    gone = weakref.ref(Circle())
    give_back_free_memory()
    assert gone() is not None, "a look through everything takes too long"
    keep_for_life()
    assert gone() is None
    gone = weakref.ref(Circle())
    give_back_free_memory()
    assert gone() is None


@pytest.mark.long
def test_what_exists_at_the_start_is_not_looked_through_again(no_collector):
    circle = weakref.ref(Circle())
    keep_for_life()
    assert circle() is None, "what nobody needs must not be kept for life"
    assert gc.get_freeze_count() > 10_000
    assert len(gc.get_objects()) < 1000
    younger = weakref.ref(Circle())
    give_back_free_memory()
    assert younger() is None


SMALL_ARRAYS = """
import ctypes
import numpy as np
from services.acquisition.recorder import keep_for_life

FIELDS = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()

class Figures(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in FIELDS]

figures = ctypes.CDLL(None).mallinfo2
figures.restype = Figures
keep_for_life()
before = figures().uordblks
small = [np.ones(size) for size in range(1, 127) for _ in range(5)]
small.clear()
print(figures().uordblks - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc tells its figures")
def test_small_arrays_of_whatever_size_take_no_more_memory():
    # In a process of its own, since numpy's cache is full once and for all.
    run = subprocess.run(
        [sys.executable, "-c", SMALL_ARRAYS],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert int(run.stdout) < 30_000
