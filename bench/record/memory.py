"""Memory that a written trial leaves behind."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress


def release_memory() -> None:
    """Return freed memory to the system, where the C library is glibc (malloc_trim(3)): its heap
    is fragmented by frames, and would grow with each trial.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
