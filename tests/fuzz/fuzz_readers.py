"""Every reader of files and messages from outside, with valid inputs in the true format and the damage that fits it."""

from __future__ import annotations

import io
import json
import struct
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fuzz_mutators as m
import log_examples
import numpy as np
import yaml

from sortie.scenarios.errors import SortieError

LIBRARY = Path(__file__).resolve().parents[2] / "scenarios" / "library"


@dataclass(frozen=True)
class Reader:
    """A reader, and how it is tried."""

    read: Callable[[Path], object]
    """Takes a file; may raise `refusals`, and nothing else."""
    corpus: Callable[[], list[bytes]]
    """Files that it reads."""
    odd: Callable[[], list[bytes]] = list
    """More files to damage, which it may refuse."""
    mutators: Sequence[m.Mutator] = m.BINARY
    suffix: str = ""
    refusals: tuple[type[Exception], ...] = (SortieError,)
    limit_s: float = 2.0
    """Processor time that a file may take."""


# --- scenarios and campaigns ------------------------------------------------------------------------


def _yaml_corpus(key: str) -> list[bytes]:
    """The library's files with a key on top, as they are and as JSON, which is YAML as well."""
    texts = [path.read_text() for path in sorted(LIBRARY.glob("*.yaml"))]
    wanted = [text for text in texts if f"\n{key}:" in f"\n{text}" and (key == "campaign" or "\ncampaign:" not in text)]
    return [text.encode() for text in wanted] + [json.dumps(yaml.safe_load(text)).encode() for text in wanted]


def _scenario(path: Path) -> None:
    from sortie.scenarios.reading.load import dump, load, loads

    scenario = load(path)
    assert loads(dump(scenario)) == scenario, "what is dumped does not load to the same"


def _campaign(path: Path) -> None:
    from sortie.scenarios.reading.campaign import load_campaign

    load_campaign(path)


# --- messages --------------------------------------------------------------------------------------


def _descriptors() -> list[bytes]:
    from fleet_examples import DESCRIPTOR

    from sortie.fleet.messages.compact import Form, encode_compact
    from sortie.fleet.messages.wire import encode_descriptor
    from sortie.policies.contract import Roster

    grown = DESCRIPTOR._replace(feature_space="fine", priority_target_ids=(1, 2, 3), codebook="0f" * 7)
    member = DESCRIPTOR._replace(peer_goodput_mbps=(3.0, 4.0)).with_roster(Roster(7, (1, 3, 9)))
    compact = [
        encode_compact(d, f) for d in (DESCRIPTOR, grown) for f in (Form(4, 1, 8), Form(8, 2, 12), Form(0, 1, 32))
    ]
    return [*map(encode_descriptor, (DESCRIPTOR, grown, member)), *compact]


def _descriptor(path: Path) -> None:
    from sortie.fleet.messages.compact import MARK
    from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor

    data = path.read_bytes()
    found = decode_descriptor(data)
    if data[:1] != MARK:
        assert decode_descriptor(encode_descriptor(found)) == found, "what is encoded again is read as another"


def _directive(path: Path) -> None:
    from sortie.fleet.messages.wire import decode_directive, encode_directive

    found = decode_directive(path.read_bytes())
    assert decode_directive(encode_directive(found)) == found, "what is encoded again is read as another"


def _directives() -> list[bytes]:
    from fleet_examples import DIRECTIVE

    from sortie.fleet.messages.wire import encode_directive

    return [encode_directive(DIRECTIVE), encode_directive(DIRECTIVE._replace(roi=None, rho=1.0))]


def _payloads() -> list[bytes]:
    from fleet_examples import DIRECTIVE

    from sortie.fleet.messages.wire import encode_directive
    from sortie.sim.live.payload_message import pack_bytes

    order = encode_directive(DIRECTIVE._replace(source=1, destination=0))
    return [
        pack_bytes(struct.pack("<qI7f", time.time_ns(), 1, *[0.5] * 7).ljust(40, b"\0") + order + bytes(size))
        for size in (0, 100, 9000)
    ]


class _Node:
    """A drone's gate on a bus in memory: what comes over the bus reaches it as in `sortie live`."""

    made: Any = None

    def __call__(self, path: Path) -> None:
        from memory_bus import MemoryBus
        from sim_examples import example

        from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
        from sortie.sim.live.node import Role
        from sortie.sim.live.roles import RoleNode, RoleOrders

        if self.made is None:
            bus = MemoryBus()
            flying = example("fleet.drones=2", "duration_s=6000", "context.authentication=false")
            self.made = bus, RoleNode(Role.GATE, bus, RoleOrders(flying, 0, time.time() - 1.0, None))
        bus, node = self.made
        data = path.read_bytes()
        for topic in (
            Topic(TopicKind.FEATURES, 1, 0),
            Topic(TopicKind.COMPACT, 1, 0),
            Topic(TopicKind.DIRECTIVE, 0, 1),
            CONTEXT,
        ):
            bus.writer(topic).write(data)
        bus.written.clear()
        node.node.take()
        node.node.report(0.0)


# --- tables and recordings -------------------------------------------------------------------------


