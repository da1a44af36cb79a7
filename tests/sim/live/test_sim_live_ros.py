"""The ROS 2 package, with a stand-in for rclpy: ROS itself was not at hand."""

from __future__ import annotations

import importlib
import inspect
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import rclpy_stand_in as ros
from places import ROOT
from sim_examples import BASE

from sortie.scenarios.errors import SortieError
from sortie.sim.export.topics import CONTEXT, PAYLOADS, Topic, TopicKind
from sortie.sim.folders import RunError
from sortie.sim.live.node import Role
from sortie.sim.live.reports import Notice
from sortie.sim.live.seals import read_secrets, secrets_of

PACKAGE = ROOT / "ros2" / "sortie_ros"
MASTER = bytes(range(32))


@pytest.fixture
def nodes() -> Iterator[ModuleType]:
    """`sortie_ros.nodes` over the stand-in."""
    with ros.installed() as found:
        yield found


@pytest.mark.parametrize("name", ros.DOCUMENTED)
def test_the_stand_in_has_the_documented_signatures(name: str, nodes: ModuleType) -> None:
    module, _, rest = name.partition("rclpy.")[2].rpartition(".")
    found: Any = importlib.import_module("rclpy")
    if name.count(".") > 1:
        package, kind = module.split(".")
        found = getattr(importlib.import_module(f"rclpy.{package}"), kind)
    parameters = inspect.signature(getattr(found, rest)).parameters.values()
    words, keyword = [], False
    for p in parameters:
        if p.kind == p.KEYWORD_ONLY and not keyword:
            keyword = True
            words.append("*")
        words.append(p.name)
    assert f"({', '.join(words)})" == ros.DOCUMENTED[name]


def test_topics_have_the_quality_of_service_of_the_paper(nodes: ModuleType) -> None:
    bus_of = importlib.import_module("sortie_ros.bus")
    node = ros.Node("any")
    bus = bus_of.RosBus(node)
    for topic in (CONTEXT, *(Topic(kind, 0, 1) for kind in (TopicKind.DIRECTIVE, *PAYLOADS))):
        bus.writer(topic)
    found = {
        p.topic: (p.msg_type.__name__, p.qos.reliability.name, p.qos.history.name, p.qos.depth) for p in node.publishers
    }
    assert found == {
        "/fleet/context": ("ContextDescriptor", "BEST_EFFORT", "KEEP_LAST", 1),
        "/drone_0/to_drone_1/directive": ("DataPlaneDirective", "RELIABLE", "KEEP_LAST", 1),
        "/drone_0/to_drone_1/features": ("UInt8MultiArray", "BEST_EFFORT", "KEEP_LAST", 1),
        "/drone_0/to_drone_1/compact": ("UInt8MultiArray", "RELIABLE", "KEEP_LAST", 1),
    }


@pytest.fixture
def fleet(nodes: ModuleType, tmp_path: Path) -> Iterator[dict[str, Any]]:
    """Two drones of three nodes each, in this process, and what starts one more."""
    (tmp_path / "s.yaml").write_text(BASE.replace("duration_s: 6", "duration_s: 60"))
    (tmp_path / "master").write_text(MASTER.hex())
    (tmp_path / "master").chmod(0o600)
    importlib.import_module("sortie_ros.keys").main([str(tmp_path / "master"), "2", str(tmp_path)])
    begin_unix_s = time.time()
    made: dict[str, tuple[Any, ros.Node]] = {}
    ros.init()
    for drone in (0, 1):
        ros.PARAMETERS.update(
            scenario=str(tmp_path / "s.yaml"), set="fleet.drones=2;policy={name: all-4, params: {received_budget: 0.03125}, dwell_s: 0.3};context.roster=true",
            drone=drone, key_file=str(tmp_path / f"drone_{drone}.key"), begin_unix_s=begin_unix_s,
        )  # fmt: skip
        for role in (Role.PUBLISHER, Role.POLICY, Role.GATE):
            node = ros.Node(role.name or "")
            made[f"{role.name} {drone}"] = nodes.make(role, node), node
    yield {"made": made, "nodes": nodes, "path": tmp_path}
    for live, node in made.values():
        live.close()
        node.destroy_node()
    ros.shutdown()


def spin(made: dict[str, Any], until: Any) -> list[Notice]:
    """Step every node until something holds; the events of drone 0's gate."""
    end_s, notices = time.monotonic() + 600, []
    while not until():
        assert time.monotonic() < end_s
        for live, _ in made.values():
            live.step()
    for name, (live, _) in made.items():
        new = live.report().new.notices
        notices += new if name == "GATE 0" else []
    return notices


def test_drones_of_three_nodes_share_and_hold_their_links_without_a_policy(fleet: dict[str, Any]) -> None:
    made = fleet["made"]
    live = {name: node for name, (node, _) in made.items()}

    def arrived(drone: int, kind: TopicKind) -> int:
        return int(live[f"GATE {drone}"].node._received[kind].samples)

    spin(made, lambda: all(arrived(d, TopicKind.FEATURES) >= 5 for d in (0, 1)))
    assert live["POLICY 0"].node._sent[TopicKind.DIRECTIVE].samples > 5
    assert live["GATE 0"].node._sent[TopicKind.DIRECTIVE].samples == 0  # each node has one role
    assert live["GATE 0"].node._published == live["POLICY 0"].node._published == 0
    assert live["PUBLISHER 0"].node._sent[TopicKind.FEATURES].samples == 0
    for node in live.values():
        assert set(node.node._refused) <= {"payload late"}
    known = live["POLICY 0"]._memory.view(live["POLICY 0"]._clock.now)
    assert {d.roster.members for d in known.descriptors.values()} == {(0, 1)}

    gone, its_node = made.pop("POLICY 0")  # the policy node of drone 0 ends
    gone.close()
    its_node.destroy_node()
    notices = spin(made, lambda: arrived(1, TopicKind.COMPACT) >= 2)  # detections in place of features
    assert "fallback: no directive from the policy node" in [n.text for n in notices]


