"""DDS domains and UDP ports for tests: what runs at the same time on this host, in this suite or in another, shares none."""

from __future__ import annotations

import fcntl
import os
import tempfile
from functools import cache
from pathlib import Path

_DOMAINS = range(20, 230)


@cache
def domain(of: str) -> int:
    """The DDS domain of a module or a test: locked until this process ends, also if it is killed."""
    for number in _DOMAINS:
        lock = os.open(Path(tempfile.gettempdir()) / f"sortie-tests-dds-{number}.lock", os.O_RDONLY | os.O_CREAT, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
        else:
            return number
    raise RuntimeError(f"no DDS domain is free: every one of {_DOMAINS.start} to {_DOMAINS.stop - 1} is locked")


def udp_port(of: str) -> int:
    """A UDP port of a module or a test: DDS leaves it free in the ports of the module's domain."""
    return 7400 + 250 * domain(of) + 200
