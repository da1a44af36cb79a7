"""The bench node: it reads every topic of the fleet, counts serialised bytes, and collects the processes' reports."""

from __future__ import annotations

import time

from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.sim.export.topics import CONTEXT, PAYLOADS, Topic, TopicKind, links
from sortie.sim.live.payload_message import unpack_bytes
from sortie.sim.live.reports import Count, Report, SinceLastReport
from sortie.sim.live.transport import MAX_DEPTH, Bus, Reader

PAYLOAD_DEPTH = 16
"""Samples of a payload topic that are stored until they are read. A bench that is later than that misses some."""


class Bench:
    """One participant that only listens."""

    def __init__(self, bus: Bus, drones: int) -> None:
        self._bus = bus
        depths = {TopicKind.CONTEXT: MAX_DEPTH, TopicKind.DIRECTIVE: MAX_DEPTH}
        topics = [CONTEXT, *(Topic(kind, *link) for link in links(drones) for kind in (TopicKind.DIRECTIVE, *PAYLOADS))]
        self._readers = [self._bus.reader(topic, depths.get(topic.kind, PAYLOAD_DEPTH)) for topic in topics]
        self.counts: dict[Topic, Count] = dict.fromkeys(topics, Count())
        """By topic: bytes of CDR as serialised, seals included, payloads without the header of their message."""
        self._began_cpu_s = 0.0

    def begin(self) -> None:
        """Start counting from zero."""
        self.take()
        self.counts = dict.fromkeys(self.counts, Count())
        self._began_cpu_s = time.process_time()

    @property
    def cpu_s(self) -> float:
        """Processor time of this process since `begin`."""
        return time.process_time() - self._began_cpu_s

    def wait(self, timeout_s: float) -> None:
        """Sleep until a sample arrives or the time is over."""
        self._bus.wait(timeout_s)

    def take(self) -> None:
        """Count the samples that have arrived."""
        for reader in self._readers:
            self._take(reader)

    def of(self, kind: TopicKind) -> Count:
        """The sum over all topics of a kind."""
        of_kind = [c for topic, c in self.counts.items() if topic.kind == kind]
        return Count(sum(c.samples for c in of_kind), sum(c.bytes for c in of_kind))

    def _take(self, reader: Reader) -> None:
        topic = reader.topic
        for cdr in reader.take():
            self.counts[topic] = self.counts[topic].plus(_size(cdr, topic.kind))


def _size(cdr: bytes, kind: TopicKind) -> int:
    """The bytes that `Bench.counts` counts; a sample that is not a payload counts as it is."""
    try:
        return len(unpack_bytes(cdr)) if kind in PAYLOADS else len(cdr)
    except MalformedDatagram:
        return len(cdr)


class FleetReports:
    """The drones' reports together."""

    def __init__(self) -> None:
        self.last: dict[tuple[int, bool], Report] = {}
        """By drone, and whether its process started when others were in the air."""
        self.news: list[SinceLastReport] = []

    def add(self, report: Report, late: bool) -> None:
        """Add the next report of a process."""
        self.last[report.drone, late] = report
        self.news.append(report.new)
