"""What the nodes of a drone need of a bus: Cyclone DDS (`sortie.sim.live.bus`) and rclpy (`ros2/sortie_ros`) each have it."""

from __future__ import annotations

from typing import Protocol

from sortie.sim.export.topics import Topic

MAX_DEPTH = 64
"""The most samples that a reader stores until they are read."""


class Reader(Protocol):
    """A reader of one topic."""

    topic: Topic

    def take(self) -> list[bytes]:
        """The samples since the last call, oldest first, as CDR."""


class Writer(Protocol):
    """A writer of one topic."""

    topic: Topic

    def write(self, cdr: bytes) -> None:
        """Publish CDR bytes."""

    @property
    def listeners(self) -> int:
        """The number of readers that it has found."""


class Bus(Protocol):
    """One participant: a process's readers and writers."""

    def reader(self, topic: Topic, depth: int = 1) -> Reader:
        """A reader that stores the last `depth` samples until they are read."""

    def writer(self, topic: Topic) -> Writer:
        """A writer, keep-last-1."""

    def wait(self, timeout_s: float) -> bool:
        """Sleep until a sample arrives or the time is over. Returns whether one arrived."""
