"""A DDS peer of its own making: types written by hand as rosidl makes them, this project not imported.

    python dds_peer.py DOMAIN

Joins as drone 9: publishes contexts at 10 Hz, and some that cannot be, until it has received five payloads. It listens
on until its input ends, and prints what it heard as one JSON object.
"""

import json
import select
import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, int32, sequence, uint8, uint16, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

ME = 9
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)
BEST_EFFORT = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(50), CDR)
RELIABLE = Qos(Policy.Reliability.Reliable(max_blocking_time=0), Policy.History.KeepLast(50), CDR)


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Context(IdlStruct, typename="sortie_msgs::msg::dds_::ContextDescriptor_"):
    stamp: Time
    agent_id: uint8
    position: array[float32, 3]
    orientation: array[float32, 4]
    velocity: array[float32, 3]
    footprint_radius: float32
    battery: float32
    cpu_headroom: float32
    gpu_headroom: float32
    peer_goodput: sequence[float32]
    coverage_grid: array[uint8, 64]
    novelty_flags: uint8
    task_phase: uint8
    region: array[float32, 4]
    priority_target_ids: sequence[uint16]


@dataclass
class Directive(IdlStruct, typename="sortie_msgs::msg::dds_::DataPlaneDirective_"):
    source: uint8
    destination: uint8
    representation: uint8
    duty_percent: uint8
    roi: array[float32, 3]
    rho: float32
    rate: float32
    deadline: float32
    fusion_weight: float32


@dataclass
class Dimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    label: str
    size: uint32
    stride: uint32


@dataclass
class Layout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    dim: sequence[Dimension]
    data_offset: uint32


@dataclass
class Bytes(IdlStruct, typename="std_msgs::msg::dds_::UInt8MultiArray_"):
    layout: Layout
    data: sequence[uint8]


def context(agent_id: int, now_ns: int) -> Context:
    """A drone at (5, 5, 60) that sees everything well and has half its charge."""
    return Context(
        stamp=Time(*divmod(now_ns, 1_000_000_000)),
        agent_id=agent_id,
        position=[5.0, 5.0, 60.0],
        orientation=[0.0, 0.0, 0.0, 1.0],
        velocity=[1.0, 0.0, 0.0],
        footprint_radius=42.0,
        battery=0.5,
        cpu_headroom=1.0,
        gpu_headroom=1.0,
        peer_goodput=[50.0] * 9,
        coverage_grid=[0b10101010] * 64,
        novelty_flags=0,
        task_phase=1,
        region=[0.0, 0.0, 0.0, 0.0],
        priority_target_ids=[7],
    )


def say(text: str) -> None:
    """A line to whoever started this."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> None:
    me = DomainParticipant(int(sys.argv[1]))
    fleet = Topic(me, "rt/fleet/context", Context)
    speak, hear = DataWriter(me, fleet, qos=BEST_EFFORT), DataReader(me, fleet, qos=BEST_EFFORT)
    orders = DataReader(me, Topic(me, f"rt/drone_0/to_drone_{ME}/directive", Directive), qos=RELIABLE)
    payloads = DataReader(me, Topic(me, f"rt/drone_0/to_drone_{ME}/features", Bytes), qos=BEST_EFFORT)
    contexts: Counter[int] = Counter()
    last: dict[int, Context] = {}
    directives: list[Directive] = []
    sizes: list[int] = []
    say("listening")
    over = False
    while not over:
        over = bool(select.select([sys.stdin], [], [], 0.1)[0])
        for c in hear.take(50):
            if isinstance(c, Context) and c.agent_id != ME and c.agent_id != 255:
                contexts[c.agent_id] += 1
                last[c.agent_id] = c
        directives += [d for d in orders.take(50) if isinstance(d, Directive)]
        sizes += [len(p.data) for p in payloads.take(50) if isinstance(p, Bytes)]
        if last and len(sizes) < 5:
            speak.write(context(ME, time.time_ns()))
            speak.write(context(255, time.time_ns()))  # no drone has this number
    heard = {
        "contexts": contexts,
        "last": {i: {k: list(v) if k == "coverage_grid" else v for k, v in asdict(c).items()} for i, c in last.items()},
        "directives": [asdict(d) for d in directives],
        "payload_bytes": sizes,
    }
    say(json.dumps(heard))


if __name__ == "__main__":
    main()
