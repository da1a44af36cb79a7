"""The packets of payloads by hand from a few rows: when each goes, which part it carries, and its number."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any, NamedTuple

import pytest
from record_by_hand import record, tables_of

from sortie.fleet.tiles import cut
from sortie.radio.mac.airtime import sample_wire
from sortie.sim.export.pcap import GROUP, KEPT_BYTES, _datagram, _payload_packets, address
from sortie.sim.export.topics import TopicKind

BEGIN_NS = 7_000_000_000
FEATURES, COMPACT = TopicKind.FEATURES, TopicKind.COMPACT
DATA, DATA_FRAG = 0x15, 0x16


class Sent(NamedTuple):
    """A packet: when it went, from whom to whom, its topic, its number, its fragment, and its content's bytes."""

    t_s: float
    sender: int
    receiver: int
    kind: TopicKind
    number: int
    fragment: tuple[int, ...] | None
    size: int


def row(drone: int, peer: int, what: str, size: int, start_s: float, done_s: float, **more: Any) -> dict[str, Any]:
    """A payload of which every fragment went once."""
    fragments, wire = sample_wire(size, 1344)
    ends = {"drone": drone, "peer": peer, "representation": what, "payload_bytes": size}
    air = {"t_start_s": start_s, "t_done_s": done_s, "fragments": fragments, "wire_bytes": wire}
    return ends | air | {"fragments_lost": 0, "cells": 0} | more


def packets(*rows: dict[str, Any], framing: str = "sample") -> list[Sent]:
    made = record()
    radio = made.scenario.radio.model_copy(update={"framing": framing, "fragment_bytes": 1344})
    scenario = made.scenario.model_copy(update={"radio": radio})
    tables = tables_of({"transmissions": list(rows)})
    found = []
    for p in _payload_packets(replace(made, scenario=scenario, tables=tables), BEGIN_NS):
        second, fraction = struct.unpack_from("<II", p.rtps, 24)
        assert second + fraction / 2**32 == pytest.approx(7.0 + p.t_s, abs=1e-8)
        kind, number = p.rtps[48], struct.unpack_from("<I", p.rtps, 68)[0]
        head = 76 if kind == DATA else 84
        fragment = struct.unpack_from("<IHHI", p.rtps, 72) if kind == DATA_FRAG else None
        assert len(p.rtps) == head + min(KEPT_BYTES, p.rtps_bytes - head)
        sender, receiver = p.source[0][3] - 1, p.destination[0][3] - 1
        assert sender == p.rtps[19], "the sender's prefix"
        found.append(Sent(round(p.t_s, 9), sender, receiver, p.kind, number, fragment, p.rtps_bytes - head))
    return found


WHOLE = 3000
"""Bytes of a payload of three fragments, of which the last has 312."""
ONCE = sample_wire(WHOLE, 1344)[1]


def test_fragments_are_spread_over_the_time_on_the_air_and_those_that_were_lost_go_again() -> None:
    """The first fragment went twice: four packets in a second."""
    made = packets(row(0, 1, "features", WHOLE, 1.0, 2.0, fragments_lost=1, wire_bytes=ONCE * 4 // 3 + 1))
    assert made == [
        Sent(t_s, 0, 1, FEATURES, 1, (k, 1, 1344, WHOLE), size)
        for t_s, k, size in ((1.25, 1, 1344), (1.5, 2, 1344), (1.75, 3, 312), (2.0, 1, 1344))
    ]


def test_of_a_payload_that_was_broken_off_as_much_is_there_as_went_whole() -> None:
    """Two thirds; a payload in the air at the end, after 4 s; nothing. Two bytes are lacking to a second third."""
    made = packets(
        row(0, 1, "features", WHOLE, 1.0, 2.0, wire_bytes=2 * ONCE // 3 + 1),
        row(0, 1, "features", WHOLE, 3.0, math.nan),
        row(0, 1, "features", WHOLE, math.nan, math.nan, wire_bytes=0),
        row(0, 1, "features", 500, 3.5, 3.75),
    )
    third = 10 / 3
    assert [(p.t_s, p.number, p.size) for p in made] == [
        *((1.5, 1, 1344), (2.0, 1, 1344)),
        *((pytest.approx(third), 2, 1344), (pytest.approx(third + 1 / 3), 2, 1344), (4.0, 2, 312)),
        (3.75, 4, 500),
    ]
    cut_short = row(0, 1, "features", WHOLE, 1.0, 2.0, wire_bytes=2 * ONCE // 3 - 2)
    made = packets(cut_short, row(0, 1, "features", 1350, 2.0, 3.0))  # its last has less than what is kept of one
    assert [(p.t_s, p.size) for p in made] == [(2.0, 1344), (2.5, 1344), (3.0, 6)]


def test_samples_are_numbered_by_sender_and_topic_and_requests_go_with_boxes() -> None:
    made = packets(
        row(0, 1, "features", 500, 0.1, 0.2),
        row(0, 2, "features", 600, 0.2, 0.3),
        row(1, 0, "features", 700, 0.3, 0.4),
        row(0, 1, "detections", 200, 0.4, 0.5),
        row(0, 1, "handshake", 24, 0.5, 0.6),
        row(1, 2, "tracks", 90, 0.6, 0.7),
    )
    assert [p[1:] for p in made] == [
        (0, 1, FEATURES, 1, None, 500),
        (0, 2, FEATURES, 2, None, 600),
        (1, 0, FEATURES, 1, None, 700),
        (0, 1, COMPACT, 1, None, 200),
        (0, 1, COMPACT, 2, None, 24),
        (1, 2, COMPACT, 1, None, 90),
    ]


def test_each_tile_is_a_sample_of_its_own_with_a_number_that_it_keeps() -> None:
    """Tiles of features alone; the first of three went twice, and boxes are one sample as ever."""
    count = next(n for n in range(2, 500) if cut(n, 1344).number == 3)
    tile_bytes = cut(count, 1344).tile_bytes
    size = tile_bytes * 2 + 50
    fragments, once = sample_wire(size, tile_bytes, alone=True)
    assert fragments == 3
    tiled = {"cells": count, "fragments": 3, "wire_bytes": once * 4 // 3 + 1}
    made = packets(
        row(0, 1, "features", size, 1.0, 2.0, **tiled, fragments_lost=1),
        row(0, 1, "features", size, 2.0, 3.0, **tiled),
        row(0, 1, "detections", WHOLE, 3.0, 4.0),
        framing="tiles",
    )
    assert [(p.number, p.size) for p in made[:4]] == [(1, tile_bytes), (2, tile_bytes), (3, 50), (1, tile_bytes)]
    assert [p.number for p in made[4:7]] == [4, 5, 6]
    assert [p.fragment for p in made[:7]] == [None] * 7
    assert [(p.number, p.fragment) for p in made[7:]] == [(1, (k, 1, 1344, WHOLE)) for k in (1, 2, 3)]


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
