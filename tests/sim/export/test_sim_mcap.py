"""Bags: what two independent readers of MCAP find is what was flown."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from sim_examples import example
from typer.testing import CliRunner

import sortie.fleet.agent
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.messages.compact import Form
from sortie.fleet.messages.wire import decode_descriptor, decode_directive
from sortie.policies.contract import Descriptor
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.bag import write_bag
from sortie.sim.export.foxglove import layout
from sortie.sim.export.messages import descriptors
from sortie.sim.results import run_folder
from sortie.sim.results.flown_scene import houses, scene_of
from sortie.sim.results.link_traffic import LinkTraffic
from sortie.sim.results.outcome import outcome
from sortie.sim.results.palette import goodput_colours
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
        return run_sortie(example("duration_s=5", "perception.detector=surrogate", event)), sent


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
    return read_bag(path / "bag.mcap")


def read_bag(path: Path) -> Bag:
    found: Bag = defaultdict(list)
    with path.open("rb") as file:
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


def test_a_descriptor_in_a_smaller_form_has_what_its_peers_read_and_a_blind_station_no_footprint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[Descriptor] = []
    encode = sortie.fleet.agent.encode_compact

    def tapped(d: Descriptor, form: Form) -> bytes:
        data = encode(d, form)
        sent.append(decode_descriptor(data))
        return data

    monkeypatch.setattr(sortie.fleet.agent, "encode_compact", tapped)
    station = "fleet.ground=[{drone: 4, position_m: [0, -20, 3]}]"
    record = run_sortie(example("duration_s=1", "context.form=small", station))
    write_bag(record, tmp_path / "bag", BEGIN_NS)
    found = [m for _, m in read_bag(tmp_path / "bag" / "bag.mcap")["/fleet/context"]]
    assert len(found) == len(sent) == 50
    assert [m.agent_id for m in found] == [d.agent_id for d in sent]
    for m, theirs in zip(found, sent, strict=True):
        assert m.stamp.sec * 1_000_000_000 + m.stamp.nanosec == BEGIN_NS + theirs.stamp_ns
        assert list(m.peer_goodput) == [np.float32(v) for v in theirs.peer_goodput_mbps]
        assert m.battery == np.float32(theirs.battery_soc)
        assert bytes(m.coverage_grid) == theirs.coverage_grid
        assert (m.footprint_radius == 0.0) == (theirs.footprint_radius_m == 0.0) == (m.agent_id == 4)


def test_fields_come_out_as_the_record_has_them(bag: Bag, record: SortieRecord) -> None:
    row = [d for d in record.tables["descriptors"].to_pylist() if d["drone"] == 1][40]
    m = [m for _, m in bag["/fleet/context"] if m.agent_id == 1][40]
    assert (m.agent_id, m.task_phase) == (1, 2)
    assert m.stamp.sec * 1_000_000_000 + m.stamp.nanosec == BEGIN_NS + row["stamp_ns"]
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


def stamp_ns(stamp: Any) -> int:
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def test_every_stamp_agrees_with_the_log_s_time_and_time_never_steps_back(bag: Bag, path: Path) -> None:
    """Descriptors are stamped at the pose that they tell, which is up to a frame old when they are published."""
    for topic, messages in bag.items():
        for t_ns, m in messages:
            if topic == "/fleet/context":
                assert 0 <= t_ns - (stamp_ns(m.stamp) - BEGIN_NS) <= 100_000_000
            elif topic == "/clock":
                assert stamp_ns(m.clock) - BEGIN_NS == t_ns
            elif topic == "/decisions":
                assert stamp_ns(m.stamp) - BEGIN_NS == t_ns
            elif hasattr(m, "markers"):
                assert {stamp_ns(each.header.stamp) - BEGIN_NS for each in m.markers} == {t_ns}
            elif hasattr(m, "transforms"):
                assert stamp_ns(m.transforms[0].header.stamp) - BEGIN_NS == t_ns
            elif hasattr(m, "header"):
                assert stamp_ns(m.header.stamp) - BEGIN_NS == t_ns
    with (path / "bag.mcap").open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(times)


def test_the_clock_ticks_with_every_frame(bag: Bag, record: SortieRecord) -> None:
    frames = np.unique(record.tables["states"]["t_s"].to_numpy())
    assert [t_ns for t_ns, _ in bag["/clock"]] == [round(t_s * 1e9) for t_s in frames.tolist()]


def test_chunks_are_compressed(path: Path) -> None:
    with (path / "bag.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = summary.chunk_indexes
    assert {each.compression for each in chunks} == {"zstd"}
    assert sum(c.compressed_size for c in chunks) < 0.3 * sum(c.uncompressed_size for c in chunks)


def test_places_on_the_globe_and_the_loss_of_gnss(tmp_path: Path) -> None:
    """A degree of latitude is 111.2 km and one of longitude 75.5 km there."""
    lost = "events=[{kind: gnss_loss, at_s: 1, until_s: 2, drone: 1}]"
    record = run_sortie(example("duration_s=3", "perception.detector=none", lost))
    write_bag(record, tmp_path / "globe", BEGIN_NS, Origin(47.4, 8.5, 400.0))
    found = read_bag(tmp_path / "globe" / "globe.mcap")
    for drone, statuses in ((0, [0] * 30), (1, [0] * 10 + [-1] * 10 + [0] * 10)):
        fixes = [m for _, m in found[f"/drone_{drone}/fix"]]
        assert [m.status.status for m in fixes] == statuses
        states = [s for s in record.tables["states"].to_pylist() if s["drone"] == drone]
        for m, s in zip(fixes, states, strict=True):
            assert (m.latitude - 47.4) * 111_190 == pytest.approx(s["y_m"], abs=0.3)
            assert (m.longitude - 8.5) * 75_520 == pytest.approx(s["x_m"], abs=0.5)
            assert m.altitude == pytest.approx(400.0 + s["z_m"])


def test_the_scene_shows_cars_region_links_and_boxes(bag: Bag, record: SortieRecord) -> None:
    """Numbers of cars, discs, ends of links and detections are the record's; each message clears what was before it."""
    markers = {topic: [(t * 1e-9, m.markers) for t, m in found] for topic, found in bag.items() if "/scene" in topic}
    boxes = {i: [(t * 1e-9, m.markers) for t, m in bag[f"/drone_{i}/boxes"]] for i in range(5)}
    for each in (*markers.values(), *boxes.values()):
        assert all(first.action == 3 and all(m.action == 0 for m in rest) for _, (first, *rest) in each)
        assert all(len({m.id for m in rest}) == len(rest) for _, (_, *rest) in each)
        assert all(m.header.frame_id == "world" for _, all_of in each for m in all_of)
    ((town_s, town),) = markers["/scene/town"]
    scene = scene_of(record)
    parked, built = scene.parked_cars, houses(scene)
    assert (town_s, sum(m.ns == "parked" for m in town)) == (0.0, len(parked))
    assert [m.scale.z for m in town if m.ns == "buildings"] == pytest.approx(built[:, 4].tolist())
    first = next(m for m in town if m.ns == "parked")
    assert (first.pose.position.x, first.scale.x, first.scale.y) == (
        parked.x_m[0],
        parked.length_m[0],
        parked.width_m[0],
    )
    assert [round(t_s, 6) for t_s, _ in markers["/scene/cars"]] == [round(0.2 * k, 6) for k in range(25)]
    at_s, drawn = markers["/scene/mission"][20]
    row = next(r for r in record.tables["mission"].to_pylist() if r["t_s"] == pytest.approx(at_s))
    disc = next(m for m in drawn if m.type == 3)
    assert (disc.pose.position.x, disc.pose.position.y, disc.scale.x) == pytest.approx(
        (row["region_x_m"], row["region_y_m"], 2 * row["region_radius_m"])
    )
    target = next(m for m in drawn if m.ns == "target")
    assert (target.points[0].x, target.points[0].y) == pytest.approx((row["target_x_m"], row["target_y_m"]), abs=0.1)
    _, (_, links) = markers["/scene/links"][-1]
    assert len(links.points) == len(links.colors) == 2 * 5 * 4
    assert record.tables["detections"].num_rows > 100
    fused = Counter(record.tables["fusions"]["drone"].to_pylist())
    assert {i: len(each) for i, each in boxes.items()} == {i: fused[i] for i in range(5)}
    rows = [f for f in record.tables["fusions"].to_pylist() if f["drone"] == 2]
    for (_, (_, *each)), row in zip(boxes[2], rows, strict=True):
        assert sum(m.ns in ("found", "false") for m in each) == row["detections"]


