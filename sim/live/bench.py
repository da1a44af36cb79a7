"""The bench node: hears every topic of the fleet, counts serialised bytes, and keeps what the processes report."""

from __future__ import annotations

import time
from collections import Counter

from sortie.fleet.messages.auth import Opened
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.sim.export.topics import CONTEXT, PAYLOADS, Topic, TopicKind, links
from sortie.sim.live.bus import MAX_DEPTH, Bus, Reader
from sortie.sim.live.messages import unpack_bytes
from sortie.sim.live.node import opened
from sortie.sim.live.reports import Count, News, Report

PAYLOAD_DEPTH = 16
"""Samples kept of a payload topic until they are taken: a bench that is late by more loses count."""


class Bench:
    """One participant that only listens."""

    def __init__(self, domain: int, drones: int) -> None:
        self._bus = Bus(domain)
        depths = {TopicKind.CONTEXT: MAX_DEPTH, TopicKind.DIRECTIVE: MAX_DEPTH}
        topics = [CONTEXT, *(Topic(kind, *link) for link in links(drones) for kind in (TopicKind.DIRECTIVE, *PAYLOADS))]
        self._readers = [self._bus.reader(topic, depths.get(topic.kind, PAYLOAD_DEPTH)) for topic in topics]
        self.counts: dict[Topic, Count] = dict.fromkeys(topics, Count())
        """By topic: CDR as serialised, payloads without what their message puts in front of them."""
        self.heard: Counter[int] = Counter()
        """Descriptors by who published them."""
        self._began_cpu_s = 0.0

    def begin(self) -> None:
        """Count from here; what came before is forgotten."""
        self.take()
        self.counts = dict.fromkeys(self.counts, Count())
        self.heard.clear()
        self._began_cpu_s = time.process_time()

    @property
    def cpu_s(self) -> float:
        """Processor time of this process since the begin."""
        return time.process_time() - self._began_cpu_s

    def wait(self, timeout_s: float) -> None:
        """Sleep until something came in or the time is over."""
        self._bus.wait(timeout_s)

    def take(self) -> None:
        """Count what came in."""
        for reader in self._readers:
            self._take(reader)

    def of(self, kind: TopicKind) -> Count:
        """All topics of a kind together."""
        of_kind = [c for topic, c in self.counts.items() if topic.kind == kind]
        return Count(sum(c.samples for c in of_kind), sum(c.bytes for c in of_kind))

    def _take(self, reader: Reader) -> None:
        topic = reader.topic
        for cdr in reader.take():
            self.counts[topic] = self.counts[topic].plus(_size(cdr, topic.kind))
            if topic.kind == TopicKind.CONTEXT:
                descriptor = opened(cdr)
                if isinstance(descriptor, Opened):
                    self.heard[descriptor.descriptor.agent_id] += 1


def _size(cdr: bytes, kind: TopicKind) -> int:
    """As `Bench.counts` counts; what is no payload counts as it came."""
    try:
        return len(unpack_bytes(cdr)) if kind in PAYLOADS else len(cdr)
    except MalformedDatagram:
        return len(cdr)


class FleetReports:
    """What the drones reported, put together."""

    def __init__(self) -> None:
        self.last: dict[int, Report] = {}
        self.news: list[News] = []

    def add(self, report: Report) -> None:
        """The next report of its drone."""
        self.last[report.drone] = report
        self.news.append(report.new)