def _trace_columns() -> dict[str, list[Any]]:
    t = [0.0, 0.1, 0.2, 0.0, 0.1, 0.2]
    return {
        "t_s": t, "drone": [0, 0, 0, 1, 1, 1], "x_m": [1.0, 2.0, None, 4.0, 5.0, 6.0], "y_m": t, "z_m": [60.0] * 6,
        "qx": [0.0] * 6, "qy": [0.0] * 6, "qz": [0.0] * 6, "qw": [1.0] * 6, "vx_mps": t, "vy_mps": t, "vz_mps": t,
        "soc": [0.9, 0.8, 0.7, 0.9, 0.8, 0.7], "voltage_v": [16.0] * 6, "current_a": [None, *t[1:]], "note": list("abcdef"),
    }  # fmt: skip


def _link_columns() -> dict[str, list[Any]]:
    return {"t_s": [0.0, 1.0, 0.0], "sender": [0, 0, 1], "receiver": [1, 1, 0], "goodput_mbps": [1.0, 2.0, None],
            "loss": [0.1, 0.2, 1.0], "rssi_dbm": [-60.0, -61.0, -62.0]}  # fmt: skip


def _tables(csv: bool) -> list[bytes]:
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    found = []
    for columns in (_trace_columns(), _link_columns()):
        table = pa.table(columns)
        for options in (
            [{}]
            if csv
            else [{}, {"compression": "gzip", "use_dictionary": False}, {"compression": "zstd", "version": "1.0"}]
        ):
            out = io.BytesIO()
            pa.csv.write_csv(table, out) if csv else pa.parquet.write_table(table, out, **options)
            found.append(out.getvalue())
    return found


def _odd_tables() -> list[bytes]:
    """Columns of text, and of lists and structs."""
    import pyarrow as pa
    import pyarrow.parquet

    text = pa.table({name: pa.array(map(str, values)) for name, values in _trace_columns().items()})
    nested = pa.table({"t_s": [[0.0], [1.0]], "x_m": [{"a": 1}, {"a": 2}]})
    found = []
    for table in (text, nested):
        out = io.BytesIO()
        pa.parquet.write_table(table, out)
        found.append(out.getvalue())
    return found


def _trace(path: Path) -> None:
    """As the two readers of traces take it: drones' first, then links'."""
    from sortie.fleet.traces import read_traces
    from sortie.radio.channel.traces import read_links

    try:
        read_links(path, 2)
    except SortieError:
        read_traces(path, 2)


def _recordings() -> list[bytes]:
    from recording_examples import small

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        found = [small(path).read_bytes()]
        small(path, features=None)
        found.append(path.read_bytes())
        arrays = dict(np.load(path))
    for save in (np.savez, np.savez_compressed):
        out = io.BytesIO()
        save(out, **arrays)
        found.append(out.getvalue())
    return found


def _recording(path: Path) -> None:
    from sortie.perception.recordings.recording import open_recording

    rec = open_recording(path)
    rec.boxes(0, 0), rec.truth(0), rec.rank(0, 0), rec.geometry
    if "features" in rec.large:
        rec.features(0, 0), rec.rank(0, 0)


# --- flight logs -----------------------------------------------------------------------------------


def _log(path: Path) -> None:
    """All of `sortie import` but for what it writes."""
    from sortie.sim.cli.import_log import flown_log, told

    flights, columns, _ = flown_log([path], path.parent)
    assert all(len(line.splitlines()) == 1 for line in told(flights, columns)), "a problem of more than a line"


def _ulogs() -> list[bytes]:
    """The flight, then one with nested types, lists, letters and a second instance of a topic."""
    message, data = log_examples.ulog_message, log_examples.ulog(20)
    odd = data[:16]
    for text in (
        "inner:uint16_t a;uint8_t[3] b;uint8_t[3] _padding0;", "outer:uint64_t timestamp;inner[2] pair;char[8] name;bool on;",
        "battery_status:uint64_t timestamp;float voltage_v;float current_a;float remaining;uint8_t[4] _padding0;",
    ):  # fmt: skip
        odd += message("F", text.encode())
    for number, (instance, name) in enumerate(((0, b"outer"), (0, b"battery_status"), (1, b"battery_status"))):
        odd += message("A", struct.pack("<BH", instance, number) + name)
    for k in range(20):
        odd += message("D", struct.pack("<HQ", 0, k * 100_000) + bytes(25))
        odd += message("D", struct.pack("<HQ3f", 1, k * 100_000, 16.0, 5.0, 0.5))
        odd += message("D", struct.pack("<HQ3f", 2, k * 100_000, 15.0, 5.0, 0.5))
    odd += message("O", struct.pack("<H", 20)) + message("L", b"6" + bytes(8) + b"text") + message("S", b"/sync/ma")
    return [data, odd + message("I", b"\x0achar[2] abxy"), odd + data[16:]]


def _dataflashes() -> list[bytes]:
    """The flight, and one with a field of every kind that there is before it."""
    data = log_examples.dataflash(20)
    return [data, _odd_dataflash()[0] + data]


