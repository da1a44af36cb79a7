"""How much memory a worker may take: a run that needs more fails by itself, and the machine stays usable."""

from __future__ import annotations

import os
import resource
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_GROUP = Path("/sys/fs/cgroup/memory.max")
_LOCK = threading.Lock()
_LIMITED: list[tuple[int, int]] = []
"""The limits before, for each block that is entered: a worker with several threads flies several runs."""


def machine_memory_b() -> int:
    """What the machine, or the container, has."""
    here = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(here, int(_GROUP.read_text()))
    except (OSError, ValueError):  # no container, or one without a limit
        return here


@contextmanager
def limited(limit_b: int | None) -> Iterator[None]:
    """Allocations fail with a MemoryError where this process would take more than `limit_b`; None sets no limit.

    The limit is on what programs write to (RLIMIT_DATA), counted on from what is resident now: what libraries reserve and do
    not use is free. Only Linux counts this way; elsewhere there is no limit.
    """
    if limit_b is None or sys.platform != "linux":
        yield
        return
    with _LOCK:
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        if not _LIMITED:
            reserved_b, resident_b = _now_b()
            most = reserved_b + max(0, limit_b - resident_b)
            resource.setrlimit(resource.RLIMIT_DATA, (_least(most, soft, hard), hard))
        _LIMITED.append((soft, hard))
    try:
        yield
    finally:
        with _LOCK:
            before = _LIMITED.pop()
            if not _LIMITED:
                resource.setrlimit(resource.RLIMIT_DATA, before)


def _least(*limits: int) -> int:
    return min(limit for limit in limits if limit != resource.RLIM_INFINITY)


def _now_b() -> tuple[int, int]:
    """What this process could write to, and what of its memory is resident."""
    lines = Path("/proc/self/status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    data, resident = (int(status[name].split()[0]) * 1024 for name in ("VmData", "VmRSS"))
    return data, resident
