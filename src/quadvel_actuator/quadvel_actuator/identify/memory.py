"""What glibc keeps of freed memory: nothing of a 10-minute log's arrays, of which each copy of the process would hold a copy."""

from __future__ import annotations

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, LARGE = -1, -3, 1 << 25  # of glibc's mallopt; bytes


def give_large_arrays_back() -> None:
    """Have large arrays returned as soon as they are free: left to itself glibc keeps ever larger ones, with gaps."""
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(M_MMAP_THRESHOLD, LARGE)
        mallopt(M_TRIM_THRESHOLD, 4 * LARGE)


def give_gaps_back() -> None:
    """Return what is free now between smaller arrays: what a copy of this process puts there it would hold besides."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
