"""Scenario events in flight: when each begins, acts and ends, and what it may do to the fleet.

What kinds there are, and what each does, stands in `sortie.scenarios.schema.events`.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from numbers import Integral, Real
from typing import Any, get_args

import numpy as np
import simpy
from numpy.typing import ArrayLike, NDArray

from sortie.fleet.clock import DroneClock
from sortie.fleet.messages.auth import TRAILER_BYTES, Sealer
from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.policies.contract import Descriptor
from sortie.scenarios.frames import frame_at, with_frame
from sortie.scenarios.plugins.reference import PluginError, real_array
from sortie.scenarios.schema import Event, Lasting, Scenario
from sortie.scenarios.schema.events.base import About, Claim
from sortie.scenarios.streams import stream
from sortie.sim.engine.membership import Membership
from sortie.sim.engine.transport import Transport
from sortie.sim.engine.world import World, at


def group_key(seed: int) -> bytes:
    """The fleet's 32-byte group key of a sortie: secret inside the simulation, derived so that runs repeat."""
    return hashlib.sha256(b"sortie group key" + struct.pack("<Q", seed)).digest()


class Going:
    """Events with their fleets: it begins and ends them, and knows which of them last."""

    def __init__(self) -> None:
        self._going: dict[int, Event] = {}

    def begin(self, event: Event, fleet: Any) -> None:
        """An event's time has come; `fleet` is what it acts on (`sortie.scenarios.schema.events.base.Fleet`)."""
        self._going[fleet.index] = event
        event.begin(fleet)

    def end(self, event: Lasting, fleet: Any) -> None:
        """It is over."""
        del self._going[fleet.index]
        event.end(fleet, any(event.overlaps(other) for other in self._going.values()))

    def __iter__(self) -> Iterator[int]:
        return iter(tuple(self._going))


@dataclass(frozen=True)
class Acted:
    """What events act on, and the draws that they have."""

    scenario: Scenario
    world: World
    transport: Transport
    membership: Membership
    clocks: Sequence[DroneClock]
    seed: int
    replication: int


class Events:
    """The events of one sortie, on its clock."""

    def __init__(self, acted: Acted) -> None:
        """Put them on the clock; before anything else is, so that they come before a frame of the same instant.

        Raises:
            PluginError: an event of the user's own that is not there, does not load, or has no such parameter.
        """
        self._going, events = Going(), acted.scenario.events
        self._of = [(event, FleetHandle(acted, event, index)) for index, event in enumerate(events)]
        env, frame_s = acted.world.env, acted.scenario.frame_s
        for event, fleet in self._of:
            fleet.prepared = event.prepare(fleet)
            at(env, with_frame(event.at_s, frame_s), partial(self._going.begin, event, fleet))
        for event, fleet in self._of:
            if isinstance(event, Lasting) and event.until_s is not None:
                at(env, with_frame(event.until_s, frame_s), partial(self._going.end, event, fleet))

    def step(self, frame: int) -> None:
        """A frame begins."""
        for index in self._going:
            event, fleet = self._of[index]
            event.step(fleet)


