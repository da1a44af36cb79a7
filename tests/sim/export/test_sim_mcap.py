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
from exported_flight import flown
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from sortie.fleet.messages.wire import decode_descriptor, decode_directive
from sortie.sim.export.bag import write_bag
from sortie.sim.export.foxglove import layout
from sortie.sim.results.flown_scene import houses, scene_of
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.sentences import decision_in_words

BEGIN_NS = 1_767_225_600_000_000_000
Bag = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    return flown()[0]


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


def test_the_log_is_the_decisions_in_words(bag: Bag, record: SortieRecord) -> None:
    said = [m.msg for _, m in bag["/decisions"] if m.level == 20]
    assert said == [decision_in_words(t) for t in outcome(record)["transitions"]]


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


def test_the_scene_shows_cars_region_links_and_boxes(bag: Bag, record: SortieRecord) -> None:
    """Each message clears what was before it; numbers of cars, houses and detections are the record's."""
    markers = {topic: [(t * 1e-9, m.markers) for t, m in found] for topic, found in bag.items() if "/scene" in topic}
    boxes = {i: [(t * 1e-9, m.markers) for t, m in bag[f"/drone_{i}/boxes"]] for i in range(5)}
    for each in (*markers.values(), *boxes.values()):
        assert all(first.action == 3 and all(m.action == 0 for m in rest) for _, (first, *rest) in each)
        assert all(len({m.id for m in rest}) == len(rest) for _, (_, *rest) in each)
        assert all(m.header.frame_id == "world" for _, all_of in each for m in all_of)
    ((town_s, town),) = markers["/scene/town"]
    scene = scene_of(record)
    assert (town_s, sum(m.ns == "parked" for m in town)) == (0.0, len(scene.parked_cars))
    assert [m.scale.z for m in town if m.ns == "buildings"] == pytest.approx(houses(scene)[:, 4].tolist())
    assert [round(t_s, 6) for t_s, _ in markers["/scene/cars"]] == [round(0.2 * k, 6) for k in range(25)]
    _, (_, links) = markers["/scene/links"][0]
    assert len(links.points) == len(links.colors) == 2 * 5 * 4
    assert record.tables["detections"].num_rows > 100
    rows = [f for f in record.tables["fusions"].to_pylist() if f["drone"] == 2]
    for (_, (_, *each)), row in zip(boxes[2], rows, strict=True):
        assert sum(m.ns in ("found", "false") for m in each) == row["detections"]


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
