"""The plane's topics as ROS 2 names them, with the QoS that the paper maps them to; in bags and on the live bus alike.

| topic | type | QoS |
|---|---|---|
| `/fleet/context` | `sortie_msgs/msg/ContextDescriptor` | best effort, keep last 1 |
| `/drone_0/to_drone_1/directive` | `sortie_msgs/msg/DataPlaneDirective` | reliable, keep last 1 |
| `/drone_0/to_drone_1/features` | `std_msgs/msg/UInt8MultiArray` | best effort, keep last 1 |
| `/drone_0/to_drone_1/compact` | `std_msgs/msg/UInt8MultiArray` | reliable, keep last 1 |

ROS 2 messages have no keys, so keep-last-1 keeps one sample a topic: directives and payloads have a topic a link. The
context is one topic for the whole fleet, that who joins need not know its roster; its writers keep one sample each, as
the paper has it, and its readers as many as there may be drones.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

from sortie.fleet.messages.wire import DESCRIPTOR_NAME, DIRECTIVE_NAME
from sortie.scenarios.representation import BOXES, Representation

BYTES_NAME = "std_msgs/msg/UInt8MultiArray"


class TopicKind(StrEnum):
    """What a topic carries."""

    CONTEXT = "context"
    DIRECTIVE = "directive"
    FEATURES = "features"
    COMPACT = "compact"

    @property
    def ros_type(self) -> str:
        """The ROS 2 name of its messages' type."""
        return {TopicKind.CONTEXT: DESCRIPTOR_NAME, TopicKind.DIRECTIVE: DIRECTIVE_NAME}.get(self, BYTES_NAME)

    @property
    def reliable(self) -> bool:
        """Small things that must arrive go reliably, the frequent and the large best effort."""
        return self in (TopicKind.DIRECTIVE, TopicKind.COMPACT)

    @classmethod
    def of(cls, representation: Representation) -> TopicKind:
        """The kind of topic that carries a payload of this representation."""
        return cls.COMPACT if representation in BOXES else cls.FEATURES


PAYLOADS = (TopicKind.FEATURES, TopicKind.COMPACT)


class Topic(NamedTuple):
    """One topic; a link's where it has a source and a destination."""

    kind: TopicKind
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


CONTEXT = Topic(TopicKind.CONTEXT)


def links(drones: int) -> list[tuple[int, int]]:
    """Every (source, destination) of a fleet."""
    return [(i, j) for i in range(drones) for j in range(drones) if i != j]
