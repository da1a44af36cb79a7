"""A stand-in for ROS 2, which is not at hand: just what `ros2/sortie_ros` uses of rclpy, launch and the message packages.

`installed()` puts it into `sys.modules` for a while. All nodes of a process share one bus in memory. Parameters have the
names, order and kinds that `DOCUMENTED` states; a test compares both. Nothing of ROS is in here.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from types import ModuleType
from typing import Any

from places import ROOT

DOCUMENTED = {
    "rclpy.init": "(*, args, context, domain_id, signal_handler_options)",
    "rclpy.ok": "(*, context)",
    "rclpy.shutdown": "(*, context, uninstall_handlers)",
    "rclpy.spin_once": "(node, *, executor, timeout_sec)",
    "rclpy.node.Node.create_publisher": "(self, msg_type, topic, qos_profile, *, callback_group, event_callbacks, qos_overriding_options, publisher_class)",
    "rclpy.node.Node.create_subscription": "(self, msg_type, topic, callback, qos_profile, *, callback_group, event_callbacks, qos_overriding_options, raw)",
    "rclpy.node.Node.declare_parameter": "(self, name, value, descriptor, ignore_override)",
    "rclpy.node.Node.get_logger": "(self)",
    "rclpy.node.Node.destroy_node": "(self)",
    "rclpy.publisher.Publisher.publish": "(self, msg)",
    "rclpy.publisher.Publisher.get_subscription_count": "(self)",
}
"""Signatures in rclpy of ROS 2 Humble and later, without types and defaults: docs.ros.org, packages rclpy."""


class HistoryPolicy(IntEnum):
    KEEP_LAST = 1


class ReliabilityPolicy(IntEnum):
    RELIABLE = 1
    BEST_EFFORT = 2


class DurabilityPolicy(IntEnum):
    VOLATILE = 2


class QoSProfile:
    """By keyword alone, as in Humble."""

    def __init__(self, **given: Any) -> None:
        assert set(given) <= {"history", "depth", "reliability", "durability"}
        self.history, self.depth = given["history"], given["depth"]
        self.reliability, self.durability = given["reliability"], given["durability"]


class ExternalShutdownException(Exception):
    """ROS ends."""


class Parameter:
    def __init__(self, value: Any) -> None:
        self.value = value


class Logger:
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, message: str, **kwargs: Any) -> None:
        self.lines.append(message)

    warning = error = info


class Subscription:
    def __init__(self, msg_type: type, callback: Callable[[Any], None], qos: QoSProfile) -> None:
        self.msg_type, self.callback, self.qos = msg_type, callback, qos
        self.waiting: deque[bytes] = deque(maxlen=qos.depth)


BUS: dict[str, list[Subscription]] = {}
STATE = {"ok": False}
PARAMETERS: dict[str, Any] = {}
"""What the command line or a launch file would set for the next node."""


class Publisher:
    def __init__(self, msg_type: type, topic: str, qos: QoSProfile) -> None:
        self.msg_type, self.topic, self.qos = msg_type, topic, qos

    def publish(self, msg: Any) -> None:
        if not isinstance(msg, bytes | self.msg_type):
            raise TypeError(f"Expected {self.msg_type}, got {type(msg)}")
        assert isinstance(msg, bytes), "this stand-in serialises no messages"
        assert msg[:2] == b"\0\1", "a serialised message begins with its encapsulation"
        for subscription in self._matched():
            subscription.waiting.append(msg)

    def get_subscription_count(self) -> int:
        return len(self._matched())

    def _matched(self) -> list[Subscription]:
        """A best-effort publisher does not match a reliable subscription."""
        return [
            s
            for s in BUS.get(self.topic, [])
            if s.msg_type is self.msg_type and self.qos.reliability <= s.qos.reliability
        ]


class Node:
    def __init__(self, node_name: str, *, context: Any = None, cli_args: Any = None, namespace: Any = None) -> None:
        self.name, self.logger, self.parameters = node_name, Logger(), dict(PARAMETERS)
        self.publishers: list[Publisher] = []
        self.subscriptions: list[tuple[str, Subscription]] = []
        self.declared: set[str] = set()

    def create_publisher(
        self, msg_type: type, topic: str, qos_profile: Any, *, callback_group: Any = None, event_callbacks: Any = None,
        qos_overriding_options: Any = None, publisher_class: Any = Publisher,
    ) -> Publisher:  # fmt: skip
        self.publishers.append(Publisher(msg_type, topic, qos_profile))
        return self.publishers[-1]

    def create_subscription(
        self, msg_type: type, topic: str, callback: Any, qos_profile: Any, *, callback_group: Any = None,
        event_callbacks: Any = None, qos_overriding_options: Any = None, raw: bool = False,
    ) -> Subscription:  # fmt: skip
        assert raw, "this stand-in parses no messages"
        made = Subscription(msg_type, callback, qos_profile)
        BUS.setdefault(topic, []).append(made)
        self.subscriptions.append((topic, made))
        return made

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        assert name not in self.declared, f"rclpy raises: {name} is declared twice"
        self.declared.add(name)
        given = self.parameters.get(name, value)
        assert type(given) is type(value), f"rclpy raises: {name} has the type of its default"
        return Parameter(given)

    def get_logger(self) -> Logger:
        return self.logger

    def destroy_node(self) -> None:
        for topic, subscription in self.subscriptions:
            BUS[topic].remove(subscription)
        self.subscriptions.clear()


def init(*, args: Any = None, context: Any = None, domain_id: Any = None, signal_handler_options: Any = None) -> None:
    STATE["ok"] = True


def ok(*, context: Any = None) -> bool:
    return STATE["ok"]


def shutdown(*, context: Any = None, uninstall_handlers: Any = None) -> None:
    STATE["ok"] = False


def spin_once(node: Node, *, executor: Any = None, timeout_sec: float | None = None) -> None:
    """One callback, or a short wait."""
    for _, subscription in node.subscriptions:
        if subscription.waiting:
            subscription.callback(subscription.waiting.popleft())
            return
    time.sleep(min(timeout_sec or 0.0, 0.001))


class Action:
    """An action of launch: it keeps what it is given."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named