def test_a_link_has_the_colour_of_its_own_direction_from_the_end_of_its_sender(bag: Bag, record: SortieRecord) -> None:
    states = record.tables["states"]
    t_s = states["t_s"].to_numpy()[::5]
    at_m = np.stack([states[name].to_numpy().reshape(-1, 5) for name in ("x_m", "y_m", "z_m")], axis=-1)
    tables = record.tables["descriptors"], record.tables["transmissions"]
    goodput, _ = LinkTraffic(5, record.scenario.context.rate_hz).add(t_s, *tables)
    stamp_ns, message = bag["/scene/links"][-1]
    (k,) = np.flatnonzero(np.isclose(t_s, stamp_ns * 1e-9))
    links = message.markers[1]
    ends = np.array([(p.x, p.y, p.z) for p in links.points])
    sender, receiver = np.linalg.norm(ends[:, None] - at_m[k], axis=-1).argmin(axis=1).reshape(-1, 2).T
    assert len(set(zip(sender.tolist(), receiver.tolist(), strict=True))) == 20
    colours = np.array([(c.r, c.g, c.b, c.a) for c in links.colors])[::2] * 255
    assert colours == pytest.approx(goodput_colours(goodput[k, sender, receiver]).astype(float), abs=0.01)
    assert not np.allclose(colours, goodput_colours(goodput[k, receiver, sender]))


