"""Control how glibc keeps freed memory.

For long logs, large arrays go back to the system as soon as they are freed, since each worker
process would hold a copy. For short logs freed memory is kept: returning it and requesting it
again costs a fifth of an identification's time.
"""

from __future__ import annotations

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Options of glibc's mallopt (malloc.h)."""
_LARGE_BYTES, _LARGEST_BYTES, _KEPT_BYTES = 1 << 22, 1 << 25, 1 << 27
"""Bytes: smallest array that is mapped separately, largest threshold, and memory kept at the top."""


def return_freed_arrays_to_system() -> None:
    """Return large arrays to the system as soon as they are freed.

    By default glibc raises its threshold with the size of freed arrays, and keeps them with gaps
    between.
    """
    _set(M_MMAP_THRESHOLD, _LARGE_BYTES)


def reuse_freed_arrays() -> None:
    """Keep freed memory for the next arrays."""
    _set(M_MMAP_THRESHOLD, _LARGEST_BYTES)
    _set(M_TRIM_THRESHOLD, _KEPT_BYTES)


def _set(option: int, size: int) -> None:
    """Set an option of glibc's mallopt, if the C library has it."""
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(option, size)


def trim_heap() -> None:
    """Return free memory between small arrays to the system, before worker processes copy it."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
