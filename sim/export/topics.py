"""The topics of the context plane in ROS 2, with the paper's QoS; bags and the live bus both use them.

| topic | type | QoS |
|---|---|---|
| `/fleet/context` | `sortie_msgs/msg/ContextDescriptor` | best effort, keep last 1 |
| `/drone_0/to_drone_1/directive` | `sortie_msgs/msg/DataPlaneDirective` | reliable, keep last 1 |
| `/drone_0/to_drone_1/features` | `std_msgs/msg/UInt8MultiArray` | best effort, keep last 1 |
| `/drone_0/to_drone_1/compact` | `std_msgs/msg/UInt8MultiArray` | reliable, keep last 1 |

ROS 2 messages have no keys, so keep-last-1 stores one sample for each topic. Directives and payloads therefore have one
topic for each link. The context is one topic for the whole fleet, so that a new drone need not know the roster. Its
writers store one sample each, as in the paper, and its readers as many as there may be drones.
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
        """The message type's name in ROS 2."""
        return {TopicKind.CONTEXT: DESCRIPTOR_NAME, TopicKind.DIRECTIVE: DIRECTIVE_NAME}.get(self, BYTES_NAME)

    @property
    def reliable(self) -> bool:
        """Whether it is sent reliably: small samples that must arrive are, frequent and large ones are best effort."""
        return self in (TopicKind.DIRECTIVE, TopicKind.COMPACT)

    @classmethod
    def of(cls, representation: Representation) -> TopicKind:
        """The kind of topic that carries a payload of this representation."""
        return cls.COMPACT if representation in BOXES else cls.FEATURES


PAYLOADS = (TopicKind.FEATURES, TopicKind.COMPACT)


class Topic(NamedTuple):
    """One topic; it belongs to a link if it has a source and a destination."""

    kind: TopicKind
    source: int | None = None
    destination: int | None = None

    @property
    def name(self) -> str:
        """Its name in ROS 2."""
        if self.source is None:
            return "/fleet/context"
        return f"/drone_{self.source}/to_drone_{self.destination}/{self.kind}"

    @property
    def dds_name(self) -> str:
        """Its name in DDS."""
        return f"rt{self.name}"


CONTEXT = Topic(TopicKind.CONTEXT)


def links(drones: int) -> list[tuple[int, int]]:
    """Every (source, destination) of a fleet."""
    return [(i, j) for i in range(drones) for j in range(drones) if i != j]
