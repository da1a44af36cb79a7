"""`sortie export` and `sortie fly --mavlink`: what the commands write and send, and what they refuse."""

from __future__ import annotations

import hashlib
import socket
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from exported_flight import SECONDS, flown
from mcap.reader import make_reader
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink2
from sim_examples import BASE
from typer.testing import CliRunner

from sortie.fleet.logs.telemetry import KEY_BYTES
from sortie.sim.cli.app import app
from sortie.sim.export.endpoint import read_key
from sortie.sim.export.origin import parse_origin
from sortie.sim.folders import RunError
from sortie.sim.results import run_folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "run"
    run_folder.save(flown()[0], folder)
    return folder


def export(run: Path, *arguments: str) -> Result:
    return CliRunner().invoke(app, ["export", str(run), *arguments])


def first_ns(bag: Path) -> int:
    """When a bag begins."""
    with bag.open("rb") as file:
        _, _, message = next(iter(make_reader(file).iter_messages()))
    return int(message.log_time)


def messages(path: Path) -> list[Any]:
    reader, found = mavutil.mavlink_connection(str(path)), []
    while (m := reader.recv_match()) is not None:
        found.append(m)
    reader.close()
    return found


def test_a_bag_is_written_into_the_run_and_begins_when_it_is_told_to(run: Path) -> None:
    """By the zone that is named, or by UTC; a second one replaces the first."""
    at_8_ns = 1_795_248_000_000_000_000  # 2026-11-21 08:00 UTC
    for begin, more, begins_ns in (
        ("2026-11-21T09:00:00+01:00", [], at_8_ns),
        ("2026-11-21T08:00:00.25", ["--replace"], at_8_ns + 250_000_000),
    ):
        said = export(run, "--mcap", "--begin", begin, *more)
        assert said.exit_code == 0, said.output
        assert sorted(p.name for p in (run / "bag").iterdir()) == ["bag.mcap", "foxglove_layout.json", "metadata.yaml"]
        assert first_ns(run / "bag" / "bag.mcap") == begins_ns


def test_a_log_is_written_into_the_run_where_and_when_it_is_told_to(run: Path) -> None:
    arguments = ("--tlog", "--begin", "2026-11-21T09:00:00.25", "--origin", "52.5,13.4,30")
    said = export(run, *arguments)
    assert said.exit_code == 0, said.output
    places = [m for m in messages(run / "sortie.tlog") if m.get_type() == "GLOBAL_POSITION_INT"]
    assert len(places) == 5 * flown()[0].scenario.frames
    assert places[0]._timestamp == 1_795_251_600.25
    assert places[0].lat == pytest.approx(52.5e7, abs=5_000)


def test_the_log_of_one_drone(run: Path) -> None:
    """The same messages as in the log of all, and its own numbering."""
    assert export(run, "--tlog", "--replace").exit_code == 0
    whole = messages(run / "sortie.tlog")
    assert export(run, "--tlog", "--replace", "--drone", "1").exit_code == 0
    assert [str(m) for m in messages(run / "sortie.tlog")] == [str(m) for m in whole if m.get_srcSystem() == 2]


def test_a_capture_is_written_into_the_run(run: Path) -> None:
    done = export(run, "--pcap")
    assert done.exit_code == 0, done.output
    assert f"packets ({flown()[0].tables['descriptors'].num_rows} context," in done.output
    assert struct.unpack_from("<I", (run / "sortie.pcap").read_bytes(), 24)[0] == 1_767_225_600


def signed_parser(key: bytes) -> mavlink2.MAVLink:
    """Believes frames signed with a key alone."""
    parser = mavlink2.MAVLink(None)
    parser.signing.secret_key, parser.robust_parsing = key, True
    return parser


def test_a_log_is_signed_from_2015_on(run: Path, tmp_path: Path) -> None:
    key = bytes(range(KEY_BYTES))
    (tmp_path / "key").write_text(key.hex() + "\n")
    signed = ("--tlog", "--replace", "--key", str(tmp_path / "key"), "--begin")
    said = export(run, *signed, "2014-12-31")
    assert str(said.exception).startswith("begin is '2014-12-31', must lie from 2015 to before 2096")
    assert export(run, *signed, "2015-01-01").exit_code == 0
    frames = (run / "sortie.tlog").read_bytes()
    parser, unsigned = signed_parser(key), signed_parser(bytes(KEY_BYTES))
    heard, read_on = Counter[str](), 0
    while read_on < len(frames):
        size = frames[read_on + 9] + 12 + 13  # after the log's stamp: the frame's length, its head, its signature
        frame = frames[read_on + 8 : read_on + 8 + size]
        read_on += 8 + size
        heard.update(m.get_type() for m in parser.parse_buffer(frame) or [])
        assert [m.get_type() for m in unsigned.parse_buffer(frame) or []] == ["BAD_DATA"]
    assert heard["HEARTBEAT"] == 5 * SECONDS
    assert "BAD_DATA" not in heard


