"""One agent with made-up senses and air, and the parts that tests of the plane put into it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import simpy
from fleet_examples import DESCRIPTOR

from sortie.fleet.agent import Agent, Alone, Platform, Task
from sortie.fleet.coverage import View
from sortie.fleet.gate import Gate, Payload
from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.auth import DropReason, Opened
from sortie.fleet.plane import DroneStatus, FleetRules
from sortie.fleet.senses import Sensed
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Representation, TaskPhase

RULES = FleetRules(0.1, 1000, 3.0, 10.0, 0.3, 0.2, 0.04, trust=True)


def memory(drone: int = 0, **changes: Any) -> PeerMemory:
    rules = FleetRules(**{f: getattr(RULES, f) for f in RULES.__dataclass_fields__} | changes)
    return PeerMemory(drone, rules, DroneStatus())


def descriptor(agent_id: int, t_s: float = 0.0, **changes: Any) -> Descriptor:
    return DESCRIPTOR._replace(agent_id=agent_id, stamp_ns=round(t_s * 1e9), **changes)


def hear(mine: PeerMemory, peer: int, t_s: float, *, counter: int = 0, key_id: int | None = None) -> DropReason | None:
    """A descriptor of this time arrives at once."""
    return mine.hear(Opened(descriptor(peer, t_s), key_id, counter), t_s)


def capture(drone: int, t_s: float) -> Capture:
    return Capture(drone, t_s, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 60.0), 0.0)


def payload(size: int = 20_000, rung: Representation = Representation.FEATURES) -> Payload:
    return Payload(rung, 0.1, None, 1.0, 100, 0, 0, size)


class Rig:
    """One agent with made-up senses and air; `sent` and `published` are what it put on the air."""

    def __init__(self, policy: Callable[[FleetView], Sequence[Directive]], *, handshake: int = 0, **rules: Any) -> None:
        self.env = simpy.Environment()
        self.memory = memory(0, **rules)
        self.sent: list[tuple[float, int, Payload, Capture]] = []
        self.shaken: list[tuple[float, int]] = []
        self.published: list[tuple[float, bytes]] = []
        self.gate = Gate()
        self.agent = Agent(
            self.env,
            self.memory,
            rules=self.memory._rules,
            pilot=Alone(policy, handshake),
            senses=self,
            modem=self,
            gate=self.gate,
            log=self,
            sealer=None,
            phase_s=0.01,
        )
        self.agent.start()

    # senses
    def sense(self, frame: int) -> Sensed:
        now = capture(0, frame * 0.1)
        return Sensed(now, (0.0, 0.0, 0.0), 42.0, View(0, 0, bytes(64)), now.orientation_xyzw)

    def platform(self) -> Platform:
        return Platform(0.9, 1.0, 1.0)

    def task(self) -> Task:
        return Task(TaskPhase.SEARCH, None)

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        return 3

    def perceived(self, capture: Capture) -> None: ...

    def tracks_in(self, capture: Capture, roi: Disc | None) -> None:
        return None

    def people_in(self, capture: Capture, roi: Disc | None) -> Boxes:
        return Boxes.empty()

    # modem
    def broadcast(self, datagram: bytes) -> None:
        self.published.append((self.env.now, datagram))

    def send(self, peer: int, payload: Payload, capture: Capture, deadline_s: float) -> None:
        self.sent.append((self.env.now, peer, payload, capture))

    def handshake(self, peer: int, size_bytes: int, capture: Capture, deadline_s: float) -> None:
        self.shaken.append((self.env.now, peer))

    def goodput_mbps(self, to: Sequence[int] | None = None) -> tuple[float, ...]:
        return (50.0,) * (4 if to is None else len(to))

    def __getattr__(self, name: str) -> Any:  # the log
        if name in ("descriptor", "directive", "trust", "decision", "event", "alert"):
            return lambda *what: None
        raise AttributeError(name)

    def hear(self, *peers: int) -> None:
        for peer in peers:
            self.memory.hold(descriptor(peer, self.env.now, coverage_grid=bytes(64)), self.env.now)
