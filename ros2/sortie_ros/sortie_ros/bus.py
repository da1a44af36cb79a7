"""rclpy as a bus (`sortie.sim.live.transport.Bus`): topics, message types and QoS of the context plane.

Messages go in and out serialised. The seal of a message stands behind its fields, where no field of a ROS message is.
"""

from __future__ import annotations

from collections import deque

import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sortie_msgs.msg import ContextDescriptor, DataPlaneDirective
from std_msgs.msg import UInt8MultiArray

from sortie.sim.export.topics import Topic, TopicKind

MESSAGES = {
    TopicKind.CONTEXT: ContextDescriptor,
    TopicKind.DIRECTIVE: DataPlaneDirective,
    TopicKind.FEATURES: UInt8MultiArray,
    TopicKind.COMPACT: UInt8MultiArray,
}


def qos(kind: TopicKind, depth: int) -> QoSProfile:
    """Directives and compact payloads are reliable; descriptors and features are best effort."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if kind.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


class RosReader:
    """A subscription that keeps serialised messages until they are taken."""

    def __init__(self, node: Node, topic: Topic, depth: int) -> None:
        self.topic = topic
        self._samples: deque[bytes] = deque(maxlen=depth)
        self._subscription = node.create_subscription(
            MESSAGES[topic.kind], topic.name, self._samples.append, qos(topic.kind, depth), raw=True
        )

    def take(self) -> list[bytes]:
        """The messages since the last call, oldest first, as CDR."""
        taken = [bytes(sample) for sample in self._samples]
        self._samples.clear()
        return taken


class RosWriter:
    """A publisher of serialised messages, keep last 1."""

    def __init__(self, node: Node, topic: Topic) -> None:
        self.topic = topic
        self._publisher: Publisher = node.create_publisher(MESSAGES[topic.kind], topic.name, qos(topic.kind, 1))

    def write(self, cdr: bytes) -> None:
        """Publish CDR bytes."""
        self._publisher.publish(cdr)

    @property
    def listeners(self) -> int:
        """The number of subscriptions that it has found."""
        return int(self._publisher.get_subscription_count())


class RosBus:
    """A node's publishers and subscriptions."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def reader(self, topic: Topic, depth: int = 1) -> RosReader:
        """A subscription that stores the last `depth` messages until they are taken."""
        return RosReader(self._node, topic, depth)

    def writer(self, topic: Topic) -> RosWriter:
        """A publisher."""
        return RosWriter(self._node, topic)

    def wait(self, timeout_s: float) -> bool:
        """Handle one callback of rclpy, or wait until the time is over."""
        rclpy.spin_once(self._node, timeout_sec=timeout_s)
        return True
