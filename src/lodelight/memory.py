"""What a process keeps of the memory that it has used once."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
LARGE, TOP = 2 << 20, 16 << 20  # bytes


def give_back_large() -> None:
    """Large arrays go back to the system when they are freed. To be called at least once in a process that maps.

    By itself glibc's malloc learns from the first large array that is freed to keep the room of all that come: after
    the adjustment of a map of 300 keyframes, 110 MB more than is in use. Elsewhere than on glibc nothing happens.
    """
    if sys.platform.startswith("linux"):
        with suppress(OSError, AttributeError):
            mallopt = ctypes.CDLL(None).mallopt
            mallopt(M_MMAP_THRESHOLD, LARGE)
            mallopt(M_TRIM_THRESHOLD, TOP)
