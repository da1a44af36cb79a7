"""The C library's memory: what is freed is kept for the next map instead of being given back to the kernel."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""`M_…` of glibc's malloc.h."""


def keep_freed(most_bytes: int = 256 << 20, block_bytes: int = 32 << 20) -> bool:
    """Have each thread's heap keep up to so much freed memory, in blocks of up to so much; whether it could be had.

    A network's maps are of megabytes. glibc takes such blocks from the kernel and gives them back, page by page, at every
    layer. Other C libraries are left as they are.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    return bool(mallopt(_TRIM_THRESHOLD, most_bytes)) and bool(mallopt(_MMAP_THRESHOLD, block_bytes))
