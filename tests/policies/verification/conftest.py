"""Searches and drawn views end with their budgets: these count this process's own time, of which a busy machine takes none."""

from __future__ import annotations

import time

import pytest

from sortie.policies.verification import search


@pytest.fixture(autouse=True)
def _own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "monotonic", time.process_time)
