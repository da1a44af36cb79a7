"""A bus within one process, for nodes that a test steps itself."""

from __future__ import annotations

from collections import deque

from sortie.sim.export.topics import Topic


class MemoryReader:
    """A reader of one topic."""

    def __init__(self, topic: Topic, depth: int) -> None:
        self.topic = topic
        self.samples: deque[bytes] = deque(maxlen=depth)

    def take(self) -> list[bytes]:
        taken = list(self.samples)
        self.samples.clear()
        return taken


class MemoryWriter:
    """A writer of one topic."""

    def __init__(self, bus: MemoryBus, topic: Topic) -> None:
        self._bus, self.topic = bus, topic

    def write(self, cdr: bytes) -> None:
        self._bus.written.setdefault(self.topic, []).append(cdr)
        for reader in self._bus.readers.get(self.topic, []):
            reader.samples.append(cdr)

    @property
    def listeners(self) -> int:
        return len(self._bus.readers.get(self.topic, []))


class MemoryBus:
    """`sortie.sim.live.transport.Bus`; every node of a test gets the same one."""

    def __init__(self) -> None:
        self.readers: dict[Topic, list[MemoryReader]] = {}
        self.written: dict[Topic, list[bytes]] = {}

    def reader(self, topic: Topic, depth: int = 1) -> MemoryReader:
        reader = MemoryReader(topic, depth)
        self.readers.setdefault(topic, []).append(reader)
        return reader

    def writer(self, topic: Topic) -> MemoryWriter:
        return MemoryWriter(self, topic)

    def wait(self, timeout_s: float) -> bool:
        return False
