"""A cluster on a busy machine takes long to answer: the limit ends a hang alone."""

from __future__ import annotations

import pytest

from sortie.sim.experiment import cluster


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 600.0)
