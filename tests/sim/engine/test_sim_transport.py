"""Payloads from the air to memories and to the record, by a made-up air; and who hears a datagram."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import simpy
from agent_rig import capture, descriptor, memory, payload

from sortie.fleet.memory import Received
from sortie.fleet.messages.wire import encode_descriptor
from sortie.radio import Transmission
from sortie.radio.transmission import Status
from sortie.sim.engine.transport import Transport
from sortie.sim.results.record import HANDSHAKE, Recorder


class Wire:
    """An air that keeps what it was given, and settles it when it is told."""

    def __init__(self) -> None:
        self.given: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def send(self, *args: Any, **more: Any) -> int:
        self.given.append((args, more))
        return len(self.given)

    def goodput_mbps(self, drone: int) -> tuple[float, ...]:
        return (float(drone),)

    def broadcast(self, drone: int, size: int, to: Any) -> None:
        to([1, 2])

    def settled(self, number: int, **changes: Any) -> Transmission:
        (drone, peer, size), more = self.given[number - 1]
        ends_s = (0.0, more["deadline_s"], 0.1, 0.5)
        how = (Status.DELIVERED, "", 1, 0, 0, 1, 20.0, 0.01)
        whole = Transmission(number, drone, peer, more["kind"], size, size, *ends_s, *how, arrived_bytes=size)
        whole = whole._replace(**changes)
        if whole.status != Status.IN_FLIGHT:
            more["on_done"](whole)
        return whole

    def finish(self) -> list[Transmission]:
        return [self.settled(len(self.given), status=Status.IN_FLIGHT, arrived_bytes=0)]


def _transport(
    skews_s: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[Transport, Wire, list[Any], list[Received], Recorder]:
    memories, got = [memory(i) for i in range(3)], list[Received]()
    for each, skew_s in zip(memories, skews_s, strict=True):
        each.status.clock_skew_s = skew_s
        each.receive = got.append  # type: ignore[method-assign]
    wire, recorder, env = Wire(), Recorder(), simpy.Environment()
    env.run(until=0.7)
    transport = Transport(env, wire, memories, recorder, keys=None, rates_mbps=(6.5, 13.0))  # type: ignore[arg-type]
    return transport, wire, memories, got, recorder


def test_a_payload_arrives_with_its_capture_its_sender_s_time_its_gaps_and_its_rate() -> None:
    transport, wire, _, got, recorder = _transport((0.25, -3.0, 0.0))
    tiles = payload()._replace(cells=10, tile_cells=4, tile_bytes=1500, feature_space="")
    taken = capture(0, 0.2)
    modem = transport.modem(0)
    modem.send(1, tiles, taken, 0.9)
    (args, more) = wire.given[0]
    assert args == (0, 1, 20_000)
    how = (more["kind"], more["deadline_s"], more["piece_bytes"], more["reliable"])
    assert how == ("features", 0.9, 1500, tiles.reliable)
    wire.settled(1, status=Status.PARTIAL, reason="fragment_lost", arrived_bytes=9000, missing=(0, 2), mcs=1)
    assert got == [Received(taken, tiles, 0.5, 0.45, (0, 1, 2, 3, 8, 9), 13.0)]
    assert modem.goodput_mbps() == (0.0,)
    ((_, kept, captured_s),) = recorder.rows["transmissions"]
    assert (kept, captured_s) == (tiles, 0.2)


def test_a_data_rate_is_that_of_the_mcs_or_unknown() -> None:
    for mcs, mbps in ((0, 6.5), (1, 13.0), (2, math.inf), (-1, math.inf)):
        transport, wire, _, got, _ = _transport()
        transport.send(2, 0, payload()._replace(feature_space=""), capture(2, 0.0), 1.0)
        wire.settled(1, mcs=mcs)
        assert [r.phy_mbps for r in got] == [mbps]


def test_what_did_not_arrive_and_what_carries_no_payload_reaches_no_memory() -> None:
    transport, wire, memories, got, recorder = _transport()
    sent = payload()._replace(feature_space="")
    transport.send(0, 1, sent, capture(0, 0.0), 1.0)
    wire.settled(1, status=Status.LOST, reason="no_link", arrived_bytes=0)
    transport.handshake(0, 1, 200, capture(0, 0.1), 1.0)
    assert wire.given[1][0] == (0, 1, 200)
    assert (wire.given[1][1]["kind"], wire.given[1][1]["reliable"]) == (HANDSHAKE, False)
    wire.settled(2)
    transport.send(0, 1, sent, capture(0, 0.2), 1.0)
    transport.finish()
    assert got == []
    assert [m.status.work.payload_bytes for m in memories] == [0, 200, 0]  # its computer reads a handshake all the same
    fates = [(Status.LOST, "no_link", 0.0), (Status.DELIVERED, "", 0.1), (Status.IN_FLIGHT, "", 0.2)]
    assert [(t.status, t.reason, c) for t, _, c in recorder.rows["transmissions"]] == fates


def test_a_map_of_another_network_is_told_as_such_where_it_arrived_and_by_its_loss_where_it_did_not() -> None:
    transport, wire, _, _, recorder = _transport()
    other = payload()._replace(feature_space="another")
    for _ in range(2):
        transport.send(0, 1, other, capture(0, 0.0), 1.0)
    wire.settled(1)
    wire.settled(2, status=Status.LOST, reason="no_link", arrived_bytes=0)
    assert [t.reason for t, *_ in recorder.rows["transmissions"]] == ["other_feature_space", "no_link"]


def test_descriptors_reach_those_who_fly_and_the_last_one_is_kept() -> None:
    transport, _, memories, _, recorder = _transport()
    memories[2].status.leave()
    data = encode_descriptor(descriptor(0, 0.7, coverage_grid=bytes(64)))
    transport.modem(0).broadcast(data)
    assert [0 in m.view(0.7).descriptors for m in memories] == [False, True, False]
    assert transport.last_datagram == {0: data}
    transport.inject(b"garbage", [0, 1, 2])
    assert [row[:2] for row in recorder.rows["drops"]] == [(0.7, 0), (0.7, 1)]
    assert transport.last_datagram == {0: data}
