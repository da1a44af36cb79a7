"""Bags: what two independent readers of MCAP find is what was flown."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from sim_examples import example
from typer.testing import CliRunner

import sortie.fleet.agent
from sortie.fleet.messages.wire import decode_descriptor, decode_directive
from sortie.policies.contract import Descriptor
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.bag import write_bag
from sortie.sim.export.messages import descriptors
from sortie.sim.results import run_folder
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.sentences import decision_in_words

BEGIN_NS = 1_767_225_600_000_000_000
Bag = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def flown() -> tuple[SortieRecord, list[tuple[float, bytes]]]:
    """A sortie of five seconds with an event, and the descriptors as they really went on the air."""
    sent: list[tuple[float, bytes]] = []
    with pytest.MonkeyPatch.context() as patch:
        encode = sortie.fleet.agent.encode_descriptor

        def tapped(d: Descriptor) -> bytes:
            data = encode(d)
            sent.append((d.stamp_ns * 1e-9, data))
            return data

        patch.setattr(sortie.fleet.agent, "encode_descriptor", tapped)
        event = "events=[{kind: link_drop, at_s: 3.5, drone: 2, loss_db: 60}]"
        return run_sortie(example("duration_s=5", event)), sent


@pytest.fixture(scope="module")
def record(flown: tuple[SortieRecord, Any]) -> SortieRecord:
    return flown[0]


@pytest.fixture(scope="module")
def path(record: SortieRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "bag"
    write_bag(record, path, BEGIN_NS)
    return path


@pytest.fixture(scope="module")
def bag(path: Path) -> Bag:
    """Read by mcap-ros2-support, from the schemas inside the file alone."""
    found: Bag = defaultdict(list)
    with (path / "bag.mcap").open("rb") as file:
        for _, channel, m, decoded in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found[channel.topic].append((m.log_time - BEGIN_NS, decoded))
    return found


def test_the_reader_finds_every_message_of_the_record(bag: Bag, record: SortieRecord) -> None:
    tables = record.tables
    counts = {topic: len(messages) for topic, messages in bag.items()}
    poses = Counter(tables["states"]["drone"].to_pylist())
    assert {d: counts[f"/drone_{d}/pose"] for d in poses} == poses
    said = Counter(tables["descriptors"]["drone"].to_pylist())
    assert Counter(m.agent_id for _, m in bag["/fleet/context"]) == said
    links = Counter(zip(*(tables["directives"][k].to_pylist() for k in ("drone", "peer")), strict=True))
    assert {link: counts["/drone_{}/to_drone_{}/directive".format(*link)] for link in links} == links
    assert counts["/tf"] == tables["states"].num_rows
    times = [t_ns for t_ns, m in bag["/fleet/context"] if m.agent_id == 2]
    expected = [d["t_s"] for d in tables["descriptors"].to_pylist() if d["drone"] == 2]
    assert [t * 1e-9 for t in times] == pytest.approx(expected, abs=1e-9)


def test_a_descriptor_is_the_one_that_was_sent_but_for_where_the_drone_thought_it_was(
    flown: tuple[SortieRecord, list[tuple[float, bytes]]],
) -> None:
    """Against the bytes on the air: all fields equal, the pose within the GNSS error."""
    record, sent = flown
    remade = [d for _, d in descriptors(record)]
    assert len(remade) == len(sent) == 250
    for ours, (_, data) in zip(remade, sent, strict=True):
        theirs = decode_descriptor(data)
        assert ours.position_m == pytest.approx(theirs.position_m, abs=12.0)
        assert ours.velocity_mps == pytest.approx(theirs.velocity_mps, abs=1.0)
        assert ours.orientation_xyzw == pytest.approx(theirs.orientation_xyzw, abs=0.2)
        known = {"position_m", "velocity_mps", "orientation_xyzw", "footprint_radius_m"}
        for name in set(Descriptor._fields) - known:
            a, b = getattr(ours, name), getattr(theirs, name)
            close = isinstance(b, float) or (isinstance(b, tuple) and b and isinstance(b[0], float))
            assert a == (pytest.approx(b, rel=1e-6) if close else b), name
        assert ours.footprint_radius_m == pytest.approx(theirs.footprint_radius_m, rel=0.05)
    assert any(d.priority_target_ids for d in remade)


def test_fields_come_out_as_the_record_has_them(bag: Bag, record: SortieRecord) -> None:
    row = [d for d in record.tables["descriptors"].to_pylist() if d["drone"] == 1][40]
    m = [m for _, m in bag["/fleet/context"] if m.agent_id == 1][40]
    assert (m.agent_id, m.task_phase, m.stamp.sec * 1_000_000_000 + m.stamp.nanosec) == (1, 2, row["stamp_ns"])
    assert list(m.peer_goodput) == pytest.approx(row["goodput_mbps"], rel=1e-6)
    assert list(m.region) == pytest.approx([row["region_x_m"], row["region_y_m"], 32.0, 1.0], rel=1e-6)
    assert bytes(m.coverage_grid) == row["coverage_grid"]
    order = [d for d in record.tables["directives"].to_pylist() if d["drone"] == 1][-1]
    _, m = bag[f"/drone_1/to_drone_{order['peer']}/directive"][-1]
    assert (m.source, m.destination, m.rate) == (1, order["peer"], pytest.approx(order["rate_hz"]))
    state = [s for s in record.tables["states"].to_pylist() if s["drone"] == 3][7]
    _, pose = bag["/drone_3/pose"][7]
    assert pose.header.frame_id == "world"
    at, turn = pose.pose.position, pose.pose.orientation
    assert (at.x, at.y, at.z) == (state["x_m"], state["y_m"], state["z_m"])
    assert (turn.x, turn.y, turn.z, turn.w) == tuple(state[q] for q in ("qx", "qy", "qz", "qw"))
    assert pose.header.stamp.sec * 1_000_000_000 + pose.header.stamp.nanosec == BEGIN_NS + round(state["t_s"] * 1e9)
    _, battery = bag["/drone_3/battery"][7]
    assert battery.percentage == pytest.approx(state["soc"])
    assert battery.current == pytest.approx(-state["current_a"])


def test_the_log_is_the_decisions_in_words(bag: Bag, record: SortieRecord) -> None:
    said = [m.msg for _, m in bag["/decisions"] if m.level == 20]
    assert said == [decision_in_words(t) for t in outcome(record)["transitions"]]
    assert [(t_ns, m.name, m.msg) for t_ns, m in bag["/decisions"] if m.level == 30] == [
        (3_500_000_000, "drone_2", "drone 2: links of 2 lose 60 dB")
    ]


def test_as_a_folder_it_is_a_bag_of_ros_2_with_the_paper_s_qos(path: Path, record: SortieRecord) -> None:
    """Read by rosbags from metadata.yaml, as `ros2 bag` would; payload bytes decode by the fleet's own strict rules."""
    with AnyReader([path]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
        for topic, expected in (
            ("/fleet/context", ("BEST_EFFORT", 1)),
            ("/drone_0/to_drone_1/directive", ("RELIABLE", 1)),
        ):
            assert (offered[topic].reliability.name, offered[topic].depth) == expected
        sizes = set()
        for connection, _, data in reader.messages():
            if connection.topic.endswith("/context"):
                sizes.add(len(data))
                assert 0 <= decode_descriptor(data).agent_id < 5
            elif connection.topic.endswith("/directive"):
                assert len(data) == 36
                order = decode_directive(data)
                assert connection.topic == f"/drone_{order.source}/to_drone_{order.destination}/directive"
        assert sizes <= {180, 182}  # one priority target more is two bytes
        assert 180 in sizes


def test_the_messages_build_as_a_ros_2_package() -> None:
    package = files("sortie.fleet") / "sortie_msgs"
    listed = re.findall(r'"(msg/\w+\.msg)"', (package / "CMakeLists.txt").read_text("utf-8"))
    assert listed == ["msg/ContextDescriptor.msg", "msg/DataPlaneDirective.msg"]
    assert all((package / name).is_file() for name in listed)
    assert "<name>sortie_msgs</name>" in (package / "package.xml").read_text("utf-8")


def test_the_command_writes_the_bag_into_the_run(record: SortieRecord, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run_folder.save(record, run)
    for _ in range(2):  # a second one replaces the first
        said = CliRunner().invoke(app, ["export", str(run), "--mcap", "--begin", "2026-11-21T09:00:00+01:00"])
        assert said.exit_code == 0, said.output
    assert sorted(p.name for p in (run / "bag").iterdir()) == ["bag.mcap", "metadata.yaml"]
    with (run / "bag" / "bag.mcap").open("rb") as file:
        _, _, first = next(iter(make_reader(file).iter_messages()))
    assert first.log_time == 1_795_248_000_000_000_000  # 2026-11-21 08:00 UTC


def test_a_bag_begins_at_a_fraction_of_a_second_too(record: SortieRecord, tmp_path: Path) -> None:
    run_folder.save(record, tmp_path / "run")
    arguments = ["export", str(tmp_path / "run"), "--mcap", "--begin", "2026-11-21T08:00:00.25"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    with (tmp_path / "run" / "bag" / "bag.mcap").open("rb") as file:
        _, _, first = next(iter(make_reader(file).iter_messages()))
    assert first.log_time == 1_795_248_000_250_000_000


def test_a_bag_may_be_the_folder_one_stands_in(
    record: SortieRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_folder.save(record, tmp_path / "run")
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    said = CliRunner().invoke(app, ["export", str(tmp_path / "run"), "--mcap", "--out", "."])
    assert said.exit_code == 0, said.exception
    assert sorted(p.name for p in here.iterdir()) == ["here.mcap", "metadata.yaml"]


def test_a_bag_replaces_no_file_that_it_did_not_write(record: SortieRecord, tmp_path: Path) -> None:
    run_folder.save(record, tmp_path / "run")
    mine = tmp_path / "mine"  # a bag of somebody else's, with a note
    mine.mkdir()
    for name in ("metadata.yaml", "mine_0.mcap", "notes.txt"):
        (mine / name).write_text(name)
    said = CliRunner().invoke(app, ["export", str(tmp_path / "run"), "--mcap", "--out", str(mine)])
    assert str(said.exception) == (
        f"{mine}: holds mine_0.mcap and 1 more, which no bag wrote; choose another folder or move it"
    )
    assert {p.name: p.read_text() for p in mine.iterdir()} == {
        name: name for name in ("metadata.yaml", "mine_0.mcap", "notes.txt")
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--mcap", "--begin", "noon"], r"begin is 'noon', must be a time as in 2026-01-01T00:00:00"),
        (["--mcap", "--begin", "1960-01-01"], r"begin is '1960-01-01', must lie from 1970 to before 2038"),
        (["--mcap", "--begin", "2050-01-01"], r"begin is '2050-01-01', must lie from 1970 to before 2038"),
        (["--tlog", "--begin", "1960-01-01"], r"begin is '1960-01-01', must lie from 1970 to before 2096"),
        (["--mcap", "--out", "."], r"holds files but no metadata\.yaml"),
    ],
)
def test_what_a_user_gets_wrong_is_named(
    arguments: list[str], message: str, record: SortieRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_folder.save(record, tmp_path / "run")
    said = CliRunner().invoke(app, ["export", "run", *arguments])
    assert re.search(message, str(said.exception))
    assert CliRunner().invoke(app, ["export", "run"]).exit_code == 2  # no format named


def test_a_descriptor_names_the_target_of_its_drones_group() -> None:
    record = run_sortie(
        example(
            "mission.more_targets=[{waypoints_m: [[-60, 8], [200, 8]]}]",
            "mission.groups=[{drones: [1, 2], phases: [{phase: track, target: 1, region: {radius_m: 30}}]}]",
        )
    )
    named = {(d.agent_id in (1, 2), d.priority_target_ids) for _, d in descriptors(record) if d.priority_target_ids}
    assert named == {(True, (1,)), (False, (0,))}
