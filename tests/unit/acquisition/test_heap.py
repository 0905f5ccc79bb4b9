"""Memory that is free in the process goes back to the system."""

import platform
from pathlib import Path

import numpy as np
import pytest

from services.acquisition.heap import give_back_free_memory


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told")
def test_free_memory_goes_back():
    # Pieces below the size that the system gets back by itself, the newest one kept.
    pieces = [np.ones(100_000, dtype=np.uint8) for _ in range(600)]
    kept, before = pieces[-1], resident_bytes()
    del pieces
    assert give_back_free_memory()
    assert resident_bytes() < before - 40_000_000
    assert kept.all()
