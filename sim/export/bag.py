"""A sortie as a ROS 2 bag: descriptors, directives, and what viewers need beside.

| topic | type | QoS |
|---|---|---|
| `/fleet/context` | `sortie_msgs/msg/ContextDescriptor` | best effort, keep last 1 |
| `/drone_0/to_drone_1/directive` | `sortie_msgs/msg/DataPlaneDirective` | reliable, keep last 1 |
| `/drone_0/pose`, `/tf` | `geometry_msgs/msg/PoseStamped`, `tf2_msgs/msg/TFMessage` | reliable, keep last 10 |
| `/drone_0/fix` | `sensor_msgs/msg/NavSatFix` | reliable, keep last 10 |
| `/drone_0/battery` | `sensor_msgs/msg/BatteryState` | reliable, keep last 10 |
| `/decisions` | `rcl_interfaces/msg/Log` | reliable, keep last 100 |
| `/clock` | `rosgraph_msgs/msg/Clock` | reliable, keep last 10 |
| `/scene/…`, `/drone_0/boxes` | `visualization_msgs/msg/MarkerArray` (`sortie.sim.export.scene_markers`) | reliable, keep last 10; `/scene/town` stays for late readers |

The frame `world` is ENU in metres, `drone_0` its body in FLU. A drone that is not in the air is on the ground. The plane's
topics are the live bus's (`sortie.sim.export.topics`). The record holds no estimated pose, so a descriptor's is the true one
here. All stamps count from the begin of the bag, also those that drones put into descriptors by their own clocks, which may be
wrong. Descriptors are in the paper's form (CDR), without the code of `context.authentication`; where `context.form` is another
one, their values are those that peers read from it. The bag is compressed (zstd, in chunks).
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator
from operator import attrgetter, itemgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from sortie.fleet.logs.geodesy import Origin, geodetic
from sortie.fleet.messages.compact import FULL, Form, decode_compact, encode_compact
from sortie.fleet.messages.wire import (
    DESCRIPTOR_MSG,
    DESCRIPTOR_NAME,
    DIRECTIVE_MSG,
    DIRECTIVE_NAME,
    encode_descriptor,
    encode_directive,
)
from sortie.policies.contract import Descriptor
from sortie.sim.export.foxglove import LAYOUT, layout
from sortie.sim.export.messages import descriptors, directives
from sortie.sim.export.origin import origin_of
from sortie.sim.export.scene_markers import MARKERS, TOWN, SceneMarkers, Timed
from sortie.sim.export.telemeter import Telemeter
from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.folders import writing
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.sentences import decision_in_words, event_in_words
from sortie.sim.results.transitions import transitions

POSE, TF, BATTERY, LOG, FIX, CLOCK = (
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/BatteryState",
    "rcl_interfaces/msg/Log",
    "sensor_msgs/msg/NavSatFix",
    "rosgraph_msgs/msg/Clock",
)
INFO, WARN = 20, 30
"""Levels of rcl_interfaces/msg/Log."""
_UNKNOWN = float("nan")


class Message(NamedTuple):
    """One message of the bag; `value` is CDR already, or a message that the bag's writer serialises."""

    t_s: float
    topic: str
    type: str
    value: bytes | Any


