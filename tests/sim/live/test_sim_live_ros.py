"""The ROS 2 package, with a stand-in for rclpy: ROS itself was not at hand."""

from __future__ import annotations

import importlib
import inspect
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import rclpy_stand_in as ros
from live_flights import LONGEST_S, short_traces
from places import ROOT
from sim_examples import BASE

from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.load import load
from sortie.sim.export.topics import TopicKind
from sortie.sim.folders import RunError
from sortie.sim.live import roles
from sortie.sim.live.node import Role
from sortie.sim.live.seals import read_secrets, secrets_of

PACKAGE = ROOT / "ros2" / "sortie_ros"
MASTER = bytes(range(32))


@pytest.fixture
def nodes() -> Iterator[ModuleType]:
    """`sortie_ros.nodes` over the stand-in."""
    with ros.installed() as found:
        yield found


def test_the_stand_in_has_the_documented_signatures(nodes: ModuleType) -> None:
    found = {}
    for name in ros.DOCUMENTED:
        module, _, rest = name.partition("rclpy.")[2].rpartition(".")
        owner: Any = importlib.import_module("rclpy")
        if name.count(".") > 1:
            package, kind = module.split(".")
            owner = getattr(importlib.import_module(f"rclpy.{package}"), kind)
        words = []
        for p in inspect.signature(getattr(owner, rest)).parameters.values():
            words += ["*"] if p.kind == p.KEYWORD_ONLY and "*" not in words else []
            words.append(p.name)
        found[name] = f"({', '.join(words)})"
    assert found == ros.DOCUMENTED


@pytest.fixture
def fleet(nodes: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """Two drones of three nodes each, in this process; on a busy host descriptors are late, and still fresh."""
    policy = "policy={name: all-4, params: {received_budget: 0.03125}, dwell_s: 0.3}"
    context = "context={roster: true, degraded_after_periods: 59, detached_after_periods: 60}"
    changes = ["fleet.drones=2", policy, context]
    path, master = tmp_path / "s.yaml", tmp_path / "master"
    path.write_text(BASE.replace("duration_s: 6", f"duration_s: {LONGEST_S:g}"))
    known = short_traces(load(path, changes))
    monkeypatch.setattr(roles, "traces", lambda _: known)
    master.write_text(MASTER.hex())
    master.chmod(0o600)
    importlib.import_module("sortie_ros.keys").main([str(master), "2", str(tmp_path)])
    made: dict[str, tuple[Any, ros.Node]] = {}
    ros.PARAMETERS.update(scenario=str(path), set=";".join(changes), begin_unix_s=time.time())
    ros.init()
    for drone in (0, 1):
        ros.PARAMETERS.update(drone=drone, key_file=str(tmp_path / f"drone_{drone}.key"))
        for role in (Role.PUBLISHER, Role.POLICY, Role.GATE):
            node = ros.Node(role.name or "")
            made[f"{role.name} {drone}"] = nodes.make(role, node), node
    yield {"made": made, "nodes": nodes}
    for live, node in made.values():
        live.close()
        node.destroy_node()
    ros.shutdown()


def spin(made: dict[str, Any], until: Callable[[], bool]) -> list[str]:
    """Step every node until something holds; the events of drone 0's gate."""
    while not until():
        for live, _ in made.values():
            live.step()
    return [notice.text for notice in made["GATE 0"][0].report().new.notices]


@pytest.mark.slow
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
    assert "fallback: no directive from the policy node" in notices
    policy, node = made["POLICY 1"]
    policy.node.note("an event")
    fleet["nodes"].log_events(policy, node)
    assert "an event" in node.logger.lines


def test_a_node_with_wrong_parameters_says_so(nodes: ModuleType) -> None:
    """Also the benchmark's, which ended in a traceback, and ROS was not shut down."""
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
    ros.PARAMETERS.clear()
    ros.PARAMETERS.update(scenario="none-such")
    with pytest.raises(SystemExit) as stop:
        nodes.benchmark()
    assert stop.value.code == 1
    assert not ros.ok()


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