def _odd_dataflash() -> list[bytes]:
    odd = log_examples.dataflash_begin()
    kinds = "abBhHiIfdnNZcCeELMqQg"
    for number, some in ((200, kinds[:8]), (201, kinds[8:16]), (202, kinds[16:])):
        size = sum({"a": 64, "h": 2, "H": 2, "c": 2, "C": 2, "g": 2, "i": 4, "I": 4, "f": 4, "e": 4, "E": 4, "L": 4, "n": 4,
                    "N": 16, "Z": 64, "d": 8, "q": 8, "Q": 8}.get(c, 1) for c in some)  # fmt: skip
        name = f"X{number}".encode()
        odd += log_examples.dataflash_message("FMT", number, 3 + size, name, some.encode(), ",".join(some).encode())
        odd += (b"\xa3\x95" + bytes([number]) + bytes(size)) * 5
    return [odd]


def _tlogs() -> list[bytes]:
    """The flight, then two vehicles with a ground station, parameters, a radio, signed frames and MAVLink 1."""
    from pymavlink.dialects.v10 import common as mavlink1
    from pymavlink.dialects.v20 import common as mavlink2

    from sortie.fleet.logs.mavlink import Transmitter, messages

    several, signed = b"", b""
    own = [Transmitter(drone) for drone in (0, 6)]
    sealed, station = Transmitter(0, bytes(range(32))), Transmitter(254)
    old = mavlink1.MAVLink(None, srcSystem=3, srcComponent=1)
    for k in range(20):
        for each in own:
            for message in messages(log_examples.state(k), log_examples.ORIGIN):
                several += log_examples.stamped(k, each.pack(message))
        for message in messages(log_examples.state(k), log_examples.ORIGIN):
            signed += log_examples.stamped(k, sealed.pack(message))
        several += log_examples.stamped(k, station.pack(mavlink2.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)))
        several += log_examples.stamped(
            k, own[1].pack(mavlink2.MAVLink_param_value_message(b"BATT_CAPACITY", 5000.0, 9, 1, 0))
        )
        several += log_examples.stamped(
            k, station.pack(mavlink2.MAVLink_radio_status_message(190, 150, 90, 0, 0, 0, 0))
        )
        signed += log_examples.stamped(k, mavlink1.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3).pack(old))
        signed += log_examples.stamped(k, mavlink1.MAVLink_attitude_message(k, 0, 0, 0, 0, 0, 0).pack(old))
    return [log_examples.tlog(20), several, signed]


def _bags() -> list[bytes]:
    """MCAP is written and not read: `sortie import` refuses it."""
    from mcap.writer import CompressionType, Writer

    found = []
    for compression in (CompressionType.NONE, CompressionType.ZSTD):
        out = io.BytesIO()
        writer = Writer(out, compression=compression)
        writer.start()
        schema = writer.register_schema(
            name="sortie_msgs/msg/DataPlaneDirective", encoding="ros2msg", data=b"uint8 source"
        )
        channel = writer.register_channel(
            schema_id=schema, topic="/drone_0/to_drone_1/directive", message_encoding="cdr"
        )
        for k in range(20):
            writer.add_message(channel_id=channel, log_time=k, publish_time=k, data=_directives()[0])
        writer.finish()
        found.append(out.getvalue())
    return found


def _of_log(
    kind: str, corpus: Callable[[], list[bytes]], odd: Callable[[], list[bytes]], structural: m.Mutator
) -> Reader:
    return Reader(_log, corpus, odd, (*[structural] * 6, *m.BINARY, m.digits), f".{kind}")


def _malformed() -> tuple[type[Exception], ...]:
    from sortie.fleet.messages.cdr import MalformedDatagram

    return (MalformedDatagram,)


READERS: dict[str, Reader] = {
    "scenario": Reader(_scenario, lambda: _yaml_corpus("name"), list, (*[m.in_json] * 3, *m.TEXT), ".yaml"),
    "campaign": Reader(_campaign, lambda: _yaml_corpus("campaign"), list, (*[m.in_json] * 3, *m.TEXT), ".yaml"),
    "descriptor": Reader(_descriptor, _descriptors, refusals=_malformed()),
    "directive": Reader(_directive, _directives, refusals=_malformed()),
    "payload": Reader(_Node(), lambda: [*_payloads(), *_directives(), *_descriptors()], refusals=()),
    "csv": Reader(_trace, lambda: _tables(csv=True), list, m.TEXT, ".csv"),
    "parquet": Reader(_trace, lambda: _tables(csv=False), _odd_tables, suffix=".parquet"),
    "npz": Reader(_recording, _recordings, list, (*[m.in_archive] * 5, *m.BINARY), ".npz"),
    "ulog": _of_log("ulg", _ulogs, list, m.in_messages(m.ulog_messages, m.ulog_joined)),
    "dataflash": _of_log("bin", _dataflashes, _odd_dataflash, m.in_messages(m.dataflash_messages)),
    "tlog": _of_log("tlog", _tlogs, list, m.in_messages(m.tlog_messages, m.tlog_joined)),
    "mcap": Reader(_log, list, _bags, suffix=".mcap"),
}
