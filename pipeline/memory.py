"""What a process does with the memory that it frees."""

from __future__ import annotations

import ctypes
import gc
from contextlib import suppress

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # mallopt(3)


def keep_freed_memory() -> None:
    """Let glibc hand out again what was freed, instead of returning it to the system.

    The system gives memory back page by page, each cleared first; a training step of the paper's MLPs, which makes and
    frees gigabytes, spends a third of its time on that (benchmarks/results/steps.json). The process then keeps the most
    that it ever held. Other C libraries are left as they are.
    """
    with suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def give_back() -> None:
    """Return what this process has freed to the system, where glibc can."""
    gc.collect()
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
