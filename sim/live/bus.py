"""The bus: one participant's ends of the topics of `sortie.sim.export.topics`, on loopback unless told otherwise."""

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
from sortie.sim.live.messages import dds_type

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
"""Cyclone's configuration where `CYCLONEDDS_URI` names none: this host alone, fragments as large as a datagram may be."""
MAX_DEPTH = 64
_ANY = SampleState.Any | ViewState.Any | InstanceState.Any


class Reader:
    """One end that hears a topic."""

    def __init__(self, reader: DataReader[Any], topic: Topic) -> None:
        self._reader = reader
        self.topic = topic

    def take(self) -> list[bytes]:
        """What came since the last call, oldest first, as CDR."""
        return [s.cdr for s in self._reader.take(MAX_DEPTH) if hasattr(s, "cdr")]  # others are writers' farewells


class Writer:
    """One end that speaks on a topic."""

    def __init__(self, writer: DataWriter[Any], topic: Topic) -> None:
        self._writer: Any = writer  # parts of it have no types
        self.topic = topic
        self._sample = dds_type(topic.kind.ros_type)

    def write(self, cdr: bytes) -> None:
        """Publish CDR bytes."""
        self._writer.write(self._sample(cdr))

    @property
    def listeners(self) -> int:
        """How many readers it has found."""
        # not the list of them: the binding asks twice, and fails where one is found in between
        return int(self._writer.get_publication_matched_status().current_count)


class Bus:
    """One participant: a process's ends of the bus."""

    def __init__(self, domain: int) -> None:
        """Join a DDS domain (ROS 2: `ROS_DOMAIN_ID`), by `CYCLONEDDS_URI` where it is set, else on loopback."""
        self._domain = None if os.environ.get("CYCLONEDDS_URI") else _domain(domain)
        self._participant = DomainParticipant(domain)
        self._wake = WaitSet(self._participant)
        self._topics: dict[Topic, DdsTopic[Any]] = {}
        self._conditions: list[ReadCondition] = []

    def reader(self, topic: Topic, depth: int = 1) -> Reader:
        """An end that keeps the last `depth` samples until they are taken, and wakes `wait`."""
        reader = DataReader(self._participant, self._named(topic), qos=_qos(topic.kind, depth))
        condition = ReadCondition(reader, _ANY)
        self._conditions.append(condition)
        self._wake.attach(condition)
        return Reader(reader, topic)

    def writer(self, topic: Topic) -> Writer:
        """An end that speaks, keep-last-1."""
        return Writer(DataWriter(self._participant, self._named(topic), qos=_qos(topic.kind, 1)), topic)

    def wait(self, timeout_s: float) -> bool:
        """Sleep until something came in or the time is over; whether something did."""
        return self._wake.wait(max(0, round(timeout_s * 1e9))) > 0

    def _named(self, topic: Topic) -> DdsTopic[Any]:
        if topic not in self._topics:
            self._topics[topic] = DdsTopic(self._participant, topic.dds_name, dds_type(topic.kind.ros_type))
        return self._topics[topic]


def _domain(number: int) -> Domain | None:
    """The domain on loopback; None where this process is in it already."""
    try:
        return Domain(number, LOOPBACK)
    except DDSException as error:
        if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            raise
        return None


def _qos(kind: TopicKind, depth: int) -> Qos:
    """ROS 2 speaks plain CDR (XCDR1); readers and writers agree on reliability, depth is each one's own."""
    return Qos(
        Policy.Reliability.Reliable(max_blocking_time=0) if kind.reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
