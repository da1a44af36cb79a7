"""A sortie as a packet capture for Wireshark and tshark: descriptors, directives and payload fragments as RTPS over UDP.

| packets | from | to | when |
|---|---|---|---|
| descriptor: one DATA with its bytes, sealed as they flew | 10.0.0.(drone + 1), from drone 255 on 10.0.1.0, …, port 7401 | 239.255.0.1, port 7401 | when published |
| directive: one DATA | a drone's policy node, port 7412 | its gate, port 7413 | when the gate takes it up |
| payload: DATA, or DATA_FRAG where there are several fragments | sender, port 7411 | receiver, port 7411 | see below |

The record has no times of single fragments. They are spread evenly over the time from the payload's first frame on the
air to its end. A fragment that was lost and sent again is there twice. Fragments that the sender did not come to send
are left out. No run keeps the contents of payloads: they are zeros, and their packets are cut after `KEPT_BYTES` of
them, as a capture with a snap length does. The lengths that packets name are the true ones. A descriptor has the drone's true
position, because the record keeps no estimate. Acknowledgements, heartbeats and discovery are left out.

Each format here (pcap, IPv4, UDP, four RTPS submessages) is one `struct`. The packet libraries for Python do not write
RTPS, so they would save two of these lines.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from sortie.fleet.messages.auth import Sealer
from sortie.fleet.messages.cdr import ENCAPSULATION
from sortie.fleet.messages.compact import FULL, Form, encode_compact
from sortie.fleet.messages.wire import encode_descriptor, encode_directive
from sortie.fleet.tiles import cut
from sortie.radio.mac.airtime import sample_wire
from sortie.scenarios.representation import BOXES, REPRESENTATION_OF
from sortie.sim.engine.events import group_key
from sortie.sim.engine.sortie import KEY_ID
from sortie.sim.export.messages import descriptors, directives
from sortie.sim.export.topics import TopicKind
from sortie.sim.folders import writing
from sortie.sim.results.record import HANDSHAKE, SortieRecord

KEPT_BYTES = 16
"""Of the content of a payload's packet."""
GROUP = bytes((239, 255, 0, 1))
CONTEXT_PORT, DATA_PORT, POLICY_PORT, GATE_PORT = 7401, 7411, 7412, 7413
"""Of RTPS domain 0."""
_RTPS, _GUID = b"RTPS\x02\x05\x00\x00", b"\x00\x00sortie\x00\x00"
MARK = (_RTPS + _GUID).decode()
"""Near the begin of each capture that Sortie wrote."""

_FILE = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262_144, 101)  # nanoseconds, version 2.4, raw IP
_PACKET = struct.Struct("<IIII")
_IP = struct.Struct(">BBHHHBBH4s4s")
_UDP = struct.Struct(">HHHH")
_WRITERS = {kind: bytes((0, 0, number, 0x03)) for number, kind in enumerate(TopicKind, 1)}
"""The writer's entity, one for each kind of topic."""


class Packet(NamedTuple):
    """One datagram."""

    t_s: float
    kind: TopicKind
    source: tuple[bytes, int]
    """Address and port."""
    destination: tuple[bytes, int]
    rtps_bytes: int
    """Length of its RTPS message."""
    rtps: bytes
    """The message, or the beginning that is kept of it."""


def packets(record: SortieRecord, begin_ns: int) -> list[Packet]:
    """Every packet of a sortie, in the order of time.

    Args:
        record: the sortie.
        begin_ns: when the sortie is said to have begun, ns since 1970.
    """
    each = (_descriptor_packets, _directive_packets, _payload_packets)
    return sorted(chain.from_iterable(some(record, begin_ns) for some in each), key=lambda packet: packet.t_s)


def write_pcap(record: SortieRecord, path: Path, begin_ns: int) -> dict[TopicKind, int]:
    """Write a capture; there whole or not at all.

    Args:
        record: the sortie.
        path: the file; an older one there is replaced.
        begin_ns: when the sortie is said to have begun, ns since 1970.

    Returns:
        How many packets there are of each kind.

    Raises:
        RunError: the disk refuses.
    """
    counts: Counter[TopicKind] = Counter()
    with writing(path) as partial, partial.open("wb") as file:
        file.write(_FILE)
        for packet in packets(record, begin_ns):
            kept, length = _datagram(packet), _IP.size + _UDP.size + packet.rtps_bytes
            second, nanosecond = divmod(begin_ns + round(packet.t_s * 1e9), 1_000_000_000)
            file.write(_PACKET.pack(second, nanosecond, len(kept), length) + kept)
            counts[packet.kind] += 1
    return dict(counts)


# --- what is sent -----------------------------------------------------------------------------------


def _descriptor_packets(record: SortieRecord, begin_ns: int) -> Iterator[Packet]:
    scenario = record.scenario
    form = Form(**scenario.context.form.model_dump())
    encode = encode_descriptor if form == FULL else partial(encode_compact, form=form)
    sealers = [Sealer(group_key(record.seed), KEY_ID) for _ in range(scenario.fleet.drones)]
    numbers: Counter[int] = Counter()
    for t_s, d in descriptors(record):
        drone, data = d.agent_id, encode(d)
        if scenario.context.authentication:
            data = sealers[drone].seal(data)
        numbers[drone] += 1
        yield _whole(t_s, TopicKind.CONTEXT, drone, None, numbers[drone], data, begin_ns)