def test_events_and_directives_are_logged(fleet: dict[str, Any]) -> None:
    made, nodes = fleet["made"], fleet["nodes"]
    policy, node = made["POLICY 0"]
    policy.node.note("an event")
    nodes.log_events(policy, node)
    assert "an event" in node.logger.lines


def test_a_node_with_wrong_parameters_says_so(nodes: ModuleType, tmp_path: Path) -> None:
    for parameters, text in (
        ({"drone": 9}, "drone is 9, must be below 5"),
        ({"drone": 0}, "key_file is empty, must name the drone's secrets, or set context.authentication=false"),
        ({"drone": 0, "key_file": "none"}, "none: No such file or directory"),
    ):
        ros.PARAMETERS.clear()
        ros.PARAMETERS.update(parameters)
        with pytest.raises(SortieError) as error:
            nodes.make(Role.GATE, ros.Node("any"))
        assert str(error.value) == text


def test_the_benchmark_node_with_wrong_parameters_says_so(nodes: ModuleType) -> None:
    """It ended in a traceback, and ROS was not shut down."""
    ros.PARAMETERS.clear()
    ros.PARAMETERS.update(scenario="none-such")
    with pytest.raises(SystemExit) as stop:
        nodes.benchmark()
    assert stop.value.code == 1
    assert not ros.ok()


def test_a_publisher_logs_what_it_does_not_use(nodes: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nodes, "RoleNode", lambda *_: None)
    changes = "context.authentication=false;record.views=true;perception.detector=none;expect=[];expect_decisions=[];events=[]"
    logged = {}
    for role in (Role.PUBLISHER, Role.GATE):
        ros.PARAMETERS.clear()
        ros.PARAMETERS.update(set=changes)
        node = ros.Node("any")
        nodes.make(role, node)
        logged[role] = [line for line in node.logger.lines if "does not use" in line]
    assert logged == {Role.PUBLISHER: ["a live flight does not use record.views"], Role.GATE: []}


def test_each_drone_gets_its_own_secrets(nodes: ModuleType, tmp_path: Path) -> None:
    keys = importlib.import_module("sortie_ros.keys")
    (tmp_path / "master").write_text(MASTER.hex())
    (tmp_path / "master").chmod(0o600)
    keys.main([str(tmp_path / "master"), "2", str(tmp_path)])
    assert read_secrets(tmp_path / "drone_1.key") == secrets_of(MASTER, 1)
    assert (tmp_path / "drone_1.key").stat().st_mode & 0o777 == 0o600
    with pytest.raises(SystemExit, match="File exists"):
        keys.main([str(tmp_path / "master"), "2", str(tmp_path)])
    with pytest.raises(SystemExit, match="usage"):
        keys.main([])
    (tmp_path / "bad").write_text("00")
    (tmp_path / "bad").chmod(0o600)
    with pytest.raises(RunError, match="must hold 128 hexadecimal digits"):
        read_secrets(tmp_path / "bad")


def test_launch_files_start_the_nodes_of_the_package(nodes: ModuleType) -> None:
    setup = (PACKAGE / "setup.py").read_text("utf-8")
    drone = ros.launch_file("drone.launch.py").generate_launch_description()
    started = [a for a in drone if type(a).__name__ == "Node"]
    assert [a.named["executable"] for a in started] == ["context_publisher", "policy_node", "gate"]
    given = set(started[0].named["parameters"][0])
    assert given == {a.given[0] for a in drone if type(a).__name__ == "DeclareLaunchArgument"}

    *_, opened = ros.launch_file("fleet.launch.py").generate_launch_description()
    started = opened.named["function"]({"drones": "3", "scenario": "track_target", "set": "seed=2", "keys": "/keys"})
    assert [a.named["executable"] for a in started] == ["benchmark"] + ["context_publisher", "policy_node", "gate"] * 3
    (last,) = started[-1].named["parameters"]
    assert (last["drone"], last["key_file"], last["set"]) == (2, "/keys/drone_2.key", "fleet.drones=3;seed=2")
    for action in started:
        assert action.named["package"] == "sortie_ros"
        assert f'"{action.named["executable"]} = sortie_ros.nodes:{action.named["executable"]}"' in setup
        assert callable(getattr(nodes, action.named["executable"]))


def test_the_manifest_names_what_the_nodes_import() -> None:
    tree = ElementTree.parse(PACKAGE / "package.xml")  # noqa: S314 - a file of this repository
    assert {d.text for d in tree.iter("exec_depend")} == {"rclpy", "launch", "launch_ros", "sortie_msgs", "std_msgs"}
    assert "This package was written without ROS 2" in (PACKAGE / "README.md").read_text("utf-8")
