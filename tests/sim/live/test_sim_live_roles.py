"""One role of a drone as a node: what the publisher, the policy node and the gate each do without the others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
from dds_domains import udp_port
from memory_bus import MemoryBus
from policies_examples import fleet_of
from sim_examples import example

from sortie.fleet.messages.auth import Opened
from sortie.fleet.messages.wire import decode_descriptor, decode_directive, encode_descriptor
from sortie.policies.contract import Representation
from sortie.scenarios.schema import Scenario
from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.live import roles
from sortie.sim.live.node import Role
from sortie.sim.live.roles import RoleNode, RoleOrders
from sortie.sim.live.seals import Seals
from sortie.sim.live.vehicle import CirclingVehicle, circle

ORDER = Topic(TopicKind.DIRECTIVE, 0, 1)
Make = Callable[..., RoleNode]


@pytest.fixture
def bus() -> MemoryBus:
    """The bus of all nodes of a test."""
    return MemoryBus()


@pytest.fixture
def make(bus: MemoryBus) -> Iterator[Make]:
    """Makes nodes of drone 0 whose scenario began a second ago."""
    made: list[RoleNode] = []

    def one(role: Role, scenario: Scenario, **orders: object) -> RoleNode:
        node = RoleNode(role, bus, RoleOrders(scenario, 0, time.time() - 1.0, None, **orders))  # type: ignore[arg-type]
        made.append(node)
        return node

    yield one
    for node in made:
        node.close()


def say(bus: MemoryBus, drone: int, age_s: float = 0.0, **claims: object) -> None:
    """A drone's descriptor comes over the bus."""
    claim = fleet_of(2).descriptors[drone]._replace(stamp_ns=time.time_ns() - round(age_s * 1e9), **claims)
    bus.writer(CONTEXT).write(encode_descriptor(claim))


def step_until(node: RoleNode, holds: Callable[[], bool], each: Callable[[], None] = lambda: None) -> None:
    end_s = time.monotonic() + 600
    while not holds():
        assert time.monotonic() < end_s
        each()
        node.step()
        time.sleep(0.005)


def flying(**more: object) -> Scenario:
    return example("fleet.drones=2", "duration_s=600", "context.authentication=false", *map(str, more.values()))


def test_a_gate_without_a_policy_node_sends_nothing_to_a_peer_that_is_gone(bus: MemoryBus, make: Make) -> None:
    """It sent detections at 2 Hz for ever."""
    gate = make(Role.GATE, flying())
    say(bus, 1)
    sent = gate.node.gate
    step_until(gate, lambda: sent.in_force(1) is not None, lambda: say(bus, 0))
    assert sent.in_force(1).representation == Representation.DETECTIONS  # type: ignore[union-attr]
    step_until(gate, lambda: sent.in_force(1).representation == Representation.NONE, lambda: say(bus, 0))  # type: ignore[union-attr]


def test_a_gate_drops_payloads_of_a_member_that_lies(bus: MemoryBus, make: Make) -> None:
    """The gate judged nobody: trust was the policy node's alone."""
    gate, soc = make(Role.GATE, flying()), [0.5]

    def lie() -> None:
        soc[0] = min(1.0, soc[0] + 0.002)
        say(bus, 0)
        say(bus, 1, battery_soc=soc[0])

    step_until(gate, lambda: gate._memory.trust_in(1) < 1.0, lie)
    assert any("trust in drone 1" in n.text for n in gate.report().new.notices)


def test_a_policy_node_keeps_the_scenario_s_invariants(bus: MemoryBus, make: Make) -> None:
    """Damping holds back what the shield made of the policy's answer; it was not judged after that."""
    rule = "policy={name: silence, dwell_s: 60, shield: true, invariants: 'representation >= detections'}"
    node = make(Role.POLICY, flying(rule=rule))

    def both() -> None:
        say(bus, 0)
        say(bus, 1)

    step_until(node, lambda: len(bus.written.get(ORDER, [])) > 10, both)
    rungs = [decode_directive(cdr).representation for cdr in bus.written[ORDER]]
    assert rungs[-1] == Representation.DETECTIONS


def test_a_policy_node_without_its_publisher_decides_nothing(bus: MemoryBus, make: Make) -> None:
    """It decided for ever on the drone's last pose."""
    node = make(Role.POLICY, flying())
    say(bus, 0)
    step_until(node, lambda: len(bus.written.get(ORDER, [])) > 1, lambda: say(bus, 1))
    notices: list[str] = []
    step_until(
        node,
        lambda: (
            notices.extend(n.text for n in node.report().new.notices) or any("decides nothing" in t for t in notices)
        ),
        lambda: say(bus, 1),
    )
    before = len(bus.written[ORDER])
    frame = node._clock.now
    step_until(node, lambda: node._clock.now > frame + 0.5, lambda: say(bus, 1))
    assert len(bus.written[ORDER]) == before


def test_a_publisher_with_a_vehicle_publishes_its_charge(
    bus: MemoryBus, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It failed at its first descriptor: nothing was replayed for its headrooms."""
    monkeypatch.setattr(roles, "traces", short_traces)
    port, began_s = udp_port(__name__), time.monotonic()
    vehicle = CirclingVehicle(f"udpout:127.0.0.1:{port}")
    try:
        node = make(Role.PUBLISHER, flying(), mavlink=f"udpin:127.0.0.1:{port}")
        step_until(node, lambda: bool(bus.written.get(CONTEXT)))
    finally:
        vehicle.close()
    said = decode_descriptor(bus.written[CONTEXT][-1])
    assert circle(time.monotonic() - began_s).soc - 0.05 < said.battery_soc < 0.85
    assert len(said.peer_goodput_mbps) == 1


def test_a_publisher_is_in_the_fleet_when_the_scenario_says(
    bus: MemoryBus, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [1_700_000_000.0]
    for name in ("time", "monotonic"):
        monkeypatch.setattr(time, name, lambda: now_s[0])
    monkeypatch.setattr(roles, "traces", short_traces)
    spaces = "fleet.makes=[{name: a, drones: [0], feature_space: mine}]"
    events = "events=[{kind: drone_lost, at_s: 1.5, drone: 0}, {kind: drone_joins, at_s: 2.5, drone: 0}, {kind: clock_skew, at_s: 2.6, drone: 0, skew_s: 9}]"
    node = make(Role.PUBLISHER, flying(spaces=spaces, events=events))
    began_s = time.time() - float(node._clock.now)
    while node._clock.now <= 3.2:
        now_s[0] += 0.004
        node.step()
    found = [Seals(None).open_descriptor(cdr) for cdr in bus.written[CONTEXT]]
    said = [each.descriptor for each in found if isinstance(each, Opened)]
    assert {d.feature_space for d in said} == {"mine"}
    at_s = [d.stamp_ns * 1e-9 - began_s for d in said]
    assert not [t for t in at_s if 1.52 < t < 2.48]
    assert [t for t in at_s if t < 1.52]
    assert [t for t in at_s if 2.48 < t < 2.7]
    assert [t for t in at_s if t > 11.5]
    texts = [n.text for n in node.report().new.notices]
    assert texts == ["fell silent", "takes off", "clock off by 9 s"]


def short_traces(scenario: Scenario) -> list[object]:
    """Of the first minutes; the scenario is long so that no busy host flies to its end."""
    from sortie.sim.live.context import traces

    return list(traces(scenario.model_copy(update={"duration_s": 120.0})))
