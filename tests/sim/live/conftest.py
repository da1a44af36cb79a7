"""Cyclone DDS has no wheels for Python 3.14 yet: there `sortie live` does not run, and so its tests do not."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.util import find_spec

import pytest

collect_ignore_glob = ["test_*.py"] if sys.version_info >= (3, 14) and find_spec("cyclonedds") is None else []


@pytest.fixture(scope="session", autouse=True)
def _busy_machine() -> Iterator[None]:
    """Limits of a flight end a hang alone: a process may take minutes to start beside others."""
    from sortie.sim.live import session, watchdog

    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            (session, "CONNECT_S"),
            (session, "LAST_REPORT_S"),
            (session, "EXIT_S"),
            (watchdog, "LOAD_S"),
        ):
            patch.setattr(module, name, 600.0)
        yield
