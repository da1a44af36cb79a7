"""One role of a drone as a node: what the publisher, the policy node and the gate each do without the others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
from dds_domains import udp_port
from live_flights import LONGEST_S, short_traces
from memory_bus import MemoryBus
from policies_examples import fleet_of
from sim_examples import example

from sortie.fleet.messages.wire import decode_descriptor, decode_directive, encode_descriptor
from sortie.policies.contract import Representation
from sortie.scenarios.schema import Scenario
from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.live import roles
from sortie.sim.live.node import Role
from sortie.sim.live.roles import RoleNode, RoleOrders
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
    while not holds():
        each()
        node.step()
        time.sleep(0.005)


def flying(**more: object) -> Scenario:
    return example(
        "fleet.drones=2", f"duration_s={LONGEST_S:g}", "context.authentication=false", *map(str, more.values())
    )


def test_a_gate_without_a_policy_node_sends_nothing_to_a_peer_that_is_gone(bus: MemoryBus, make: Make) -> None:
    """It sent detections at 2 Hz for ever."""
    gate = make(Role.GATE, flying())
    say(bus, 1)
    sent = gate.node.gate
    step_until(gate, lambda: sent.in_force(1) is not None, lambda: say(bus, 0))
    assert sent.in_force(1).representation == Representation.DETECTIONS  # type: ignore[union-attr]
    step_until(gate, lambda: sent.in_force(1).representation == Representation.NONE, lambda: say(bus, 0))


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

    def says_that_it_decides_nothing() -> bool:
        notices.extend(n.text for n in node.report().new.notices)
        return any("decides nothing" in text for text in notices)

    step_until(node, says_that_it_decides_nothing, lambda: say(bus, 1))
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
