"""What glibc keeps of freed memory: nothing of a long log's arrays, of which each copy of the process would hold a copy.

Of a short one all: to give it back and ask for it again is a fifth of an identification's time.
"""

from __future__ import annotations

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's mallopt
_LARGE, _LARGEST, _FREED = 1 << 22, 1 << 25, 1 << 27  # bytes


def return_large_arrays() -> None:
    """Have large arrays returned as soon as they are free: left to itself glibc keeps ever larger ones, with gaps."""
    _set(M_MMAP_THRESHOLD, _LARGE)


def keep_freed_arrays() -> None:
    """Have freed memory kept for the arrays to come."""
    _set(M_MMAP_THRESHOLD, _LARGEST)
    _set(M_TRIM_THRESHOLD, _FREED)


def _set(option: int, size: int) -> None:
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(option, size)


def trim_heap() -> None:
    """Return what is free now between smaller arrays: what a copy of this process puts there it would hold besides."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