def write_bag(record: SortieRecord, path: Path, begin_ns: int, origin: Origin | None = None) -> dict[str, int]:
    """Write a bag (a folder with metadata.yaml, one .mcap file and a layout for Foxglove); there whole or not at all.

    Args:
        record: the sortie.
        path: the bag's folder; an older one there is replaced.
        begin_ns: when the sortie is said to have begun, ns since 1970.
        origin: where on the globe ENU (0, 0, 0) lies; None: as in `sortie.sim.export.origin.origin_of`.

    Returns:
        How many messages each topic has.

    Raises:
        RunError: the disk refuses.
        TraceError: its trace is needed for the origin and cannot be read.
        ImportError: rosbags is not installed (extra `ros2`).
    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(DESCRIPTOR_MSG, DESCRIPTOR_NAME))
    store.register(get_types_from_msg(DIRECTIVE_MSG, DIRECTIVE_NAME))
    origin = origin_of(record.scenario.fleet) if origin is None else origin
    streams = _streams(record, _makers(store.types), begin_ns, origin)
    counts: dict[str, int] = {}
    with writing(path) as partial:
        partial.mkdir()
        folder = partial / path.name
        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            topics: dict[str, Any] = {}
            for m in heapq.merge(*streams, key=attrgetter("t_s")):
                if m.topic not in topics:
                    qos = [_qos(m.type, stays=m.topic == TOWN)]
                    topics[m.topic] = writer.add_connection(m.topic, m.type, typestore=store, offered_qos_profiles=qos)
                data = m.value if isinstance(m.value, bytes) else store.serialize_cdr(m.value, m.type)
                writer.write(topics[m.topic], begin_ns + round(m.t_s * 1e9), data)
                counts[m.topic] = counts.get(m.topic, 0) + 1
        for file in folder.iterdir():
            file.rename(partial / file.name)
        folder.rmdir()
        (partial / LAYOUT).write_text(json.dumps(layout(record.scenario.fleet.drones), indent=2) + "\n", "utf-8")
    return counts


def _qos(type_: str, *, stays: bool) -> Any:
    """The QoS profile that a topic of this type offers; what stays is kept for late readers."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    depth = {DESCRIPTOR_NAME: 1, DIRECTIVE_NAME: 1, LOG: 100}.get(type_, 10)
    reliability = QosReliability.BEST_EFFORT if type_ == DESCRIPTOR_NAME else QosReliability.RELIABLE
    durability = QosDurability.TRANSIENT_LOCAL if stays else QosDurability.VOLATILE
    ever = QosTime(9223372036, 854775807)
    return Qos(QosHistory.KEEP_LAST, depth, reliability, durability, ever, ever, QosLiveliness.AUTOMATIC, ever, False)


def _makers(types: Any) -> SimpleNamespace:
    """The message classes by their short names."""
    names = (
        "builtin_interfaces/msg/Duration",
        "builtin_interfaces/msg/Time",
        "geometry_msgs/msg/Point",
        "geometry_msgs/msg/Pose",
        "geometry_msgs/msg/Quaternion",
        "geometry_msgs/msg/Transform",
        "geometry_msgs/msg/TransformStamped",
        "geometry_msgs/msg/Vector3",
        "sensor_msgs/msg/CompressedImage",
        "sensor_msgs/msg/NavSatStatus",
        "std_msgs/msg/ColorRGBA",
        "std_msgs/msg/Header",
        "visualization_msgs/msg/Marker",
        "visualization_msgs/msg/MeshFile",
        POSE,
        TF,
        BATTERY,
        LOG,
        FIX,
        CLOCK,
        MARKERS,
    )
    return SimpleNamespace(**{name.rsplit("/", 1)[1]: types[name] for name in names})


def _streams(record: SortieRecord, make: SimpleNamespace, begin_ns: int, origin: Origin) -> list[Iterator[Message]]:
    """The messages, in streams that are in order of time each."""

    def drawn(stream: Iterator[Timed]) -> Iterator[Message]:
        return (Message(t_s, topic, MARKERS, value) for t_s, topic, value in stream)

    scene = SceneMarkers(record, make, begin_ns).messages()
    return [_plane(record, begin_ns), _flight(record, make, begin_ns, origin), *map(drawn, scene)]


