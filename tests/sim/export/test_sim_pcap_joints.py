"""The packets of payloads, worked out by hand from a few rows: when each goes, which part it carries, and its number.

Held: fragments that are sent again, payloads that no one sent or that are in the air at the end, tiles, counters by drone and
topic, and what is a topic of boxes.
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any

import pytest
from record_by_hand import record, tables_of

from sortie.fleet.tiles import cut
from sortie.radio.mac.airtime import sample_wire
from sortie.sim.export.pcap import GROUP, KEPT_BYTES, _datagram, _payload_packets, address
from sortie.sim.export.topics import TopicKind

BEGIN_NS = 7_000_000_000
FEATURES, COMPACT = TopicKind.FEATURES, TopicKind.COMPACT
DATA, DATA_FRAG = 0x15, 0x16


def row(drone: int, peer: int, what: str, size: int, start_s: float, done_s: float, **more: Any) -> dict[str, Any]:
    """A payload whose every fragment went once."""
    fragments, wire = sample_wire(size, 1344)
    return {
        "drone": drone, "peer": peer, "representation": what, "payload_bytes": size, "t_start_s": start_s, "t_done_s": done_s,
        "fragments": fragments, "wire_bytes": wire, "fragments_lost": 0, "cells": 0,
    } | more  # fmt: skip


def packets(rows: list[dict[str, Any]], framing: str = "sample") -> list[dict[str, Any]]:
    """Every packet's time, ends, kind, number, fragment, and length of its content."""
    made = record()
    radio = made.scenario.radio.model_copy(update={"framing": framing, "fragment_bytes": 1344})
    scenario = made.scenario.model_copy(update={"radio": radio})
    found = []
    for p in _payload_packets(replace(made, scenario=scenario, tables=tables_of({"transmissions": rows})), BEGIN_NS):
        second, fraction = struct.unpack_from("<II", p.rtps, 24)
        assert second + fraction / 2**32 == pytest.approx(7.0 + p.t_s, abs=1e-8)
        kind, number = p.rtps[48], struct.unpack_from("<I", p.rtps, 68)[0]
        head = 76 if kind == DATA else 84
        fragment = struct.unpack_from("<IHHI", p.rtps, 72) if kind == DATA_FRAG else None
        assert len(p.rtps) == head + min(KEPT_BYTES, p.rtps_bytes - head)
        assert p.source[0][3] - 1 == p.rtps[19], "the sender's prefix"
        found.append({
            "t_s": round(p.t_s, 9), "from": p.source[0][3] - 1, "to": p.destination[0][3] - 1, "kind": p.kind, "number": number,
            "fragment": fragment, "bytes": p.rtps_bytes - head,
        })  # fmt: skip
    return found


