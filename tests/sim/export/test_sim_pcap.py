"""Packet captures: what tshark finds, and what is read here byte by byte, is what the record holds."""

from __future__ import annotations

import shutil
import struct
import subprocess
from collections import Counter, defaultdict
from pathlib import Path
from typing import NamedTuple

import pytest
from exported_flight import flown
from sim_examples import example

from sortie.fleet.messages.auth import Opened, open_datagram
from sortie.fleet.messages.cdr import ENCAPSULATION
from sortie.fleet.messages.compact import FULL, Form
from sortie.fleet.messages.wire import DIRECTIVE_BYTES, decode_directive
from sortie.fleet.tiles import cut
from sortie.sim.engine.events import group_key
from sortie.sim.engine.sortie import KEY_ID, run_sortie
from sortie.sim.export.pcap import KEPT_BYTES, write_pcap
from sortie.sim.results.record import SortieRecord

BEGIN_NS = 1_767_225_600_000_000_000
SETTINGS = {
    "tiles": ("radio.framing=tiles",),
    "small": ("context.form=small", "context.authentication=false"),
    "bad": ("radio.tx_power_dbm=6", "radio.path_loss_exponent=3", "policy={name: boxes, dwell_s: 0.3}"),
    "crowded": ("fleet.drones=9", "policy.params={rho: 1.0}", "radio.bandwidth_mhz=20"),
}


class Read(NamedTuple):
    """A packet as read from the file."""

    t_ns: int
    length: int
    kept: bytes

    @property
    def ports(self) -> tuple[int, int]:
        return struct.unpack(">HH", self.kept[20:24])

    @property
    def drone(self) -> int:
        return self.kept[15] - 1

    @property
    def rtps(self) -> bytes:
        return self.kept[28:]


def read(path: Path) -> list[Read]:
    """The packets of a capture, by the format's own definition."""
    data, at, found = path.read_bytes(), 24, []
    assert struct.unpack_from("<IHHiIII", data) == (0xA1B23C4D, 2, 4, 0, 0, 262_144, 101)
    while at < len(data):
        second, nanosecond, kept, length = struct.unpack_from("<IIII", data, at)
        found.append(Read(second * 10**9 + nanosecond - BEGIN_NS, length, data[at + 16 : at + 16 + kept]))
        at += 16 + kept
    return found


def check_descriptors(record: SortieRecord, packets: list[Read]) -> None:
    """Every one is there with its length and time, and opens with its drone's key and counter."""
    heard = [p for p in packets if p.ports == (7401, 7401)]
    form = Form(**record.scenario.context.form.model_dump())
    header = 0 if form == FULL else 4  # the paper's form has a CDR header of its own
    rows = sorted(record.tables["descriptors"].to_pylist(), key=lambda row: row["t_s"])
    assert [(p.t_ns, p.drone, p.length) for p in heard] == [
        (round(r["t_s"] * 1e9), r["drone"], 20 + 8 + 20 + 12 + 24 + header + r["wire_bytes"]) for r in rows
    ]
    keys = {KEY_ID: group_key(record.seed)} if record.scenario.context.authentication else None
    counters: dict[int, int] = defaultdict(int)
    for packet, row in zip(heard, rows, strict=True):
        assert packet.rtps[56:60] == ENCAPSULATION
        assert struct.unpack_from("<H", packet.rtps, 34)[0] == len(packet.rtps) - 36
        opened = open_datagram(packet.rtps[20 + 12 + 24 + header :], keys)
        assert isinstance(opened, Opened)
        assert (opened.descriptor.agent_id, opened.descriptor.stamp_ns) == (row["drone"], row["stamp_ns"])
        step = 1e-6 if form == FULL else form.soc_step  # in a small form it is rounded
        assert opened.descriptor.battery_soc == pytest.approx(row["soc"], abs=step)
        counters[row["drone"]] += 1
        assert opened.counter == (counters[row["drone"]] if keys else 0)


def check_directives(record: SortieRecord, packets: list[Read]) -> None:
    taken = [p for p in packets if p.ports == (7412, 7413)]
    rows = sorted(record.tables["directives"].to_pylist(), key=lambda row: row["t_s"])
    assert len(taken) == len(rows) == record.totals["directives"]
    for packet, row in zip(taken, rows, strict=True):
        assert struct.unpack_from("<H", packet.rtps, 50)[0] == len(packet.rtps) - 52 == 20 + DIRECTIVE_BYTES
        order = decode_directive(packet.rtps[20 + 12 + 16 + 24 :])
        assert (packet.t_ns, order.source, order.destination) == (round(row["t_s"] * 1e9), row["drone"], row["peer"])
        assert order.rate_hz == pytest.approx(row["rate_hz"], rel=1e-6)