def _plane(record: SortieRecord, begin_ns: int) -> Iterator[Message]:
    """Descriptors, as peers read them, and directives, with the stamps of a flight that began then."""
    form = Form(**record.scenario.context.form.model_dump())

    def message(t_s: float, d: Descriptor) -> Message:
        read = d if form == FULL else decode_compact(encode_compact(d, form))
        data = encode_descriptor(read._replace(stamp_ns=begin_ns + read.stamp_ns))
        return Message(t_s, CONTEXT.name, DESCRIPTOR_NAME, data)

    said = (message(t_s, d) for t_s, d in descriptors(record))
    ordered = (
        Message(t_s, Topic(TopicKind.DIRECTIVE, d.source, d.destination).name, DIRECTIVE_NAME, encode_directive(d))
        for t_s, d in directives(record)
    )
    return heapq.merge(said, ordered, key=attrgetter("t_s"))


def _flight(record: SortieRecord, make: SimpleNamespace, begin_ns: int, origin: Origin) -> Iterator[Message]:
    """The clock, what each drone does in each frame, and the log."""

    def header(t_s: float, frame: str) -> Any:
        return make.Header(_time(t_s), frame)

    def _time(t_s: float) -> Any:
        return make.Time(*divmod(begin_ns + round(t_s * 1e9), 1_000_000_000))

    def states() -> Iterator[Message]:
        told = (state for _, state in Telemeter(record.scenario).add(record.tables))
        last_s = -1.0
        for row, state in zip(record.tables["states"].to_pylist(), told, strict=True):
            t_s, name = row["t_s"], f"drone_{row['drone']}"
            if t_s > last_s:
                yield Message(t_s, "/clock", CLOCK, make.Clock(_time(t_s)))
                last_s = t_s
            x, y, z = state.position_m
            turn = make.Quaternion(*(row[q] for q in ("qx", "qy", "qz", "qw")))
            pose = make.Pose(make.Point(x, y, z), turn)
            yield Message(t_s, f"/{name}/pose", POSE, make.PoseStamped(header(t_s, "world"), pose))
            moved = make.TransformStamped(header(t_s, "world"), name, make.Transform(make.Vector3(x, y, z), turn))
            yield Message(t_s, "/tf", TF, make.TFMessage([moved]))
            fix = make.NavSatFix(
                header(t_s, name),
                make.NavSatStatus(0 if state.fixed else -1, 1),
                *geodetic(state.position_m, origin),
                np.zeros(9),
                0,
            )
            yield Message(t_s, f"/{name}/fix", FIX, fix)
            yield Message(t_s, f"/{name}/battery", BATTERY, _battery(make, header(t_s, name), row))

    log = (
        Message(t_s, "/decisions", LOG, make.Log(_time(t_s), level, who, text, "", "", 0))
        for t_s, level, who, text in _log(record)
    )
    return heapq.merge(states(), log, key=attrgetter("t_s"))


def _battery(make: SimpleNamespace, header: Any, row: dict[str, Any]) -> Any:
    """sensor_msgs/msg/BatteryState of a row of `states`; discharge is negative there, and what is unknown is NaN."""
    empty = np.zeros(0, np.float32)
    return make.BatteryState(
        header=header,
        voltage=row["voltage_v"],
        temperature=_UNKNOWN,
        current=-row["current_a"],
        charge=_UNKNOWN,
        capacity=_UNKNOWN,
        design_capacity=_UNKNOWN,
        percentage=row["soc"],
        power_supply_status=2,  # discharging
        power_supply_health=1,  # good
        power_supply_technology=3,  # LiPo
        present=True,
        cell_voltage=empty,
        cell_temperature=empty,
        location="",
        serial_number="",
    )


def _log(record: SortieRecord) -> Iterator[tuple[float, int, str, str]]:
    """What was decided and what happened, in words."""
    decided = (
        (change["t_s"], INFO, f"drone_{change['drone']}", decision_in_words(change))
        for change in transitions(record.tables["directives"], {})
    )
    happened = (
        (row["t_s"], WARN, "fleet" if row["drone"] < 0 else f"drone_{row['drone']}", event_in_words(row))
        for row in record.tables["events"].to_pylist()
    )
    return heapq.merge(decided, happened, key=itemgetter(0))