class FleetHandle:
    """What an event sees of the fleet, and what it may do to it (`sortie.scenarios.schema.events.base.Fleet`)."""

    __slots__ = ("_acted", "_event", "_world", "frame_s", "index", "members", "prepared")

    def __init__(self, acted: Acted, event: Event, index: int) -> None:
        self._acted, self._world, self._event, self.index = acted, acted.world, event, index
        self.frame_s = acted.scenario.frame_s
        self.members: Sequence[int] = range(acted.scenario.fleet.drones)
        self.prepared: Any = None

    @property
    def t_s(self) -> float:
        return float(self._world.env.now)

    @property
    def positions_m(self) -> NDArray[np.float64]:
        motion = self._world.motion
        frame = min(frame_at(self.t_s, self.frame_s), motion.frames - 1)
        return _read_only(motion[frame : frame + 1].position_m[0].copy())

    @property
    def airborne(self) -> NDArray[np.bool_]:
        return _read_only(np.array([drone.airborne for drone in self._world.drones]))

    def note(self, text: str, drone: int = -1, kind: str | None = None) -> None:
        self._check(drone, first=-1)
        self._check_text(text)
        self._world.note(drone, self._event.kind if kind is None else kind, text)

    def lift(self) -> None:
        self._world.lift(self.index)

    def rng(self, entity: int | tuple[int, ...], purpose: str) -> np.random.Generator:
        return stream(self._acted.seed, self._acted.replication, entity, purpose)

    def run(self, waits_s: Iterator[float]) -> None:
        env = self._world.env

        def process() -> Generator[simpy.Event, Any, None]:
            for wait_s in waits_s:
                yield env.timeout(wait_s)

        env.process(process())

    def weaken(self, drone: int, peer: int | None, loss_db: float) -> None:
        for end in (drone,) if peer is None else (drone, peer):
            self._check(end)
        if not (isinstance(loss_db, Real) and 0.0 <= loss_db < np.inf):
            raise self._error(f"a loss of {loss_db!r:.60} dB, must be finite and ≥ 0")
        self._world.weaken(self.index, drone, peer, float(loss_db))

    def set_loss_db(self, loss_db: ArrayLike) -> None:
        n = len(self.members)
        asked = self._numbers(loss_db, f"of shape ({n}, {n}), or one number")
        if asked.shape not in ((), (n, n)):
            raise self._error(f"a loss of shape {asked.shape}, must be of shape ({n}, {n}), or one number")
        given = np.broadcast_to(asked, (n, n)).copy()
        np.fill_diagonal(given, 0.0)
        wrong = ~(np.isfinite(given) & (given >= 0.0))
        if wrong.any():
            raise self._error(f"a loss of {given[wrong][0]:g} dB, must be finite and ≥ 0")
        self._world.set_loss(self.index, given)

    def jam(self, position_m: tuple[float, float, float] | None, power_dbm: float = 20.0) -> None:
        if position_m is None:
            self._world.set_jammer(self.index, None)
            return
        at_m, power = self._numbers(position_m, "three, ENU"), self._numbers(power_dbm, "one")
        if at_m.shape != (3,) or power.shape:
            asked = f"a jammer of {power_dbm!r:.60} dBm at {position_m!r:.60}"
            raise self._error(f"{asked}, must be one number at three")
        if not np.isfinite([*at_m, power]).all():
            raise self._error(f"a jammer of {power_dbm} dBm at {position_m}, must be finite")
        x_m, y_m, z_m = at_m.tolist()
        self._world.set_jammer(self.index, ((x_m, y_m, z_m), float(power)))

    def settle(self) -> None:
        self._world.drain()

    def descends(self, drone: int) -> bool:
        return drone in self._world.homebound

    def join(self, drone: int) -> None:
        self._check(drone)
        self._acted.membership.join(drone)

    def send_home(self, drone: int) -> None:
        self._check(drone)
        self._acted.membership.go_home(drone)

    def lose(self, drone: int, text: str = "fell silent") -> None:
        self._check(drone)
        self._check_text(text)
        self._world.drain()
        if self._world.drones[drone].airborne:
            self._world.remove(drone, "drone_lost", text)

    def drain(self, drone: int, lost_fraction: float) -> None:
        self._check(drone)
        if not 0.0 < lost_fraction <= 1.0:
            raise self._error(f"lost_fraction is {lost_fraction}, must be > 0 and ≤ 1")
        self._world.drain()
        if self._world.drones[drone].airborne:
            self._world.lose_energy(drone, lost_fraction)

    def cells(self, drone: int) -> int:
        return int(self._world.batteries.cells[drone])

    def drop_cell(self, drone: int) -> None:
        self._world.drop_cell(drone)

    def clock(self, drone: int) -> DroneClock:
        return self._acted.clocks[drone]

    def read_clocks(self) -> None:
        self._world.read_clocks()

    def lie(self, drone: int, about: About, claim: Claim) -> None:
        self._check(drone)
        if about not in get_args(About) or claim not in get_args(Claim):
            known = f"{', '.join(get_args(About))}; {', '.join(get_args(Claim))}"
            raise self._error(f"a lie {about!r:.60}, {claim!r:.60}, must be one of each: {known}")
        self._world.lie(self.index, drone, about, claim)

    def block_cameras(self, drone: int) -> None:
        self._check(drone)
        self._world.block_cameras(self.index, drone)

    def slow(self, drone: int, extra_s: float) -> None:
        self._check(drone)
        if not (isinstance(extra_s, Real) and 0.0 <= extra_s < np.inf):
            raise self._error(f"perception slower by {extra_s!r:.60} s, must be finite and ≥ 0")
        self._world.slow(self.index, drone, float(extra_s))

    def slowed_s(self, drone: int) -> float:
        return self._world.drones[drone].slowed_s

    def last_datagram(self, drone: int) -> bytes:
        return self._acted.transport.last_datagram.get(drone, b"")

    def forger(self, key: bytes) -> Callable[[bytes, Callable[[Descriptor], Descriptor]], bytes]:
        sealer, authentic = Sealer(key, key_id=1), self._acted.scenario.context.authentication

        def forge(genuine: bytes, change: Callable[[Descriptor], Descriptor]) -> bytes:
            body = genuine[:-TRAILER_BYTES] if authentic else genuine
            false = encode_descriptor(change(decode_descriptor(body)))
            return sealer.seal(false) if authentic else false

        return forge

    def inject(self, datagram: bytes, victim: int) -> None:
        self._acted.transport.inject(datagram, [i for i in self.members if i != victim])

    def _numbers(self, given: object, must: str) -> NDArray[np.float64]:
        if (found := real_array(given)) is None:
            raise self._error(f"{given!r:.60}, must be numbers, {must}")
        return found

    def _check(self, drone: int, first: int = 0) -> None:
        n = len(self.members)
        if not (isinstance(drone, Integral) and first <= drone < n):
            raise self._error(f"drone {drone!r:.60}, must be a whole number, {first} … {n - 1}")

    def _check_text(self, text: object) -> None:
        if not isinstance(text, str):
            raise self._error(f"text {text!r:.60}, must be a str")

    def _error(self, what: str) -> PluginError:
        return PluginError(f"event {getattr(self._event, 'model', self._event.kind)}: {what}")


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    values.flags.writeable = False
    return values
