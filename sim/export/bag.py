"""A sortie as a ROS 2 bag: context and directives byte for byte as a fleet would send them, and what viewers need beside.

| topic | type | QoS |
|---|---|---|
| `/fleet/context` | `sortie_msgs/msg/ContextDescriptor` | best effort, keep last 1 |
| `/drone_0/to_drone_1/directive` | `sortie_msgs/msg/DataPlaneDirective` | reliable, keep last 1 |
| `/drone_0/pose`, `/tf` | `geometry_msgs/msg/PoseStamped`, `tf2_msgs/msg/TFMessage` | reliable, keep last 10 |
| `/drone_0/battery` | `sensor_msgs/msg/BatteryState` | reliable, keep last 10 |
| `/decisions` | `rcl_interfaces/msg/Log` | reliable, keep last 100 |

The frame `world` is ENU in metres, `drone_0` its body in FLU. The plane's topics are the live bus's (`sortie.sim.export.topics`). The
record holds no estimated pose, so a descriptor's is the true one here.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from sortie.fleet.messages.wire import (
    DESCRIPTOR_MSG,
    DESCRIPTOR_NAME,
    DIRECTIVE_MSG,
    DIRECTIVE_NAME,
    encode_descriptor,
    encode_directive,
)
from sortie.sim.export.messages import descriptors, directives
from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.folders import replacing
from sortie.sim.results.outcome import transitions
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.sentences import decision_in_words, event_in_words

POSE, TF, BATTERY, LOG = (
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/BatteryState",
    "rcl_interfaces/msg/Log",
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


def write_bag(record: SortieRecord, path: Path, begin_ns: int) -> dict[str, int]:
    """Write a bag (a folder with metadata.yaml and one .mcap file); there whole or not at all.

    Args:
        record: the sortie.
        path: the bag's folder; an older one there is replaced.
        begin_ns: when the sortie is said to have begun, ns since 1970.

    Returns:
        How many messages each topic has.

    Raises:
        RunError: the disk refuses.
        ImportError: rosbags is not installed (extra `ros2`).
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(DESCRIPTOR_MSG, DESCRIPTOR_NAME))
    store.register(get_types_from_msg(DIRECTIVE_MSG, DIRECTIVE_NAME))
    messages = sorted(_messages(record, _makers(store.types), begin_ns), key=lambda m: m.t_s)
    counts: dict[str, int] = {}
    with replacing(path) as partial:
        folder = partial / path.name
        with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics: dict[str, Any] = {}
            for m in messages:
                if m.topic not in topics:
                    qos = [_qos(m.type)]
                    topics[m.topic] = writer.add_connection(m.topic, m.type, typestore=store, offered_qos_profiles=qos)
                data = m.value if isinstance(m.value, bytes) else store.serialize_cdr(m.value, m.type)
                writer.write(topics[m.topic], begin_ns + round(m.t_s * 1e9), data)
                counts[m.topic] = counts.get(m.topic, 0) + 1
        for file in folder.iterdir():
            file.rename(partial / file.name)
        folder.rmdir()
    return counts


def _qos(type_: str) -> Any:
    """The QoS profile that a topic of this type offers."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    depth = {DESCRIPTOR_NAME: 1, DIRECTIVE_NAME: 1, LOG: 100}.get(type_, 10)
    reliability = QosReliability.BEST_EFFORT if type_ == DESCRIPTOR_NAME else QosReliability.RELIABLE
    ever = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST, depth, reliability, QosDurability.VOLATILE, ever, ever, QosLiveliness.AUTOMATIC, ever, False
    )  # fmt: skip


def _makers(types: Any) -> SimpleNamespace:
    """The message classes by their short names."""
    names = (
        "builtin_interfaces/msg/Time", "std_msgs/msg/Header", "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion",
        "geometry_msgs/msg/Vector3", "geometry_msgs/msg/Pose", "geometry_msgs/msg/Transform",
        "geometry_msgs/msg/TransformStamped", POSE, TF, BATTERY, LOG,
    )  # fmt: skip
    return SimpleNamespace(**{name.rsplit("/", 1)[1]: types[name] for name in names})


def _messages(record: SortieRecord, make: SimpleNamespace, begin_ns: int) -> Iterator[Message]:
    for t_s, d in descriptors(record):
        yield Message(t_s, CONTEXT.name, DESCRIPTOR_NAME, encode_descriptor(d))
    for t_s, order in directives(record):
        topic = Topic(TopicKind.DIRECTIVE, order.source, order.destination)
        yield Message(t_s, topic.name, DIRECTIVE_NAME, encode_directive(order))

    def header(t_s: float, frame: str) -> Any:
        return make.Header(_time(t_s), frame)

    def _time(t_s: float) -> Any:
        return make.Time(*divmod(begin_ns + round(t_s * 1e9), 1_000_000_000))

    for row in record.tables["states"].to_pylist():
        t_s, name = row["t_s"], f"drone_{row['drone']}"
        x, y, z = row["x_m"], row["y_m"], row["z_m"]
        turn = make.Quaternion(*(row[q] for q in ("qx", "qy", "qz", "qw")))
        yield Message(
            t_s, f"/{name}/pose", POSE, make.PoseStamped(header(t_s, "world"), make.Pose(make.Point(x, y, z), turn))
        )
        moved = make.Transform(make.Vector3(x, y, z), turn)
        yield Message(
            t_s, "/tf", TF, make.TFMessage([make.TransformStamped(header(t_s, "world"), name, moved)])
        )  # fmt: skip
        yield Message(t_s, f"/{name}/battery", BATTERY, _battery(make, header(t_s, name), row))
    for t_s, level, who, text in _log(record):
        yield Message(t_s, "/decisions", LOG, make.Log(_time(t_s), level, who, text, "", "", 0))


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
    for change in transitions(record.tables["directives"], {}):
        yield change["t_s"], INFO, f"drone_{change['drone']}", decision_in_words(change)
    for row in record.tables["events"].to_pylist():
        yield row["t_s"], WARN, "fleet" if row["drone"] < 0 else f"drone_{row['drone']}", event_in_words(row)
