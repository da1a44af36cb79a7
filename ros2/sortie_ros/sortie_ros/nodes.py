"""The four kinds of node. Each reads its parameters, makes one of Sortie's live nodes, and steps it until ROS ends."""

from __future__ import annotations

import time
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.export.origin import parse_origin
from sortie.sim.export.topics import TopicKind
from sortie.sim.live.bench import Bench
from sortie.sim.live.node import Role
from sortie.sim.live.roles import RoleNode, RoleOrders
from sortie.sim.live.scope import left_out
from sortie.sim.live.seals import read_own_key, read_secrets
from sortie.sim.live.watchdog import parse_fallback
from sortie_ros.bus import RosBus

REPORT_S = 1.0


def context_publisher(args: list[str] | None = None) -> None:
    """Publish the drone's descriptors: replayed, or from a MAVLink vehicle."""
    _run(Role.PUBLISHER, "context_publisher", args)


def policy_node(args: list[str] | None = None) -> None:
    """Read the fleet's descriptors and publish the drone's directives."""
    _run(Role.POLICY, "policy_node", args)


def gate(args: list[str] | None = None) -> None:
    """Apply the drone's directives: publish payloads, and take those of others."""
    _run(Role.GATE, "gate", args)


def benchmark(args: list[str] | None = None) -> None:
    """Count the serialised bytes on every topic, and log them once a second."""
    rclpy.init(args=args)
    node = Node("benchmark")
    try:
        bench = Bench(RosBus(node), _scenario(node).fleet.drones)
        bench.begin()
        began_s = reported_s = time.monotonic()
        while rclpy.ok():
            bench.wait(0.05)
            bench.take()
            now_s = time.monotonic()
            if now_s - reported_s >= REPORT_S:
                reported_s, over_s = now_s, now_s - began_s
                rates = (f"{kind} {bench.of(kind).bytes / over_s / 1e3:.1f} kB/s" for kind in TopicKind)
                node.get_logger().info(f"{', '.join(rates)}; {100 * bench.cpu_s / over_s:.1f} % of one core")
    except SortieError as error:
        node.get_logger().error(str(error))
        raise SystemExit(1) from error
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        _end(node)


def make(role: Role, node: Node) -> RoleNode:
    """A live node with the parameters of a ROS node.

    Raises:
        SortieError: a parameter that is wrong.
    """
    scenario, key_file = _scenario(node), _text(node, "key_file", "")
    drone, begin_s = int(_parameter(node, "drone", 0)), float(_parameter(node, "begin_unix_s", 0.0))
    if not 0 <= drone < scenario.fleet.drones:
        raise SortieError(f"drone is {drone}, must be below {scenario.fleet.drones}")
    if scenario.context.authentication and not key_file:
        raise SortieError("key_file is empty, must name the drone's secrets, or set context.authentication=false")
    mavlink, origin = _text(node, "mavlink", ""), _text(node, "origin", "")
    mavlink_key_file = _text(node, "mavlink_key_file", "")
    unused = left_out(scenario, {drone} if mavlink else ())
    if unused and role == Role.PUBLISHER:
        node.get_logger().warning(unused)
    orders = RoleOrders(
        scenario,
        drone,
        begin_s or time.time(),
        read_secrets(Path(key_file)) if scenario.context.authentication else None,
        parse_fallback(_text(node, "fallback", "detections@2")),
        mavlink or None,
        parse_origin(origin) if origin else None,
        read_own_key(Path(mavlink_key_file)) if mavlink_key_file else None,
    )
    return RoleNode(role, RosBus(node), orders)


def log_events(live: RoleNode, node: Node) -> None:
    """Write the events since the last call to the log."""
    report = live.report()
    for notice in report.new.notices:
        node.get_logger().warning(notice.text)
    for order in report.new.orders:
        node.get_logger().info(
            f"→ {order.peer}: {order.representation} at {order.rate_hz:g} Hz, because {order.reason}"
        )


def _run(role: Role, name: str, args: list[str] | None) -> None:
    rclpy.init(args=args)
    node = Node(name)
    live: RoleNode | None = None
    try:
        live = make(role, node)
        reported_s = time.monotonic()
        while rclpy.ok() and not live.over:
            live.step()
            if time.monotonic() - reported_s >= REPORT_S:
                reported_s = time.monotonic()
                log_events(live, node)
    except SortieError as error:
        node.get_logger().error(str(error))
        raise SystemExit(1) from error
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if live is not None:
            live.close()
        _end(node)


def _end(node: Node) -> None:
    node.destroy_node()
    if rclpy.ok():
        rclpy.shutdown()


def _scenario(node: Node) -> Scenario:
    changes = _text(node, "set", "")
    return load(_text(node, "scenario", "paper_replay"), changes.split(";") if changes else [])


def _parameter(node: Node, name: str, default: object) -> object:
    return node.declare_parameter(name, default).value


def _text(node: Node, name: str, default: str) -> str:
    return str(_parameter(node, name, default))
