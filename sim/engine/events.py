"""Puts scenario events (link drops, jammers, losses, faults, attacks, lies) on the clock."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Generator
from typing import Any

import numpy as np
import simpy

from sortie.fleet.messages.auth import TRAILER_BYTES, Sealer
from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.scenarios.schema import (
    BatteryFault,
    CameraBlocked,
    CellFailure,
    ClockDrift,
    ClockSkew,
    DroneJoins,
    DroneLeaves,
    DroneLost,
    Event,
    GnssLoss,
    HeadingFault,
    Jam,
    Lie,
    LinkDrop,
    Own,
    PositionFault,
    Scenario,
    SlowPerception,
    Spoof,
)
from sortie.scenarios.streams import stream
from sortie.sim.engine.membership import Membership
from sortie.sim.engine.own_events import OwnEvents
from sortie.sim.engine.own_state import whom
from sortie.sim.engine.transport import Transport
from sortie.sim.engine.world import World, at, with_frame

OVERSIZED_BYTES = 2000
LASTING = (
    LinkDrop,
    Jam,
    Lie,
    GnssLoss,
    Own,
    PositionFault,
    HeadingFault,
    CameraBlocked,
    SlowPerception,
)
"""Events that have an end."""
FleetEvent = DroneJoins | DroneLeaves | DroneLost | BatteryFault | CellFailure
"""Events that change nothing where the drone is on the ground, or flies already."""


def group_key(seed: int) -> bytes:
    """The fleet's 32-byte group key of a sortie: secret inside the simulation, derived so that runs repeat."""
    return hashlib.sha256(b"sortie group key" + struct.pack("<Q", seed)).digest()


def schedule(
    scenario: Scenario,
    world: World,
    transport: Transport,
    membership: Membership,
    own: OwnEvents,
    *,
    seed: int,
    replication: int,
) -> None:
    """Put every event of the scenario on the clock; call once, before anything else is scheduled.

    Events and their ends come before the frame that begins at the same instant.
    """
    going: dict[int, Event] = {}
    begins = [
        _Begin(scenario, world, transport, membership, own, e, index, seed, replication, going)
        for index, e in enumerate(scenario.events)
    ]
    for begin in begins:
        at(world.env, with_frame(begin.event.at_s, scenario.frame_s), begin)
    for begin in begins:
        event = begin.event
        if isinstance(event, LASTING) and event.until_s is not None:
            at(world.env, with_frame(event.until_s, scenario.frame_s), begin.end)