def check_payloads(record: SortieRecord, packets: list[Read]) -> None:
    """Every one that got through is there, fragment by fragment."""
    at: dict[tuple[int, int, int], int] = Counter()  # content by sender, receiver and time of its last fragment
    samples: dict[tuple[int, int, bytes], list[Read]] = defaultdict(list)
    for packet in packets:
        if packet.ports == (7411, 7411):
            submessage = packet.rtps[20 + 12 + 16 :]
            assert submessage[0] in (0x15, 0x16)
            samples[packet.drone, packet.kept[19] - 1, submessage[12:24]].append(packet)
            overhead = 20 + 8 + 20 + 12 + 16 + (28 if submessage[0] == 0x15 else 36)
            at[packet.drone, packet.kept[19] - 1, packet.t_ns] += 1
            assert len(packet.kept) == overhead + min(KEPT_BYTES, packet.length - overhead)
    tiled = record.scenario.radio.framing == "tiles"
    rows = [r for r in record.tables["transmissions"].to_pylist() if r["status"] == "delivered"]
    assert len(rows) > 10
    for row in rows:
        assert at[row["drone"], row["peer"], round(row["t_done_s"] * 1e9)] >= 1
        in_tiles = tiled and row["representation"] == "features"
        assert row["fragments"] == (cut(row["cells"], 1344).number if in_tiles else -(-row["payload_bytes"] // 1344))
    if not tiled:  # a sample's fragments have one number
        sizes = Counter(len(sent) for sent in samples.values())
        assert sizes >= Counter(row["fragments"] + row["fragments_lost"] for row in rows)
    # a frame has 38 B of 802.11 around the datagram; the record has parts of fragments too, where a deadline came
    features = [p for (_, _, writer), sent in samples.items() if writer[2] == 3 for p in sent]
    sent = sum(r["wire_bytes"] for r in record.tables["transmissions"].to_pylist() if r["representation"] == "features")
    assert sum(p.length + 38 for p in features) == pytest.approx(sent, rel=0.01)


def captured(record: SortieRecord, path: Path) -> list[Read]:
    counts = write_pcap(record, path, BEGIN_NS)
    packets = read(path)
    assert sum(counts.values()) == len(packets)
    return packets


def test_all_that_was_sent_is_there_with_its_length_and_time(tmp_path: Path) -> None:
    record = flown()[0]
    packets = captured(record, tmp_path / "a.pcap")
    for check in (check_descriptors, check_directives, check_payloads):
        check(record, packets)


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS)
def test_all_is_there_in_flights_of_other_frames_forms_and_air(settings: str, tmp_path: Path) -> None:
    drop = "events=[{kind: link_drop, at_s: 3.5, drone: 2, loss_db: 60}]"
    record = run_sortie(example("duration_s=4.05", drop, *SETTINGS[settings]))
    packets = captured(record, tmp_path / "a.pcap")
    for check in (check_descriptors, check_directives, check_payloads):
        check(record, packets)


def test_descriptors_are_the_bytes_that_flew(tmp_path: Path) -> None:
    """All but the position, velocity and attitude, which a drone estimates and the record keeps as they truly were."""
    record, sent = flown()
    written = [p.rtps[56:] for p in captured(record, tmp_path / "a.pcap") if p.ports == (7401, 7401)]
    pose = slice(16, 60)  # after encapsulation, stamp and id; what follows it is as it was
    apart = [[(data[:13], data[pose.stop : -16]) for data in sorted(each)] for each in (written, sent)]
    assert apart[0] == apart[1]


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_tshark_reads_every_packet_as_rtps(tmp_path: Path) -> None:
    record, path = flown()[0], tmp_path / "a.pcap"
    packets = captured(record, path)
    frame = ("frame.time_epoch", "ip.src", "ip.checksum.status", "udp.dstport", "rtps.sm.id", "rtps.info_ts.timestamp")
    names = (*frame, *(f"rtps.data_frag.{part}" for part in ("sample_size", "size", "number")), "_ws.malformed")
    fields = [word for name in names for word in ("-e", name)]
    shape = ("-o", "ip.check_checksum:TRUE", "-u", "s", "-T", "fields", "-E", "separator=;")
    command = ["tshark", "-r", str(path), *shape, *fields]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = [line.split(";") for line in done.stdout.splitlines()]
    assert len(rows) == len(packets)
    for row, packet in zip(rows, packets, strict=True):
        epoch, source, checksum, port, submessages, stamp, sample, each, number, malformed = row
        assert malformed == ""
        assert checksum == "1"
        assert (source, int(port)) == (f"10.0.0.{packet.drone + 1}", packet.ports[1])
        second, nanosecond = map(int, epoch.split("."))
        assert second * 10**9 + nanosecond - BEGIN_NS == packet.t_ns
        assert stamp.split()[3].endswith(epoch.split(".")[1])
        kind = submessages.split(",")[-1]
        assert submessages == ("0x09,0x15" if port == "7401" else f"0x09,0x0e,{kind}")
        if kind == "0x16":
            assert 1 <= int(number) <= -(-int(sample) // int(each))
    assert sum(row[3] == "7401" for row in rows) == len(record.tables["descriptors"])