def _directive_packets(record: SortieRecord, begin_ns: int) -> Iterator[Packet]:
    numbers: Counter[int] = Counter()
    for t_s, order in directives(record):
        numbers[order.source] += 1
        number, data = numbers[order.source], encode_directive(order)
        yield _whole(t_s, TopicKind.DIRECTIVE, order.source, order.source, number, data, begin_ns)


def _payload_packets(record: SortieRecord, begin_ns: int) -> Iterator[Packet]:
    radio, numbers = record.scenario.radio, Counter[tuple[int, TopicKind]]()
    for row in record.tables["transmissions"].to_pylist():
        drone, peer, size = row["drone"], row["peer"], row["payload_bytes"]
        compact = row["representation"] == HANDSHAKE or REPRESENTATION_OF[row["representation"]] in BOXES
        kind = TopicKind.COMPACT if compact else TopicKind.FEATURES
        tiled = radio.framing == "tiles" and row["representation"] == "features"
        each = cut(row["cells"], radio.fragment_bytes).tile_bytes if tiled else radio.fragment_bytes
        sent = _fragments_sent(row, each, tiled)
        end_s = record.scenario.duration_s if math.isnan(row["t_done_s"]) else row["t_done_s"]
        for place in range(sent):
            k = place % row["fragments"]
            t_s = row["t_start_s"] + (place + 1) / sent * (end_s - row["t_start_s"])
            part = min(each, size - k * each)
            number = numbers[drone, kind] + (k if tiled else 0) + 1
            head = _header(drone, begin_ns + round(t_s * 1e9), peer)
            if row["fragments"] == 1 or tiled:
                head += _data(kind, number, len(ENCAPSULATION) + part) + ENCAPSULATION
            else:
                head += _data_frag(kind, number, k, part, each, size)
            ends = (address(drone), DATA_PORT), (address(peer), DATA_PORT)
            yield Packet(t_s, kind, *ends, len(head) + part, head + bytes(min(part, KEPT_BYTES)))
        numbers[drone, kind] += row["fragments"] if tiled else 1


def _fragments_sent(row: Mapping[str, Any], each: int, tiled: bool) -> int:
    """How many fragments of a payload went on the air, those that were sent again included."""
    if row["wire_bytes"] == 0 or math.isnan(row["t_start_s"]):
        return 0
    fragments, once_bytes = sample_wire(row["payload_bytes"], each, tiled)
    most: int = fragments + row["fragments_lost"]
    return min(most, int(fragments * row["wire_bytes"] / once_bytes + 1e-6))


# --- how it is written ------------------------------------------------------------------------------


def address(drone: int) -> bytes:
    """A drone's IPv4 address."""
    return bytes((10, 0, *divmod(drone + 1, 256)))


def _whole(
    t_s: float, kind: TopicKind, drone: int, receiver: int | None, number: int, data: bytes, begin_ns: int
) -> Packet:
    """A sample whose bytes are known: a descriptor to the group, or a directive within a drone."""
    if receiver is None:
        ends = (address(drone), CONTEXT_PORT), (GROUP, CONTEXT_PORT)
    else:
        ends = (address(drone), POLICY_PORT), (address(receiver), GATE_PORT)
    if not data.startswith(ENCAPSULATION):  # a smaller `context.form` has no CDR header of its own
        data = ENCAPSULATION + data
    message = _header(drone, begin_ns + round(t_s * 1e9), receiver) + _data(kind, number, len(data)) + data
    return Packet(t_s, kind, *ends, len(message), message)


def _datagram(packet: Packet) -> bytes:
    """The IP packet, or what is kept of it."""
    (source, source_port), (destination, port) = packet.source, packet.destination
    length = _UDP.size + packet.rtps_bytes
    hops = 1 if destination == GROUP else 64
    fields = (0x45, 0, _IP.size + length, 0, 0x4000, hops, 17, 0, source, destination)
    words = sum(struct.unpack(">10H", _IP.pack(*fields)))
    checksum = ~(words + (words >> 16)) & 0xFFFF
    ip = _IP.pack(*fields[:7], checksum, *fields[8:])
    return ip + _UDP.pack(source_port, port, length, 0) + packet.rtps  # UDP without a checksum


def _prefix(drone: int) -> bytes:
    """The first 12 bytes of the GUIDs of a drone's endpoints."""
    return _GUID + struct.pack(">H", drone)


def _header(drone: int, t_ns: int, receiver: int | None) -> bytes:
    """RTPS header and INFO_TS, and INFO_DST where one drone is addressed."""
    second, nanosecond = divmod(t_ns, 1_000_000_000)
    head = _RTPS + _prefix(drone)
    head += struct.pack("<BBHII", 0x09, 1, 8, second, -(-(nanosecond << 32) // 1_000_000_000))
    return head if receiver is None else head + struct.pack("<BBH", 0x0E, 1, 12) + _prefix(receiver)


def _data(kind: TopicKind, number: int, size: int) -> bytes:
    """A DATA submessage up to its content of `size` bytes, which begins with the CDR header."""
    return struct.pack("<BBHHH4s4siI", 0x15, 5, 20 + size, 0, 16, bytes(4), _WRITERS[kind], 0, number)


def _data_frag(kind: TopicKind, number: int, k: int, size: int, each: int, of: int) -> bytes:
    """A DATA_FRAG submessage up to its content: fragment k (from 0), of `size` bytes, of a sample of `of` bytes."""
    ids = (bytes(4), _WRITERS[kind], 0, number)
    return struct.pack("<BBHHH4s4siIIHHI", 0x16, 1, 32 + size, 0, 28, *ids, k + 1, 1, each, of)