def test_what_flies_is_sent_and_signed_by_the_command(tmp_path: Path) -> None:
    """`sortie fly … --mavlink`, a flight of its own: pymavlink's own parser hears every drone."""
    key = hashlib.sha256(b"a ground station's passphrase").digest()
    (tmp_path / "key").write_bytes(key)
    scenario = tmp_path / "short.yaml"
    scenario.write_text(BASE.replace("duration_s: 6", "duration_s: 2"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(10.0)
        to = f"udpout:127.0.0.1:{station.getsockname()[1]}"
        arguments = ["fly", str(scenario), "--no-recording", "--mavlink", to, "--pace", "0"]
        arguments += ["--mavlink-key", str(tmp_path / "key"), "--out", str(tmp_path / "run")]
        said = CliRunner().invoke(app, arguments)
        assert said.exit_code == 0, said.output
        parser = signed_parser(key)
        heard = [m for _ in range(10) for m in parser.parse_buffer(station.recv(65_535)) or []]
    assert {m.get_srcSystem() for m in heard} == {1, 2, 3, 4, 5}
    assert "BAD_DATA" not in {m.get_type() for m in heard}


# --- what a user gets wrong -------------------------------------------------------------------------------


BEGIN_1960 = ("--begin", "1960-01-01")
WRONG: list[tuple[tuple[str, ...], str]] = [
    (("--mcap", "--begin", "noon"), "begin is 'noon', must be a time as in 2026-01-01T00:00:00"),
    (("--mcap", *BEGIN_1960), "begin is '1960-01-01', must lie from 1970 to before 2038"),
    (("--mcap", "--begin", "2050-01-01"), "begin is '2050-01-01', must lie from 1970 to before 2038"),
    (("--tlog", *BEGIN_1960), "begin is '1960-01-01', must lie from 1970 to before 2096"),
    (("--mcap", "--out", "."), ": is the working folder or holds it, a bag would replace it"),
    (("--tlog", "--replace", "--drone", "5"), "drone is 5, must be below fleet.drones = 5"),
    (("--tlog", "--origin", "89,0"), "origin is '89,0', must be latitude,longitude or"),
    ((), "name one format: --mcap, --tlog or --pcap"),
    (("--pcap", "--mcap"), "name one format: --mcap, --tlog or --pcap"),
    (("--mcap", "--key", "key"), "--key signs --tlog alone"),
    (("--pcap", "--origin", "47,8"), "--origin places --tlog and --mcap alone"),
    (("--mcap", "--drone", "1"), "--drone selects from --tlog alone"),
]


def test_what_a_user_gets_wrong_is_named(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    wrong = {}
    for arguments, message in WRONG:
        said = export(run, *arguments)
        if message not in f"{said.exception} {said.output}":
            wrong[arguments] = said.output
    assert wrong == {}
    said = CliRunner().invoke(app, ["fly", "track_target", "--mavlink-key", "key"])
    assert str(said.exception) == "--mavlink-key goes with --mavlink"


def test_a_bag_replaces_no_file_that_it_did_not_write(run: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"  # a bag of somebody else's, with a note
    mine.mkdir()
    for name in ("metadata.yaml", "mine_0.mcap", "notes.txt"):
        (mine / name).write_text(name)
    said = export(run, "--mcap", "--out", str(mine))
    assert str(said.exception) == f"{mine}: holds metadata.yaml, which no bag wrote; choose another folder or move it"
    assert {p.name: p.read_text() for p in mine.iterdir()} == {
        name: name for name in ("metadata.yaml", "mine_0.mcap", "notes.txt")
    }


def test_an_origin_or_a_key_that_is_none_is_named_and_the_key_is_not_told(tmp_path: Path) -> None:
    for text in ("here", "47", "1,2,3,4", "89,0", "47,8,nan", "47,8,1e9"):
        with pytest.raises(RunError, match=rf"^origin is '{text}', must be latitude,longitude or"):
            parse_origin(text)
    path = tmp_path / "key"
    for content in (b"", b"secret", b"00" * 31, b"zz" * 32, bytes(33), "ä".encode() * 20):
        path.write_bytes(content)
        with pytest.raises(RunError) as error:
            read_key(path)
        assert str(error.value) == f"{path}: no signing key, must hold 64 hexadecimal digits or 32 bytes"
    with pytest.raises(RunError, match=r"gone: No such file or directory$"):
        read_key(tmp_path / "gone")
