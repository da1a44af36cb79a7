"""The physical side of a sortie: in each frame it moves the drones, drains their batteries and computes the links.

Scenario events act on the physics here: extra loss, jammers, battery faults, lost drones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import simpy

from sortie.fleet.agent import Platform, Task
from sortie.fleet.clock import DroneClock
from sortie.fleet.computer import Work, headrooms
from sortie.fleet.coverage import cameras_of
from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.flight.manoeuvres import Manoeuvre, Motion
from sortie.fleet.flight.rotor import RotorPower
from sortie.fleet.plane import DroneStatus
from sortie.fleet.senses import FlightSenses, Sensed, believed
from sortie.perception.detectors import Detector
from sortie.perception.motion import Tracks
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.tracking.wire import content
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Disc, TaskPhase
from sortie.radio import Air
from sortie.radio.counters import CAUSES as LOSS_CAUSES
from sortie.radio.settings import AirSettings
from sortie.radio.topology import connectivity, usable_graph
from sortie.scenarios.frames import frame_at, frame_from
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.events.base import About, Claim
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.own_models import of_radio
from sortie.sim.engine.people import People
from sortie.sim.engine.tracking import FleetTracking, cars_in_reach
from sortie.sim.results.links import LinkLog
from sortie.sim.results.record import Recorder

Jammer = tuple[tuple[float, float, float], float]
NAN = float("nan")
_NO_DISC, _NOWHERE = (NAN, NAN, NAN), (NAN, NAN)
SECOND_S = 1.0
USABLE_SNR_DB = 0.0
"""Below this even MCS 0 loses most of its frames (FACTS §3: half of them at −0.94 dB)."""

LEAST_S = 1e-9
"""Batteries are not drained for less."""

LEAST_MBPS = 1e-6
"""A link that carries anything at all."""


def at(env: simpy.Environment, t_s: float, act: Callable[[], None]) -> None:
    """Call `act` at simulated time `t_s`."""
    event = env.timeout(max(0.0, t_s - env.now))
    event.callbacks.append(lambda _event: act())


def strongest_dbm(scenario: Scenario) -> float:
    """The highest transmit power in the fleet, which the air reckons with."""
    return max(sent_dbm(scenario))


def sent_dbm(scenario: Scenario) -> list[float]:
    """Each drone's transmit power."""
    common = scenario.radio.tx_power_dbm
    return [common if m is None or m.tx_power_dbm is None else m.tx_power_dbm for m in scenario.fleet.make_of_each]


def own_antennas(scenario: Scenario) -> dict[int, str]:
    """The antennas of drones that have another than the fleet's."""
    each = enumerate(scenario.fleet.make_of_each)
    return {drone: make.antenna for drone, make in each if make is not None and make.antenna is not None}


def air_settings(scenario: Scenario) -> AirSettings:
    """The scenario's radio.

    Raises:
        PluginError: as `sortie.sim.engine.own_models.of_radio`.
    """
    return AirSettings.of(
        scenario.radio.model_dump(exclude={"framing", "path_loss_params", "link_params"})
        | of_radio(scenario)
        | {"tx_power_dbm": strongest_dbm(scenario), "own_antennas": own_antennas(scenario)}
    )


def weaker_senders_db(scenario: Scenario) -> np.ndarray | None:
    """[N, N], sender by receiver: how much weaker than the strongest a drone sends; None where all are equal."""
    dbm = np.array(sent_dbm(scenario))
    loss = np.repeat((dbm.max() - dbm)[:, None], len(dbm), axis=1)
    return loss if loss.any() else None