def test_fragments_are_spread_over_the_time_on_the_air_and_those_that_were_lost_go_again() -> None:
    """Of 3000 B the first fragment went twice: four packets in a second."""
    fragments, once = sample_wire(3000, 1344)
    made = packets([row(0, 1, "features", 3000, 1.0, 2.0, fragments_lost=1, wire_bytes=once * 4 // 3 + 1)])
    assert fragments == 3
    assert [(p["t_s"], p["bytes"], p["fragment"]) for p in made] == [
        (1.25, 1344, (1, 1, 1344, 3000)), (1.5, 1344, (2, 1, 1344, 3000)), (1.75, 312, (3, 1, 1344, 3000)),
        (2.0, 1344, (1, 1, 1344, 3000)),
    ]  # fmt: skip
    assert {(p["from"], p["to"], p["kind"], p["number"]) for p in made} == {(0, 1, FEATURES, 1)}


def test_of_a_payload_that_was_broken_off_as_much_is_there_as_went() -> None:
    _, once = sample_wire(3000, 1344)
    made = packets([
        row(0, 1, "features", 3000, 1.0, 2.0, wire_bytes=2 * once // 3 + 1),
        row(0, 1, "features", 3000, 3.0, math.nan),  # in the air at the end, after 4 s
        row(0, 1, "features", 3000, math.nan, math.nan, wire_bytes=0),
        row(0, 1, "features", 500, 3.5, 3.75),
    ])  # fmt: skip
    assert [(p["t_s"], p["number"], p["bytes"]) for p in made] == [
        (1.5, 1, 1344), (2.0, 1, 1344), (pytest.approx(10 / 3), 2, 1344), (pytest.approx(11 / 3), 2, 1344), (4.0, 2, 312),
        (3.75, 4, 500),
    ]  # fmt: skip


def test_a_fragment_that_did_not_go_whole_is_not_there() -> None:
    """Two bytes are lacking to the second of three; the last of another payload is shorter than what is kept of it."""
    _, once = sample_wire(3000, 1344)
    made = packets(
        [row(0, 1, "features", 3000, 1.0, 2.0, wire_bytes=2 * once // 3 - 2), row(0, 1, "features", 1350, 2.0, 3.0)]
    )
    assert [(p["t_s"], p["bytes"]) for p in made] == [(2.0, 1344), (2.5, 1344), (3.0, 6)]


def test_samples_are_numbered_by_sender_and_topic_and_requests_go_with_boxes() -> None:
    made = packets([
        row(0, 1, "features", 500, 0.1, 0.2), row(0, 2, "features", 600, 0.2, 0.3), row(1, 0, "features", 700, 0.3, 0.4),
        row(0, 1, "detections", 200, 0.4, 0.5), row(0, 1, "handshake", 24, 0.5, 0.6), row(1, 2, "tracks", 90, 0.6, 0.7),
    ])  # fmt: skip
    assert [(p["from"], p["to"], p["kind"], p["number"], p["bytes"], p["fragment"]) for p in made] == [
        (0, 1, FEATURES, 1, 500, None), (0, 2, FEATURES, 2, 600, None), (1, 0, FEATURES, 1, 700, None),
        (0, 1, COMPACT, 1, 200, None), (0, 1, COMPACT, 2, 24, None), (1, 2, COMPACT, 1, 90, None),
    ]  # fmt: skip


def test_each_tile_is_a_sample_of_its_own_with_a_number_that_it_keeps() -> None:
    """Tiles of features alone; the second of three went twice, and boxes are one sample as ever."""
    count = next(n for n in range(2, 500) if cut(n, 1344).number == 3)
    tiles = cut(count, 1344)
    size = tiles.tile_bytes * 2 + 50
    fragments, once = sample_wire(size, tiles.tile_bytes, alone=True)
    assert fragments == 3
    tiled = {"cells": count, "fragments": 3, "fragments_lost": 1, "wire_bytes": once * 4 // 3 + 1}
    made = packets([
        row(0, 1, "features", size, 1.0, 2.0, **tiled), row(0, 1, "features", size, 2.0, 3.0, **tiled | {"fragments_lost": 0}),
        row(0, 1, "detections", 3000, 3.0, 4.0),
    ], "tiles")  # fmt: skip
    first, second, boxes = made[:4], made[4:7], made[7:]
    assert [(p["number"], p["bytes"]) for p in first] == [
        (1, tiles.tile_bytes),
        (2, tiles.tile_bytes),
        (3, 50),
        (1, tiles.tile_bytes),
    ]
    assert [p["number"] for p in second] == [4, 5, 6]
    assert [p["fragment"] for p in first + second] == [None] * 7
    assert [(p["number"], p["fragment"]) for p in boxes] == [(1, (k, 1, 1344, 3000)) for k in (1, 2, 3)]


def test_the_checksum_of_every_header_is_the_complement_of_its_sum() -> None:
    for drone, peer, size in ((0, 1, 500), (9, 200, 1344), (254, 3, 17)):
        made = record()
        tables = tables_of({"transmissions": [row(drone, peer, "features", size, 0.1, 0.2)]})
        (packet,) = _payload_packets(replace(made, tables=tables), BEGIN_NS)
        for ends, hops in ((packet.destination, 64), ((GROUP, 7401), 1)):
            header = _datagram(packet._replace(destination=ends))[:20]
            total = sum(struct.unpack(">10H", header))
            assert (total & 0xFFFF) + (total >> 16) == 0xFFFF
            assert (header[12:16], header[16:20], header[8]) == (address(drone), ends[0], hops)
