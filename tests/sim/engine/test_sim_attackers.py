"""Attackers: which datagram each kind puts on the air, when, and before whom."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import simpy
from agent_rig import descriptor
from recorded import recorded
from sim_examples import example

from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.sim.engine.events import Acted, Events
from sortie.sim.engine.sortie import run_sortie

OPEN = "context.authentication=false"


def _spoofed(attack: str, *sets: str) -> list[tuple[float, bytes, list[int]]]:
    """What an attacker of drone 1 puts before whom: the drone publishes from 0.3 s on, each 0.2 s."""
    until = "" if sets else ", until_s: 0.8"
    event = f"events=[{{kind: spoof, at_s: 0, drone: 1, attack: {attack}, rate_hz: 5{until}}}]"
    scenario = example("duration_s=1.5", "fleet.drones=4", event, "mission.phases=[{at_s: 0, phase: search}]", *sets)
    env, put = simpy.Environment(), list[tuple[float, bytes, list[int]]]()
    transport = SimpleNamespace(
        last_datagram={}, inject=lambda data, to: put.append((round(env.now, 3), data, list(to)))
    )
    world = SimpleNamespace(env=env, note=lambda *_: None)
    Events(Acted(scenario, world, transport, None, (), 1, 0))  # type: ignore[arg-type]

    def publish() -> Any:
        yield env.timeout(0.3)
        for k in range(10):
            transport.last_datagram = {1: _datagram(k), 0: b"another's"}
            yield env.timeout(0.2)

    env.process(publish())
    env.run(until=scenario.duration_s)
    return put


def _datagram(k: int) -> bytes:
    return encode_descriptor(descriptor(1, 0.3 + 0.2 * k, coverage_grid=bytes(64), battery_soc=0.5))


def test_an_attacker_replays_the_first_datagram_that_it_heard_to_all_but_its_victim() -> None:
    put = _spoofed("replayed")
    assert [t for t, *_ in put] == [0.4, 0.6]
    assert {data for _, data, _ in put} == {_datagram(0)}
    assert [to for *_, to in put] == [[0, 2, 3]] * 2
    assert [t for t, *_ in _spoofed("replayed", OPEN)] == [0.4, 0.6, 0.8, 1.0, 1.2, 1.4], "to the end, if it has none"


def test_other_attacks_follow_the_latest_datagram() -> None:
    put = _spoofed("oversized")
    assert [data for _, data, _ in put] == [_datagram(k) + bytes(2000) for k in (0, 1)]
    put = _spoofed("malformed")
    assert [len(data) for _, data, _ in put] == [len(_datagram(0))] * 2
    assert put[0][1] != put[1][1]
    lies = [decode_descriptor(data) for _, data, _ in _spoofed("forged", OPEN)]
    assert [lie.stamp_ns for lie in lies[:2]] == [decode_descriptor(_datagram(k)).stamp_ns for k in (0, 1)]
    assert {lie.battery_soc for lie in lies} == {0.0}
    assert {g for lie in lies for g in lie.peer_goodput_mbps} == {0.0}


def test_bad_datagrams_are_counted_by_reason_and_change_nothing() -> None:
    """Short flights of their own, one for each attack, of three drones that share."""
    few = ("duration_s=1.5", "fleet.drones=3", "mission.phases=[{at_s: 0, phase: search}]")
    honest = run_sortie(example(*few)).tables
    for attack, reasons in (
        ("forged", {"unknown_key", "forged"}),
        ("replayed", {"replayed"}),
        ("malformed", {"unknown_key", "forged"}),
        ("oversized", {"oversized"}),
    ):
        spoof = f"events=[{{kind: spoof, drone: 0, at_s: 0.5, attack: {attack}, rate_hz: 20}}]"
        attacked = run_sortie(example(*few, spoof)).tables
        assert set(attacked["drops"]["reason"].to_pylist()) <= reasons
        assert attacked["drops"].num_rows == 2 * 20
        changed = {name for name, table in attacked.items() if str(table.to_pydict()) != str(honest[name].to_pydict())}
        assert changed == {"drops", "events"}, attack


def test_without_authentication_a_forged_descriptor_is_believed() -> None:
    """Two short flights of their own, with an open plane."""
    few = ("duration_s=1.5", "fleet.drones=3", "mission.phases=[{at_s: 0, phase: search}]", OPEN)
    spoof = "events=[{kind: spoof, drone: 0, at_s: 0.5, attack: forged, rate_hz: 20}]"
    honest, attacked = run_sortie(example(*few)), run_sortie(example(*few, spoof))
    assert set(honest.tables["descriptors"]["wire_bytes"].to_pylist()) == {172}, "180 B, less two goodputs of 4 B"
    assert set(recorded("base").tables["descriptors"]["wire_bytes"].to_pylist()) <= {208, 210}, "28 B of a seal"
    assert not attacked.tables["drops"].num_rows
    assert attacked.fingerprint != honest.fingerprint