class World:
    """Positions, batteries, links and mission, stepped once a frame."""

    def __init__(
        self,
        env: simpy.Environment,
        scenario: Scenario,
        drones: Sequence[DroneStatus],
        motion: Motion,
        batteries: FleetBatteries,
        air: Air,
        scene: SceneModel,
        plan: MissionPlan,
        recorder: Recorder,
        clocks: Sequence[DroneClock],
        people: People,
        errors: Mapping[int, np.ndarray],
        links: LinkLog,
    ) -> None:
        self.env, self.motion, self.batteries, self.air = env, motion, batteries, air
        self.scene, self.plan, self.drones = scene, plan, drones
        n = len(drones)
        self._weaker_db = weaker_senders_db(scenario)
        self._drops: dict[int, list[tuple[int, int | None, float]]] = {}  # by cause, here and below
        self._losses_db: dict[int, np.ndarray] = {}
        self._jammers: dict[int, Jammer] = {}
        self._clocks, self.people = clocks, people
        self._scenario, self._recorder = scenario, recorder
        self._computers = scenario.fleet.computers
        self._rotors, self._errors = RotorPower(scenario.fleet, motion), errors
        cameras, blind = cameras_of(scenario.fleet), scenario.fleet.without_camera
        self._flight = FlightSenses(motion, scenario.frame_s, scene.height_field, cameras, errors, blind)
        recorder.unfold["states"] = self._unfold_states
        self._delays_s = scenario.compute_delays_s
        self._busy_sensing = [min(1.0, delay_s * scenario.context.rate_hz) for delay_s in self._delays_s]
        """By drone: share of a frame in which its computer runs perception, when it senses: its compute delay."""
        self._airtime_s = [0.0] * n
        self._stepped_to_s = 0.0
        self._busy_at_s, self._links = (0.0, 0.0), links
        self._receptions = (0,) * (1 + len(LOSS_CAUSES))  # heard and lost to each cause, up to the frame's begin
        self.frame = 0
        self._frames_a_second = max(1, round(scenario.context.rate_hz * SECOND_S))
        self._work = deque([[Work()] * n], maxlen=1 + self._frames_a_second)
        self._headrooms = [(1.0, 1.0)] * n
        self._down: dict[int, list[tuple[int, int]]] = {}
        """The frames in which a drone is on the ground, where it stays."""
        self._homebound: set[int] = set()
        self.now = plan.at(0.0)
        """Each group's mission in this frame: the ground station's cue comes with the frame."""

    def end_frame(self, frame: int) -> None:
        """What came of the frame that ends as this one begins: charges, receptions and headrooms."""
        self.drain()
        if frame:
            self.write_receptions()
            self._measure_headrooms()

    def begin_frame(self, frame: int) -> None:
        """Clocks and the mission."""
        self.frame = frame
        self.read_clocks()
        self.now = self.plan.at(self.env.now)

    def renew_links(self, frame: int) -> None:
        """The links of this frame, after all that moves drones, jams or weakens."""
        self.air.advance(self.extra_loss_db, self.jammers)

    def _measure_headrooms(self) -> None:
        """Over the last second, so that a duty cycle does not show as a computer that is idle and busy in turn."""
        scenario = self._scenario
        self._work.append([status.work.copy() for status in self.drones])
        lasts_s = (len(self._work) - 1) * scenario.frame_s
        self._headrooms = [
            headrooms(computer, look_s, a, b, lasts_s)
            for computer, look_s, a, b in zip(
                self._computers, self._delays_s, self._work[0], self._work[-1], strict=True
            )
        ]

    def read_clocks(self) -> None:
        """Bring every drone's clock to the present."""
        for clock in self._clocks:
            clock.read(self.env.now)

    def reroute(self, manoeuvres: Sequence[Manoeuvre]) -> None:
        """Change the motion by manoeuvres that begin with one frame, the present one or the next."""
        self.motion.change(manoeuvres)
        self._rotors.forget()
        self._flight.forget()
        self.air.reroute(self.motion)

    def drain(self) -> None:
        """Drain the batteries for the time since the last call, and land the drones that are empty."""
        dt_s = self.env.now - self._stepped_to_s
        if dt_s <= LEAST_S:  # too short for shares of it
            return
        self._stepped_to_s = self.env.now
        airtime_s = list(self.air.airtime_s)
        airtime_share = [min(1.0, (a - b) / dt_s) for a, b in zip(airtime_s, self._airtime_s, strict=True)]
        self._airtime_s = airtime_s
        self.batteries.step(
            dt_s,
            self._rotors.at(self.frame).tolist(),
            [busy if d.perceiving else 0.0 for d, busy in zip(self.drones, self._busy_sensing, strict=True)],
            airtime_share,
        )
        self.ground_landed()

    def lose_energy(self, drone: int, lost_fraction: float) -> None:
        """A part of the energy that a drone has left is gone; it lands where that is too much."""
        self.batteries.fault(drone, lost_fraction)
        self.ground_landed()

    def drop_cell(self, drone: int) -> None:
        """A cell of a drone's pack fails; it lands where that is too much."""
        self.batteries.drop_cell(drone)
        self.ground_landed()

    def ground_landed(self) -> None:
        """Remove the drones with a battery that gave out."""
        for drone, (status, landed) in enumerate(zip(self.drones, self.batteries.landed, strict=True)):
            if landed and status.airborne:
                flew = self._scenario.fleet.station(drone) is None
                self.remove(drone, "landed" if flew else "power_lost", self.batteries.landing_reason[drone])

    @property
    def next_frame(self) -> int:
        """The frame that begins now, or else the next one."""
        return frame_from(self.env.now, self._scenario.frame_s)

    def remove(self, drone: int, kind: str, text: str) -> None:
        """A drone leaves the fleet: it is silent from now on, draws nothing, and stays where it is."""
        self.ground(drone)
        self.note(drone, kind, text)

    def ground(self, drone: int) -> None:
        """As `remove`, without an event: before take-off."""
        status = self.drones[drone]
        if status.airborne:
            since = frame_at(self.env.now, self._scenario.frame_s)
            self._down.setdefault(drone, []).append((since, self._scenario.frames))
        status.leave()
        self._homebound.discard(drone)
        self.air.silence(drone)
        self.batteries.land(drone)

    @property
    def homebound(self) -> Collection[int]:
        """Drones that descend."""
        return self._homebound

    def descend(self, drone: int, text: str) -> None:
        """A drone begins to descend."""
        self._homebound.add(drone)
        self.note(drone, "drone_leaves", text)

    def join(self, drone: int, text: str) -> None:
        """A drone on the ground appears in its slot, unless its charge would land it at once."""
        self.batteries.take_off(drone)
        if self.batteries.landed[drone]:
            self.note(drone, "stays_down", self.batteries.landing_reason[drone])
            return
        since, _ = self._down[drone].pop()
        self._down[drone].append((since, self.next_frame))
        self.drones[drone].airborne = True
        self.air.wake(drone)
        self.note(drone, "drone_joins", text)

    def weaken(self, cause: int, drone: int, peer: int | None, loss_db: float) -> None:
        """Add loss to both directions of a link, or of every link of a drone, until `lift`.

        Args: `cause` is the event's place in the scenario, as below.
        """
        self._drops.setdefault(cause, []).append((drone, peer, loss_db))

    def set_loss(self, cause: int, loss_db: np.ndarray) -> None:
        """Add loss to links, [N, N] dB, sender by receiver, until the next call or `lift`."""
        self._losses_db[cause] = loss_db

    def set_jammer(self, cause: int, jammer: Jammer | None) -> None:
        """Put a jammer somewhere until the next call or `lift`: position (ENU, m) and power (dBm); None turns it off."""
        self._jammers.pop(cause, None)
        if jammer is not None:
            self._jammers[cause] = jammer

    def lie(self, cause: int, drone: int, about: About, claim: Claim) -> None:
        """A drone says something false, until `lift`."""
        self.drones[drone].lie(cause, about, claim)

    def block_cameras(self, cause: int, drone: int) -> None:
        """A drone's cameras see nothing, until `lift`."""
        self.drones[drone].blocked.add(cause)

    def slow(self, cause: int, drone: int, extra_s: float) -> None:
        """A drone's perception takes longer, until `lift`."""
        self.drones[drone].slower_s[cause] = extra_s

    def lift(self, cause: int) -> None:
        """Take back all that an event did to links, jammers and drones."""
        for kept in (self._drops, self._losses_db, self._jammers):
            kept.pop(cause, None)
        for drone in self.drones:
            drone.lift(cause)

    @property
    def jammers(self) -> list[Jammer]:
        """Those that are on."""
        return list(self._jammers.values())

    @property
    def extra_loss_db(self) -> np.ndarray | None:
        """[N, N], sender by receiver: what weaker senders and events add to the path loss; None for nothing."""
        given = [] if self._weaker_db is None else [self._weaker_db]
        if self._drops:
            dropped = np.zeros((len(self.drones), len(self.drones)))
            for drone, peer, loss_db in chain.from_iterable(self._drops.values()):
                others = slice(None) if peer is None else peer
                dropped[drone, others] += loss_db
                dropped[others, drone] += loss_db
            given.append(dropped)
        given.extend(self._losses_db.values())
        return np.sum(given, axis=0) if len(given) > 1 else given[0] if given else None

    def note(self, drone: int, kind: str, text: str) -> None:
        """Write an event down; drone −1 is the whole fleet."""
        self._recorder.rows["events"].append((self.env.now, drone, kind, text))

    def write_receptions(self) -> None:
        """Record what became of descriptors since the present frame's begin; called at its end."""
        counters = self.air.counters
        now = (counters.receptions, *counters.lost_to.values())
        since = [after - before for before, after in zip(self._receptions, now, strict=True)]
        self._recorder.rows["receptions"].append((self.frame * self._scenario.frame_s, *since))
        self._receptions = now

    def write(self, frame: int) -> None:
        """Record the frame's states, and once a second the medium's."""
        self._write_states(frame)
        if self.is_second(frame):
            self._write_medium()

    def is_second(self, frame: int) -> bool:
        """Whether a second begins with this frame."""
        return frame % self._frames_a_second == 0

    def _write_medium(self) -> None:
        """How busy the channel has been since the last row, and how many drones others heard; and once in a while the links."""
        busy_s = self.air.utilisation * self.env.now
        since_s = self.env.now - self._busy_at_s[0]
        busy = (busy_s - self._busy_at_s[1]) / since_s if since_s > 0 else 0.0
        self._busy_at_s = (self.env.now, busy_s)
        flying = [drone for drone, status in enumerate(self.drones) if status.airborne]
        self._recorder.rows["medium"].append((self.env.now, busy, self._links.heard_drones()))
        if self._links.is_due(self.env.now):
            in_earshot, snr_db, mbps = self.air.in_earshot(), self.air.snr_db, self.air.link_mbps()
            self._links.write(self.env.now, flying, snr_db, mbps, self.air.usable(USABLE_SNR_DB), in_earshot)
        if self._scenario.radio.relay_max_hops > 1:
            self._write_topology(flying)

    def _write_topology(self, flying: Sequence[int]) -> None:
        """Record whether all drones reach each other, which are cut off, and the link that limits the worst pair."""
        mbps = self.air.link_mbps()
        usable = ((a, b, float(mbps[a, b])) for a in flying for b in flying if a != b and mbps[a, b] >= LEAST_MBPS)
        whole = connectivity(usable_graph(flying, usable))
        row = (self.env.now, whole.connected, list(whole.cut), *(whole.bottleneck or (-1, -1, NAN)))
        self._recorder.rows["topology"].append(row)

    def _write_states(self, frame: int) -> None:
        rows, now_s, batteries = self._recorder.rows, self.env.now, self.batteries
        airborne = [status.airborne for status in self.drones]
        rows["states"].append(
            (
                now_s,
                frame,
                batteries.soc.copy(),
                batteries.voltage_v.copy(),
                batteries.current_a.copy(),
                batteries.spent_j,
                [status.work.looks for status in self.drones],
                airborne,
            )
        )
        self.people.write(now_s)
        for group, (phase, region, target, target_xy) in self.now.items():
            rows["mission"].append((now_s, group, phase, *(region or _NO_DISC), target, *(target_xy or _NOWHERE)))

    def _unfold_states(self, rows: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Columns of the `states` table: what the motion knows already is kept by the frame, not by the drone."""
        now_s, frames, *changing = zip(*rows, strict=True)
        n, m = len(self.drones), self.motion[: frames[-1] + 1]
        at = np.tile(np.array(frames)[:, None], n)
        for drone, several in self._down.items():
            for since, until in several:
                down = (at[:, drone] >= since) & (at[:, drone] < until)
                at[down, drone] = since
        of, still = np.arange(n), (at < np.array(frames)[:, None])[..., None]
        pose = (m.position_m[at, of], m.orientation_xyzw[at, of])
        moving = [np.where(still, 0.0, states[at, of]) for states in (m.velocity_mps, m.body_rates_radps)]
        flown = np.concatenate([*pose, *moving], axis=-1).reshape(len(rows) * n, -1)
        return [
            np.repeat(now_s, n),
            np.tile(range(n), len(rows)),
            *flown.T,
            *(list(chain.from_iterable(c)) for c in changing),
        ]

    # --- what one drone senses of itself ---------------------------------------------------------

    def capture(self, drone: int, frame: int) -> Capture:
        """What the drone's cameras see from in a frame."""
        return self.sensed(drone, frame).capture

    def sensed(self, drone: int, frame: int) -> Sensed:
        """The drone's pose, velocity and coverage in a frame."""
        return self._flight.at(frame)[drone]

    def misplaced_m(self, drone: int, frame: int) -> list[float]:
        """By how much a drone believes to be elsewhere than it is, ENU; faults of its sensors included."""
        here = self.sensed(drone, frame).capture
        off_m: list[float] = (np.array(here.est_position_m) - np.array(here.position_m)).tolist()
        return off_m

    def believed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times [T] of all frames, and in each the positions [T, N, 3] and headings [T, N] that drones believe to have."""
        frames = slice(0, self._scenario.frames)
        return np.arange(self._scenario.frames) * self._scenario.frame_s, *believed(self.motion, self._errors, frames)

    def platform(self, drone: int) -> Platform:
        """Charge, and headrooms over the second that ended."""
        return Platform(self.batteries.soc[drone], *self._headrooms[drone])


class OwnSenses:
    """One drone's own sensors (sortie.fleet.agent.Senses); it shows the agent no other drone."""

    def __init__(
        self,
        world: World,
        drone: int,
        tracking: FleetTracking,
        detector: Detector | None = None,
    ) -> None:
        """Args: without a `detector` the cars in range are counted, and there are no tracks."""
        self._world, self._drone, self._tracking, self._detector = world, drone, tracking, detector
        self._sensed = world.sensed(drone, 0)

    def sense(self, frame: int) -> Sensed:
        self._sensed = self._world.sensed(self._drone, frame)
        is_blocked = bool(self._world.drones[self._drone].blocked)
        self._world.people.look(self._sensed.capture, frame, is_blocked=is_blocked)
        return self._sensed

    def platform(self) -> Platform:
        return self._world.platform(self._drone)

    def task(self) -> Task:
        now_s, world = self._sensed.capture.t_s, self._world
        if self._drone in world.homebound:
            return Task(TaskPhase.LANDING, None)
        now = world.now[world.plan.group_of[self._drone]]
        task = now.task(lambda target, cue_m: self._tracking.follows(self._drone, target, cue_m, now_s))
        person = world.people.known_in(self._drone, task.region, now_s)
        return task._replace(person_in_region=True) if person else task

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        if self._detector is not None:
            return self._detector.count_boxes(capture, roi)
        return cars_in_reach(self._world.scene, capture, roi)

    def perceived(self, capture: Capture) -> None:
        self._tracking.perceived(capture)

    def tracks_in(self, capture: Capture, roi: Disc | None) -> Tracks | None:
        if self._detector is None:
            return None
        return content(self._tracking.tracks(self._drone), roi, capture.est_position_m, capture.t_s)

    def people_in(self, capture: Capture, roi: Disc | None) -> Boxes:
        return self._world.people.found(capture).inside(roi)
