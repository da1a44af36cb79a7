"""Joins several observers of one flight into one."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Protocol, Self

import pyarrow as pa

from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import Observer


class Watcher(Observer, Protocol):
    """An observer that holds something, a socket or a viewer."""

    def close(self) -> None: ...


class Watchers:
    """An observer that passes each call on to several, in their order, and closes them when the `with` ends."""

    def __init__(self, watchers: Sequence[Watcher]) -> None:
        self._watchers = watchers

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for watcher in self._watchers:
            watcher.close()

    def __bool__(self) -> bool:
        return bool(self._watchers)

    def begin(self, scenario: Scenario, scene: SceneModel) -> None:
        """The sortie begins."""
        for watcher in self._watchers:
            watcher.begin(scenario, scene)

    def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
        """A simulated second is over."""
        for watcher in self._watchers:
            watcher.second(t_s, new)