class LaunchConfiguration(Action):
    def perform(self, context: Any) -> str:
        return str(context[self.given[0]])


def _module(name: str, **content: Any) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(content)
    return made


def _message(name: str) -> type:
    return type(name, (), {})


@contextmanager
def installed() -> Iterator[ModuleType]:
    """ROS 2's modules as this stand-in has them, and `sortie_ros` beside them; gone afterwards."""
    BUS.clear()
    PARAMETERS.clear()
    folder = str(ROOT / "ros2" / "sortie_ros")
    kinds = {kind: type(kind, (Action,), {}) for kind in ("Node", "DeclareLaunchArgument", "OpaqueFunction")}
    modules = {
        "rclpy": _module("rclpy", init=init, ok=ok, shutdown=shutdown, spin_once=spin_once),
        "rclpy.node": _module("rclpy.node", Node=Node),
        "rclpy.publisher": _module("rclpy.publisher", Publisher=Publisher),
        "rclpy.executors": _module("rclpy.executors", ExternalShutdownException=ExternalShutdownException),
        "rclpy.qos": _module(
            "rclpy.qos", QoSProfile=QoSProfile, HistoryPolicy=HistoryPolicy, ReliabilityPolicy=ReliabilityPolicy,
            DurabilityPolicy=DurabilityPolicy,
        ),
        "sortie_msgs": _module("sortie_msgs"),
        "sortie_msgs.msg": _module(
            "sortie_msgs.msg",
            ContextDescriptor=_message("ContextDescriptor"),
            DataPlaneDirective=_message("DataPlaneDirective"),
        ),
        "std_msgs": _module("std_msgs"),
        "std_msgs.msg": _module("std_msgs.msg", UInt8MultiArray=_message("UInt8MultiArray")),
        "launch": _module("launch", LaunchDescription=list, LaunchContext=dict),
        "launch.actions": _module(
            "launch.actions",
            DeclareLaunchArgument=kinds["DeclareLaunchArgument"],
            OpaqueFunction=kinds["OpaqueFunction"],
        ),
        "launch.substitutions": _module("launch.substitutions", LaunchConfiguration=LaunchConfiguration),
        "launch_ros": _module("launch_ros"),
        "launch_ros.actions": _module("launch_ros.actions", Node=kinds["Node"]),
        "launch_ros.parameter_descriptions": _module("launch_ros.parameter_descriptions", ParameterValue=Action),
    }  # fmt: skip
    sys.modules.update(modules)
    sys.path.insert(0, folder)
    try:
        yield importlib.import_module("sortie_ros.nodes")
    finally:
        sys.path.remove(folder)
        for name in [n for n in sys.modules if n in modules or n.partition(".")[0] == "sortie_ros"]:
            del sys.modules[name]


def launch_file(name: str) -> ModuleType:
    """A launch file of the package, run."""
    path = Path(ROOT) / "ros2" / "sortie_ros" / "launch" / name
    made = ModuleType(name)
    exec(compile(path.read_text("utf-8"), str(path), "exec"), vars(made))  # noqa: S102 - a file of this repository
    return made