class _Begin:
    """An event's begin; a callable, so that each keeps its own event."""

    def __init__(
        self,
        scenario: Scenario,
        world: World,
        transport: Transport,
        membership: Membership,
        own: OwnEvents,
        event: Event,
        index: int,
        seed: int,
        replication: int,
        going: dict[int, Event],
    ) -> None:
        self.scenario, self.world, self.transport, self.event = scenario, world, transport, event
        self.membership, self.own = membership, own
        self.index, self.seed, self.replication = index, seed, replication
        self.going = going
        """The events of all that have begun and not ended, by their place among the scenario's."""

    def __call__(self) -> None:
        world, event = self.world, self.event
        env = world.env
        if isinstance(event, FleetEvent):
            world.drain()  # what the drones have spent up to now
            if why := self._no_effect(event):
                world.note(event.drone, "no_effect", f"{event.kind}: {why}")
                return
        self.going[self.index] = event
        match event:
            case LinkDrop():
                world.note(event.drone, "link_drop", f"links of {_ends(event)} lose {event.loss_db:g} dB")
                world.add_loss(event.drone, event.peer, event.loss_db)
            case Jam():
                world.note(-1, "jam", f"a jammer of {event.power_dbm:g} dBm at {event.position_m}")
                world.jammers[self.index] = (event.position_m, event.power_dbm)
            case DroneLost():
                world.remove(event.drone, "drone_lost", "fell silent")
            case DroneJoins():
                self.membership.join(event.drone)
            case DroneLeaves():
                self.membership.go_home(event.drone)
            case BatteryFault():
                lost = f"{event.lost_fraction:.0%} of the remaining energy is gone"
                world.note(event.drone, "battery_fault", lost)
                world.batteries.fault(event.drone, event.lost_fraction)
                world.ground_landed()
            case CellFailure():
                left = world.batteries.cells[event.drone] - 1
                world.batteries.drop_cell(event.drone)
                text = {0: "no cell is left", 1: "1 cell is left"}.get(left, f"{left} cells are left")
                world.note(event.drone, "cell_failure", text)
                world.ground_landed()
            case ClockSkew() | ClockDrift() | GnssLoss() | Lie():
                for drone in whom(event, self.scenario.fleet.drones):
                    world.note(drone, *world.own[drone].begin(event, self.index, env.now))
                if not isinstance(event, Lie):
                    world.read_clocks()
            case Own():
                self.own.begin(self.index, event.model)
            case PositionFault() | HeadingFault():
                world.note(event.drone, event.kind, _fault(event))
            case CameraBlocked():
                world.drones[event.drone].blocked.add(self.index)
                world.note(event.drone, "camera_blocked", "its cameras see nothing")
            case SlowPerception():
                world.drones[event.drone].slower_s[self.index] = event.extra_s
                world.note(event.drone, "slow_perception", f"its perception takes {event.extra_s:g} s longer")
            case Spoof():
                world.note(event.drone, "spoof", f"{event.attack} descriptors at {event.rate_hz:g} Hz")
                env.process(self._spoof(env, event))

    def _no_effect(self, event: FleetEvent) -> str:
        """Why an event of a drone that joins, leaves or loses energy changes nothing; empty where it does."""
        flies, descends = self.world.drones[event.drone].airborne, event.drone in self.world.homebound
        if not isinstance(event, DroneJoins | DroneLeaves):
            return "" if flies else "it is not in the fleet"
        if descends:
            return "it still descends" if isinstance(event, DroneJoins) else "it already descends"
        if flies == isinstance(event, DroneJoins):
            return "it is already in the fleet" if flies else "it is not in the fleet"
        return ""

    def end(self) -> None:
        """End an event that lasts."""
        world, event = self.world, self.event
        env = world.env
        del self.going[self.index]
        match event:
            case LinkDrop():
                world.add_loss(event.drone, event.peer, -event.loss_db)
                links = f"links of {_ends(event)}"
                self._note_end("link_back", f"{links} are back", f"{links} are back only where no other drop lasts")
            case Jam():
                del world.jammers[self.index]
                self._note_end("jam_over", "the jammer is off", "this jammer is off, another one is still on")
            case Own():
                self.own.end(self.index, event.model)
            case PositionFault() | HeadingFault():
                usual = "its believed pose has its usual errors again"
                self._note_end(f"{event.kind}_over", usual, "its believed pose is still wrong: another fault lasts")
            case CameraBlocked():
                world.drones[event.drone].blocked.discard(self.index)
                still = "its cameras still see nothing: another block lasts"
                self._note_end("camera_clear", "its cameras see again", still)
            case SlowPerception():
                del world.drones[event.drone].slower_s[self.index]
                usual = "its perception takes its usual time again"
                still_s = sum(world.drones[event.drone].slower_s.values())
                self._note_end("slow_perception_over", usual, f"its perception still takes {still_s:g} s longer")
            case GnssLoss() | Lie():
                for drone in whom(event, self.scenario.fleet.drones):
                    world.note(drone, *world.own[drone].end(event, self.index, env.now))
                if not isinstance(event, Lie):
                    world.read_clocks()

    def _note_end(self, kind: str, text: str, still: str) -> None:
        """Write down that the event is over; `still` where another one does the same and lasts."""
        lasts = any(_alike(self.event, other) for other in self.going.values())
        drone = getattr(self.event, "drone", -1)
        self.world.note(drone, *((self.event.kind, still) if lasts else (kind, text)))

    def _spoof(self, env: simpy.Environment, event: Spoof) -> Generator[simpy.Event, Any, None]:
        """Imitate the drone's descriptors; the attacker lacks the fleet's key but hears every broadcast."""
        rng = stream(self.seed, self.replication, (event.drone, self.index), "spoof")
        sealer = Sealer(rng.bytes(32), key_id=1)
        captured = b""
        end_s = self.scenario.duration_s if event.until_s is None else event.until_s
        listeners = [i for i in range(self.scenario.fleet.drones) if i != event.drone]
        while env.now < end_s:
            genuine = self.transport.last_datagram.get(event.drone, b"")
            captured = captured or genuine
            if genuine:
                self.transport.inject(self._datagram(event, genuine, captured, sealer, rng), listeners)
            yield env.timeout(1.0 / event.rate_hz)

    def _datagram(
        self, event: Spoof, genuine: bytes, captured: bytes, sealer: Sealer, rng: np.random.Generator
    ) -> bytes:
        authentic = self.scenario.context.authentication
        match event.attack:
            case "forged":
                # A false descriptor: the drone claims an empty battery and no links.
                body = genuine[:-TRAILER_BYTES] if authentic else genuine
                lie = _empty_handed(body)
                return sealer.seal(lie) if authentic else lie
            case "replayed":
                return captured
            case "malformed":
                return rng.bytes(len(genuine))
            case "oversized":
                return genuine + bytes(OVERSIZED_BYTES)


def _fault(event: PositionFault | HeadingFault) -> str:
    if isinstance(event, HeadingFault):
        return f"believes its heading {event.offset_deg:g}° off, drifting by {event.drift_degps:g}° a second"
    offset_m, drift_mps = (math.hypot(*vector) for vector in (event.offset_m, event.drift_mps))
    return f"believes to be {offset_m:.3g} m away, drifting at {drift_mps:.3g} m/s"


def _alike(ended: Event, other: Event) -> bool:
    """Whether an event that lasts keeps up what one that ended did."""
    match ended, other:
        case LinkDrop(), LinkDrop():
            a, b = ({drop.drone, drop.peer} - {None} for drop in (ended, other))
            return a <= b or b <= a or len(a) == len(b) == 1  # two drones with weak links share one
        case PositionFault() | HeadingFault(), PositionFault() | HeadingFault():
            return ended.drone == other.drone
        case PositionFault() | HeadingFault(), GnssLoss():
            return other.position_walk_m > 0 and other.drone in (None, ended.drone)
    return ended.kind == other.kind and getattr(ended, "drone", -1) == getattr(other, "drone", -1)


def _ends(drop: LinkDrop) -> str:
    return f"{drop.drone}" if drop.peer is None else f"{drop.drone}–{drop.peer}"


def _empty_handed(descriptor_bytes: bytes) -> bytes:
    descriptor = decode_descriptor(descriptor_bytes)
    goodput = tuple(0.0 for _ in descriptor.peer_goodput_mbps)
    return encode_descriptor(descriptor._replace(battery_soc=0.0, peer_goodput_mbps=goodput))
