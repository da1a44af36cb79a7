"""The bus: topics as ROS 2 names them, their QoS as the paper maps it, and one participant's ends of them.

| topic in ROS 2 | in DDS | type | QoS |
|---|---|---|---|
| `/fleet/context` | `rt/fleet/context` | `sortie_msgs/msg/ContextDescriptor` | best effort, keep last 1 |
| `/drone_0/to_drone_1/directive` | `rt/drone_0/…` | `sortie_msgs/msg/DataPlaneDirective` | reliable, keep last 1 |
| `/drone_0/to_drone_1/features` | `rt/drone_0/…` | `std_msgs/msg/UInt8MultiArray` | best effort, keep last 1 |
| `/drone_0/to_drone_1/compact` | `rt/drone_0/…` | `std_msgs/msg/UInt8MultiArray` | reliable, keep last 1 |

ROS 2 messages have no keys, so keep-last-1 keeps one sample a topic: directives and payloads have a topic a link. The
context is one topic for the whole fleet, that who joins need not know its roster; its writers keep one sample each, as
the paper has it, and its readers as many as there may be drones.
"""

from __future__ import annotations

import os
from enum import StrEnum
from typing import Any, NamedTuple

from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic

from fleet.wire import DESCRIPTOR_NAME, DIRECTIVE_NAME
from sim.live.messages import BYTES_NAME, dds_type

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


class Kind(StrEnum):
    """What a topic carries."""

    CONTEXT = "context"
    DIRECTIVE = "directive"
    FEATURES = "features"
    COMPACT = "compact"

    @property
    def ros_type(self) -> str:
        """The ROS 2 name of its messages' type."""
        return {Kind.CONTEXT: DESCRIPTOR_NAME, Kind.DIRECTIVE: DIRECTIVE_NAME}.get(self, BYTES_NAME)

    @property
    def reliable(self) -> bool:
        """Small things that must arrive go reliably, the frequent and the large best effort."""
        return self in (Kind.DIRECTIVE, Kind.COMPACT)


PAYLOADS = (Kind.FEATURES, Kind.COMPACT)


class Topic(NamedTuple):
    """One topic; a link's where it has a source and a destination."""

    kind: Kind
    source: int | None = None
    destination: int | None = None

    @property
    def name(self) -> str:
        """As ROS 2 nodes call it."""
        if self.source is None:
            return "/fleet/context"
        return f"/drone_{self.source}/to_drone_{self.destination}/{self.kind}"

    @property
    def dds_name(self) -> str:
        """As it is called on the bus."""
        return f"rt{self.name}"


CONTEXT = Topic(Kind.CONTEXT)


def links(drones: int) -> list[tuple[int, int]]:
    """Every (source, destination) of a fleet."""
    return [(i, j) for i in range(drones) for j in range(drones) if i != j]


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
        self._writer = writer
        self.topic = topic
        self._sample = dds_type(topic.kind.ros_type)

    def write(self, cdr: bytes) -> None:
        """Publish CDR bytes."""
        self._writer.write(self._sample(cdr))

    @property
    def listeners(self) -> int:
        """How many readers it has found."""
        return len(self._writer.get_matched_subscriptions())


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


def _qos(kind: Kind, depth: int) -> Qos:
    """ROS 2 speaks plain CDR (XCDR1); readers and writers agree on reliability, depth is each one's own."""
    return Qos(
        Policy.Reliability.Reliable(max_blocking_time=0) if kind.reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
