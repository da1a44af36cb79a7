"""Time limits of calls without a clock: within `by_hand`, a call's time passes only where the call says so."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from sortie.scenarios.plugins.user_calls import _Watch

_ticks = [0]


class _End:
    """The end of a watch. Its `wait` returns at a tick, in place of after a time."""

    def __init__(self) -> None:
        self._over, self._seen = threading.Event(), _ticks[0]
        self.set = self._over.set

    def wait(self, _: float) -> bool:
        while not self._over.wait(0.001):
            if self._seen < _ticks[0]:
                self._seen += 1
                return False
        return True


def by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let time pass in `spin` alone for the watches that begin from now on."""
    init = _Watch.__init__

    def with_ticks(watch: Any, *of: Any) -> None:
        init(watch, *of)
        watch._over = _End()

    monkeypatch.setattr(_Watch, "__init__", with_ticks)


def spin() -> None:
    """Run for ever, while time passes."""
    while True:
        tick()


def tick() -> None:
    """Let a tick pass."""
    _ticks[0] += 1
    time.sleep(0.001)
