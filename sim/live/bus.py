"""The bus: one participant's readers and writers of the topics in `sortie.sim.export.topics`, on loopback by default."""

from __future__ import annotations

import os
from typing import Any

from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic

from sortie.sim.export.topics import Topic, TopicKind
from sortie.sim.live.loopback import on_loopback
from sortie.sim.live.messages import dds_type
from sortie.sim.live.transport import MAX_DEPTH

LOOPBACK = """\
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
    <MaxMessageSize>65500B</MaxMessageSize>
    <FragmentSize>65000B</FragmentSize>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>
    <Peers><Peer address="localhost"/></Peers>
  </Discovery>
  <Internal><SocketReceiveBufferSize max="16MiB"/></Internal>
</Domain></CycloneDDS>
"""
"""Cyclone's configuration if `CYCLONEDDS_URI` is not set: this host alone, fragments of the largest datagram size."""
_ANY = SampleState.Any | ViewState.Any | InstanceState.Any


class Reader:
    """A reader of one topic."""

    def __init__(self, reader: DataReader[Any], topic: Topic) -> None:
        self._reader = reader
        self.topic = topic

    def take(self) -> list[bytes]:
        """The samples since the last call, oldest first, as CDR."""
        return [
            s.cdr for s in self._reader.take(MAX_DEPTH) if hasattr(s, "cdr")
        ]  # other samples only announce that a writer has left


class Writer:
    """A writer of one topic."""

    def __init__(self, writer: DataWriter[Any], topic: Topic) -> None:
        self._writer: Any = writer  # it has no complete type hints
        self.topic = topic
        self._sample = dds_type(topic.kind.ros_type)

    def write(self, cdr: bytes) -> None:
        """Publish CDR bytes."""
        self._writer.write(self._sample(cdr))

    @property
    def listeners(self) -> int:
        """The number of readers that it has found."""
        # the binding's list of them fails if a reader is found while it is read
        return int(self._writer.get_publication_matched_status().current_count)


class Bus:
    """One participant: a process's readers and writers."""

    def __init__(self, domain: int) -> None:
        """Join a DDS domain (ROS 2: `ROS_DOMAIN_ID`), by `CYCLONEDDS_URI` if it is set, otherwise on loopback."""
        self._domain = None if os.environ.get("CYCLONEDDS_URI") else _domain(domain)
        self._participant = DomainParticipant(domain)
        self._wake = WaitSet(self._participant)
        self._topics: dict[Topic, DdsTopic[Any]] = {}
        self._conditions: list[ReadCondition] = []

    def reader(self, topic: Topic, depth: int = 1) -> Reader:
        """A reader that stores the last `depth` samples until they are read, and wakes `wait`."""
        reader = DataReader(self._participant, self._named(topic), qos=_qos(topic.kind, depth))
        condition = ReadCondition(reader, _ANY)
        self._conditions.append(condition)
        self._wake.attach(condition)
        return Reader(reader, topic)

    def writer(self, topic: Topic) -> Writer:
        """A writer, keep-last-1."""
        return Writer(DataWriter(self._participant, self._named(topic), qos=_qos(topic.kind, 1)), topic)

    def wait(self, timeout_s: float) -> bool:
        """Sleep until a sample arrives or the time is over. Returns whether one arrived."""
        return self._wake.wait(max(0, round(timeout_s * 1e9))) > 0

    def _named(self, topic: Topic) -> DdsTopic[Any]:
        if topic not in self._topics:
            self._topics[topic] = DdsTopic(self._participant, topic.dds_name, dds_type(topic.kind.ros_type))
        return self._topics[topic]


def _domain(number: int) -> Domain | None:
    """The domain on loopback; None if this process has joined it already."""
    try:
        return on_loopback(lambda: Domain(number, LOOPBACK))
    except DDSException as error:
        if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            raise
        return None


def _qos(kind: TopicKind, depth: int) -> Qos:
    """ROS 2 uses plain CDR (XCDR1). Readers and writers must have the same reliability; each has its own depth."""
    return Qos(
        Policy.Reliability.Reliable(max_blocking_time=0) if kind.reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
