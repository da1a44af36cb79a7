"""The physical side of a sortie: in each frame it moves the drones, drains their batteries and computes the links.

Scenario events act on the physics here: extra loss, jammers, battery faults, lost drones.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import simpy

from sortie.fleet.agent import Platform, Task
from sortie.fleet.computer import Work, headrooms
from sortie.fleet.coverage import RANGE_M, cameras_of
from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.flight.manoeuvres import Manoeuvre, Motion
from sortie.fleet.flight.rotor import RotorPower
from sortie.fleet.plane import DroneStatus
from sortie.fleet.senses import FlightSenses, Sensed, believed
from sortie.perception.motion import Tracks
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.tracking.wire import content
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Disc, TaskPhase
from sortie.radio import Air
from sortie.radio.counters import CAUSES as LOSS_CAUSES
from sortie.radio.settings import AirSettings
from sortie.radio.topology import connectivity, usable_graph
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.own_models import of_radio
from sortie.sim.engine.own_state import OwnState
from sortie.sim.engine.people import People
from sortie.sim.engine.tracking import FleetTracking
from sortie.sim.results.links import LinkLog
from sortie.sim.results.record import Recorder

NAN = float("nan")
_NO_DISC, _NOWHERE = (NAN, NAN, NAN), (NAN, NAN)
SECOND_S = 1.0
USABLE_SNR_DB = 0.0
"""Below this even MCS 0 loses most of its frames (FACTS §3: half of them at −0.94 dB)."""

LEAST_MBPS = 1e-6
"""A link that carries anything at all."""

INSTANT_S = 1e-9
"""Times closer together than this are equal but for rounding."""


def at(env: simpy.Environment, t_s: float, act: Callable[[], None]) -> None:
    """Call `act` at simulated time `t_s`."""
    event = env.timeout(max(0.0, t_s - env.now))
    event.callbacks.append(lambda _event: act())


def with_frame(t_s: float, frame_s: float) -> float:
    """Round `t_s` to the begin of a frame if it differs from it by rounding alone.

    So an event is no later than a frame of the same instant: at 7.5 Hz the frame of 14.8 s begins a last digit earlier.
    """
    frame_at_s = round(t_s / frame_s) * frame_s
    return frame_at_s if t_s - INSTANT_S < frame_at_s < t_s else t_s


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
        own: Sequence[OwnState],
        people: People,
        errors: Mapping[int, np.ndarray],
        links: LinkLog,
    ) -> None:
        self.env, self.motion, self.batteries, self.air = env, motion, batteries, air
        self.scene, self.plan, self.drones = scene, plan, drones
        n = len(drones)
        self.extra_loss_db: np.ndarray | None = weaker_senders_db(scenario)
        """[N, N], sender by receiver: what weaker senders and scenario events add to the path loss; None for nothing."""
        self.own_losses_db: dict[int, np.ndarray] = {}
        """The same of events from outside, by their place in the scenario."""
        self.own, self.people = own, people
        self.jammers: dict[int, tuple[tuple[float, float, float], float]] = {}
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
        self._work = deque([[Work()] * n], maxlen=1 + max(1, round(scenario.context.rate_hz * SECOND_S)))
        self._headrooms = [(1.0, 1.0)] * n
        self._down: dict[int, list[tuple[int, int]]] = {}
        """The frames in which a drone is on the ground, where it stays."""
        self.homebound: set[int] = set()
        """Drones that descend."""
        self.now = plan.at(0.0)
        """Each group's mission in this frame: the ground station's cue comes with the frame."""

    def start(self, on_second: Callable[[float], None], before_frame: Sequence[Callable[[int], None]] = ()) -> None:
        """Begin the world's process; call once, before the agents start.

        Args:
            on_second: called once a simulated second; must not change anything.
            before_frame: called in turn at the begin of each frame, before the links are computed. They may reroute the
                fleet.
        """
        self.env.process(self._run(on_second, before_frame))

    def _run(
        self, on_second: Callable[[float], None], before_frame: Sequence[Callable[[int], None]]
    ) -> Generator[simpy.Event, Any, None]:
        env, scenario = self.env, self._scenario
        frames_a_second = max(1, round(scenario.context.rate_hz * SECOND_S))
        for frame in range(scenario.frames):
            yield env.timeout(max(0.0, frame * scenario.frame_s - env.now))
            self.drain()
            if frame:
                self.write_receptions()
                self._measure_headrooms()
            self.frame = frame
            self.read_clocks()
            self.now = self.plan.at(env.now)
            for prepare in before_frame:
                prepare(frame)
            self.air.advance(self._loss_db(), list(self.jammers.values()))
            self._write(frame)
            if frame % frames_a_second == 0:
                self._write_medium()
                on_second(env.now)

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
        for each in self.own:
            each.read(self.env.now)

    def reroute(self, manoeuvres: Sequence[Manoeuvre]) -> None:
        """Change the motion by manoeuvres that begin with one frame, the present one or the next."""
        self.motion.change(manoeuvres)
        self._rotors.forget()
        self._flight.forget()
        self.air.reroute(self.motion)

    def drain(self) -> None:
        """Drain the batteries for the time since the last call, and land the drones that are empty."""
        dt_s = self.env.now - self._stepped_to_s
        if dt_s <= INSTANT_S:  # too short for shares of it
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

    def ground_landed(self) -> None:
        """Remove the drones with a battery that gave out."""
        for drone, (status, landed) in enumerate(zip(self.drones, self.batteries.landed, strict=True)):
            if landed and status.airborne:
                flew = self._scenario.fleet.station(drone) is None
                self.remove(drone, "landed" if flew else "power_lost", self.batteries.landing_reason[drone])

    @property
    def next_frame(self) -> int:
        """The frame that begins now, or else the next one."""
        return math.ceil(self.env.now / self._scenario.frame_s - 1e-6)

    def remove(self, drone: int, kind: str, text: str) -> None:
        """A drone leaves the fleet: it is silent from now on, draws nothing, and stays where it is."""
        self.ground(drone)
        self.note(drone, kind, text)

    def ground(self, drone: int) -> None:
        """As `remove`, without an event: before take-off."""
        status = self.drones[drone]
        if status.airborne:
            since = int(self.env.now / self._scenario.frame_s + 1e-6)
            self._down.setdefault(drone, []).append((since, self._scenario.frames))
        status.leave()
        self.homebound.discard(drone)
        self.air.silence(drone)
        self.batteries.land(drone)

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

    def add_loss(self, drone: int, peer: int | None, loss_db: float) -> None:
        """Add loss to both directions of a link, or of every link of a drone."""
        n = len(self.drones)
        loss = np.zeros((n, n)) if self.extra_loss_db is None else self.extra_loss_db.copy()
        others = slice(None) if peer is None else peer
        loss[drone, others] += loss_db
        loss[others, drone] += loss_db
        self.extra_loss_db = loss if loss.any() else None

    def _loss_db(self) -> np.ndarray | None:
        given = [loss for loss in (self.extra_loss_db, *self.own_losses_db.values()) if loss is not None]
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

    def _write(self, frame: int) -> None:
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
        count_boxes: Callable[[Capture, Disc | None], int] | None = None,
    ) -> None:
        """Args: `count_boxes` counts what the detector reports; None counts the cars in range, and there are no tracks."""
        self._world, self._drone, self._tracking, self._count_boxes = world, drone, tracking, count_boxes
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
        if self._count_boxes is not None:
            return self._count_boxes(capture, roi)
        return cars_in_reach(self._world.scene, capture, roi)

    def perceived(self, capture: Capture) -> None:
        self._tracking.perceived(capture)

    def tracks_in(self, capture: Capture, roi: Disc | None) -> Tracks | None:
        if self._count_boxes is None:
            return None
        return content(self._tracking.tracks(self._drone), roi, capture.est_position_m, capture.t_s)

    def people_in(self, capture: Capture, roi: Disc | None) -> Boxes:
        return self._world.people.found(capture).inside(roi)


def cars_in_reach(scene: SceneModel, capture: Capture, roi: Disc | None) -> int:
    """How many cars a drone could report: within its range, or within a disc."""
    x_m, y_m, radius_m = capture.position_m[0], capture.position_m[1], RANGE_M
    if roi is not None:
        x_m, y_m, radius_m = roi.x_m, roi.y_m, min(roi.radius_m, RANGE_M)
    return scene.cars_near(capture.t_s, x_m, y_m, radius_m)