def test_a_jammer_is_shown_while_it_is_on(tmp_path: Path) -> None:
    jam = "events=[{kind: jam, at_s: 1, until_s: 2, position_m: [10, 20, 5]}]"
    write_bag(run_sortie(example("duration_s=3", "perception.detector=none", jam)), tmp_path / "jam", BEGIN_NS)
    shown = [(t, m.markers) for t, m in read_bag(tmp_path / "jam" / "jam.mcap")["/scene/mission"]]
    on = [t * 1e-9 for t, markers in shown if any(m.ns == "jammer" for m in markers)]
    assert (on[0], on[-1], len(on)) == (1.0, 1.8, 5)


def test_the_boxes_of_a_drone_that_is_down_are_cleared(tmp_path: Path) -> None:
    down = "events=[{kind: drone_lost, at_s: 1, drone: 2}]"
    lost = run_sortie(example("duration_s=2", "perception.detector=surrogate", down))
    write_bag(lost, tmp_path / "lost", BEGIN_NS)
    shown = read_bag(tmp_path / "lost" / "lost.mcap")["/drone_2/boxes"]
    states = lost.tables["states"].to_pylist()
    down_s = next(s["t_s"] for s in states if s["drone"] == 2 and not s["airborne"])
    assert len(shown[-2][1].markers) > 1
    assert (shown[-1][0] * 1e-9, len(shown[-1][1].markers)) == (pytest.approx(down_s), 1)


def test_the_boxes_of_a_drone_that_waits_for_its_turn_are_cleared(tmp_path: Path) -> None:
    """Five drones, three at a time: at each scored moment the boxes of two are of an earlier time."""
    turns = run_sortie(example("duration_s=2.1", "perception.detector=surrogate", "perception.egos=3"))
    write_bag(turns, tmp_path / "turns", BEGIN_NS)
    bag = read_bag(tmp_path / "turns" / "turns.mcap")
    fusions = turns.tables["fusions"].to_pylist()
    scored = {drone: {f["t_s"] for f in fusions if f["drone"] == drone} for drone in range(5)}
    for drone, own_s in scored.items():
        shows = {round(t * 1e-9, 6): len(m.markers) > 1 for t, m in bag.get(f"/drone_{drone}/boxes", [])}
        last = False
        for t_s in sorted({f["t_s"] for f in fusions}):
            last = shows.get(round(t_s, 6), last)
            assert last == (t_s in own_s), (drone, t_s)


def test_the_layout_names_topics_of_the_bag_alone(bag: Bag, path: Path) -> None:
    made = json.loads((path / "foxglove_layout.json").read_text("utf-8"))
    assert made == layout(5)
    panels = made["configById"]
    named = {
        *panels["3D!fleet"]["topics"],
        *panels["map!fleet"]["topicColors"],
        panels["RosOut!decisions"]["topicToRender"],
    }
    named |= {each["value"].split(".")[0] for each in panels["Plot!battery"]["paths"]}
    assert named <= bag.keys()
    assert {f"/drone_{i}/fix" for i in range(5)} < named

    def ids(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else ids(node["first"]) | ids(node["second"])

    assert ids(made["layout"]) == panels.keys()


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
    for more in ([], ["--replace"]):  # a second one replaces the first
        said = CliRunner().invoke(app, ["export", str(run), "--mcap", "--begin", "2026-11-21T09:00:00+01:00", *more])
        assert said.exit_code == 0, said.output
    assert sorted(p.name for p in (run / "bag").iterdir()) == ["bag.mcap", "foxglove_layout.json", "metadata.yaml"]
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


def test_a_bag_replaces_no_file_that_it_did_not_write(record: SortieRecord, tmp_path: Path) -> None:
    run_folder.save(record, tmp_path / "run")
    mine = tmp_path / "mine"  # a bag of somebody else's, with a note
    mine.mkdir()
    for name in ("metadata.yaml", "mine_0.mcap", "notes.txt"):
        (mine / name).write_text(name)
    said = CliRunner().invoke(app, ["export", str(tmp_path / "run"), "--mcap", "--out", str(mine)])
    assert str(said.exception) == f"{mine}: holds metadata.yaml, which no bag wrote; choose another folder or move it"
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
        (["--mcap", "--out", "."], r": is the working folder or holds it, a bag would replace it"),
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
