"""Fly a sortie: the one place that wires the rooms together, on one SimPy clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from types import SimpleNamespace
from typing import Any, Protocol, cast

import pyarrow as pa
import simpy

from sortie.fleet.agent import Agent
from sortie.fleet.clock import DroneClock, oscillators
from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.flight.manoeuvres import Motion
from sortie.fleet.flight.steering import area_m
from sortie.fleet.gate import Gate
from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.auth import Sealer
from sortie.fleet.peers import PeerTable
from sortie.fleet.plane import DroneStatus, FleetRules, codebooks
from sortie.fleet.probes import window_of
from sortie.fleet.sensor_faults import sensor_errors
from sortie.fleet.traces import flown_motion
from sortie.perception.detectors import Detector, DetectsMany, LooksByAnother, make_detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.policies.contract import Policy
from sortie.radio import Air
from sortie.radio.event_loop import EventLoop
from sortie.radio.rates import STANDARDS
from sortie.scenarios.plugins.user_calls import guarded
from sortie.scenarios.schema import Perception, Scenario
from sortie.scenarios.streams import stream
from sortie.sim.apart import Said, call_within
from sortie.sim.engine.audit import Audit
from sortie.sim.engine.events import Acted, Events, group_key
from sortie.sim.engine.fusing import FindingEachFrame, Fusing
from sortie.sim.engine.garbage import LEFTOVERS, cycles_searched_rarely
from sortie.sim.engine.manoeuvres import Manoeuvres, Planners, Viewpoints
from sortie.sim.engine.membership import Membership
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.mixed import mixed
from sortie.sim.engine.own_boxes import OwnBoxes
from sortie.sim.engine.own_metrics import loaded, own_metrics
from sortie.sim.engine.people import People
from sortie.sim.engine.pilot import NamedPolicy, Pilot, PolicyPlan, named_policy, plan_for, plan_of, schedule_policies
from sortie.sim.engine.scoring import Scorer, taking_turns
from sortie.sim.engine.separation import Separation
from sortie.sim.engine.tracking import Ahead, FleetTracking, OwnBoxesOf, TargetSeen
from sortie.sim.engine.transport import Transport
from sortie.sim.engine.world import OwnSenses, World, air_settings
from sortie.sim.identity import code_version, name_of, own_files
from sortie.sim.results import beliefs, disagreement, rosters
from sortie.sim.results.links import LinkLog
from sortie.sim.results.record import AgentNotes, Recorder, SortieRecord
from sortie.sim.results.views import TABLES as VIEW_TABLES
from sortie.sim.results.views import Journal, decisions

KEY_ID = 1
PHASE_SHARE, PHASE_S = 0.1, 0.01
"""Each drone acts at its own moment, within the first tenth of a frame and its first 10 ms."""


def latest_phase_s(frame_s: float) -> float:
    """Until when in each frame every drone has acted, s."""
    return min(PHASE_SHARE * frame_s, PHASE_S)


def phase_of(scenario: Scenario, seed: int, replication: int, drone: int) -> float:
    """The drone's moment within each frame, s."""
    return latest_phase_s(scenario.frame_s) * float(stream(seed, replication, drone, "phase").random())


class Observer(Protocol):
    """Watches a sortie while it flies; nothing that it does changes the record."""

    def begin(self, scenario: Scenario, scene: SceneModel) -> None: ...
    def second(self, t_s: float, new: dict[str, pa.Table]) -> None: ...


DetectorMaker = Callable[[SceneModel, Perception, int, int], Detector | None]
"""As `sortie.perception.detectors.Constructor`; None flies without."""


def run_sortie(
    scenario: Scenario,
    policy: str | Policy | None = None,
    seed: int | None = None,
    *,
    replication: int = 0,
    progress: Callable[[float], None] | None = None,
    observer: Observer | None = None,
    detector_of: DetectorMaker = make_detector,
) -> SortieRecord:
    """Fly one sortie from 0 to `scenario.duration_s` (exclusive) and return its record.

    Args:
        scenario: the scenario to fly.
        policy: a policy's name, `file.py:function`, or a callable; None takes the scenario's own.
        seed: None takes the scenario's own.
        replication: number of the repetition; each has other random draws.
        progress: called with the simulated time once a simulated second.
        observer: gets the new rows once a simulated second.
        detector_of: makes the detector; the default makes the one that the scenario names.

    Returns:
        The record; equal (scenario, policy, seed, replication, version) give equal records and fingerprints.

    A scenario with `limits` flies in a process of its own, which ends there. With a `detector_of` of its caller it flies
    here, without limits.

    Raises:
        PolicyError: an unknown policy, or one that breaks its contract or fails.
        LimitError: the flight, or a call of the user's code in it, takes longer than `limits`.
        DiedError: the process of a flight with limits ended.
        RunError: the flight has limits, and the policy is a function that no other process can get.
    """
    if not scenario.limits.are_set or detector_of is not make_detector:
        return fly_here(
            scenario,
            policy,
            seed,
            replication=replication,
            progress=progress,
            observer=observer,
            detector_of=detector_of,
        )
    hear: dict[str, Callable[..., object]] = {}
    if progress is not None:
        hear["progress"] = progress
    if observer is not None:
        hear |= {"begin": observer.begin, "second": observer.second}
    work = partial(
        fly_here,
        scenario,
        policy,
        seed,
        replication=replication,
        progress=None if progress is None else Said("progress"),
        observer=None if observer is None else SimpleNamespace(begin=Said("begin"), second=Said("second")),
    )
    what = f"{scenario.name}, seed {scenario.seed if seed is None else seed}"
    return cast("SortieRecord", call_within(scenario.limits, what, work, hear))


def fly_here(
    scenario: Scenario,
    policy: str | Policy | None = None,
    seed: int | None = None,
    *,
    replication: int = 0,
    progress: Callable[[float], None] | None = None,
    observer: Any = None,
    detector_of: DetectorMaker = make_detector,
) -> SortieRecord:
    """Fly in this process, without the scenario's limits; else as `run_sortie`."""
    begin_s = perf_counter()
    LEFTOVERS.free()
    seed = scenario.seed if seed is None else seed
    name, policies = _policy(scenario, policy)
    own = loaded(scenario)
    parts = build(scenario, policies, seed, replication, detector_of)
    files = own_files(scenario, policy, parts.detector)  # as they are now: a file may be edited during the flight
    with cycles_searched_rarely():
        fly(parts, progress, observer)
    record = _collect(parts, policies, name, seed, replication)
    metrics = own_metrics(own, record)
    wall = {"wall_s": perf_counter() - begin_s, **record.wall}
    return dataclasses.replace(record, own_files=files, metrics=metrics, wall=wall)


@dataclass(frozen=True)
class Parts:
    """Everything that flies in one sortie, wired and not yet started. No part is replaced or completed afterwards."""

    scenario: Scenario
    env: simpy.Environment
    recorder: Recorder
    scene: SceneModel
    batteries: FleetBatteries
    air: Air
    world: World
    transport: Transport
    membership: Membership
    events: Events
    manoeuvres: Manoeuvres
    planners: Planners
    separation: Separation
    pilots: Sequence[Pilot]
    agents: Sequence[Agent]
    detector: Detector | None
    scorer: Scorer | None
    """None without a detector."""
    finding: FindingEachFrame | None
    """None where maps bring no boxes."""
    audit: Audit
    notes: AgentNotes
    journal: Journal | None
    """None where decisions are neither kept nor compared."""


def build(
    scenario: Scenario,
    policies: PolicyPlan,
    seed: int,
    replication: int = 0,
    detector_of: DetectorMaker = make_detector,
) -> Parts:
    """Wire the parts of a sortie, and put the scenario's events and changes of policy on its clock."""
    env, recorder = EventLoop(), Recorder(classes=len(scenario.perception.classes) > 1)
    drones, rules = range(scenario.fleet.drones), FleetRules.of(scenario)
    statuses = [
        DroneStatus(space, looks=not blind, codebook=codebook)
        for space, codebook, blind in zip(
            scenario.feature_spaces, codebooks(scenario), scenario.context_only, strict=True
        )
    ]
    table = PeerTable(len(drones), window_of(rules.detached_after_periods))
    memories = [PeerMemory(i, rules, statuses[i], table) for i in drones]

    nominal, traces = flown_motion(scenario.fleet, scenario.duration_s, scenario.frame_s, seed, replication)
    charges = {i: trace.battery for i, trace in traces.items() if trace.battery is not None}
    mains = {station.drone for station in scenario.fleet.ground if station.mains}
    batteries = FleetBatteries(scenario.fleet.batteries, scenario.fleet.overrides, len(drones), charges, mains)
    motion = Motion(nominal)
    settings, frame_s = air_settings(scenario), scenario.frame_s
    air = Air(env, settings, motion, seed=seed, replication=replication, frame_s=frame_s)
    mission = scenario.mission
    scene = SceneModel(
        scenario.perception.scene,
        mission.target,
        area_m(scenario.fleet, nominal.bounds_m()),
        mission.more_targets,
        scenario.perception.people,
    )
    plan = MissionPlan(mission, len(drones))
    gnss, drawn = scenario.fleet.clock.gnss, oscillators(scenario.fleet.clock, len(drones), seed, replication)
    clocks = [DroneClock(status, each, gnss=gnss) for status, each in zip(statuses, drawn, strict=True)]
    people = People(scenario, scene, recorder, (seed, replication))
    errors = sensor_errors(scenario, nominal.position_m, seed, replication)
    link_log = LinkLog(len(drones), recorder)
    world = World(
        env, scenario, statuses, motion, batteries, air, scene, plan, recorder, clocks, people, errors, link_log
    )
    key = group_key(seed) if scenario.context.authentication else None
    transport = Transport(
        env,
        air,
        memories,
        recorder,
        keys=None if key is None else {KEY_ID: key},
        rates_mbps=_rates_mbps(scenario),
        links=link_log,
    )

    audit, manoeuvres, viewpoints = Audit(env, recorder), Manoeuvres(scenario, world), None
    if policies.chooses_viewpoints:
        posed = any(trace.pose is not None for trace in traces.values())
        viewpoints = Viewpoints(scenario, world, posed_by_trace=posed)
        manoeuvres.serve(viewpoints)
    membership = Membership(scenario, world, manoeuvres)
    planners = Planners(scenario, world, membership, seed, replication)
    if planners.anyone:
        manoeuvres.serve(planners)
    journal = Journal(env) if scenario.record.views or scenario.record.disagreement else None
    pilots = [Pilot(i, policies, audit, viewpoints, planners if planners.anyone else None, journal) for i in drones]
    notes = AgentNotes(recorder, pilots)
    detector = mixed(detector_of, scene, scenario, seed, replication)
    looking = detector.looks if isinstance(detector, LooksByAnother) else detector
    own_boxes: OwnBoxesOf = TargetSeen(scene) if looking is None else OwnBoxes(looking, Ahead(scenario, world))
    tracking = FleetTracking(scenario, own_boxes, people)
    fusing, finding = Fusing(scenario, tracking), None
    if scenario.perception.maps_bring_boxes:
        finding = FindingEachFrame(env, scenario, detector, fusing, scene)
    agents = [
        Agent(
            env,
            memories[i],
            rules=rules,
            pilot=pilots[i],
            senses=OwnSenses(world, i, tracking, detector),
            modem=transport.modem(i),
            gate=Gate(),
            log=notes,
            sealer=None if key is None else Sealer(key, KEY_ID),
            phase_s=phase_of(scenario, seed, replication, i),
            finding=finding,
        )
        for i in drones
    ]
    scorer = None
    if detector is not None:
        turns = taking_turns(scenario, seed, replication)
        scorer = Scorer(env, scenario, detector, agents, recorder, world, fusing, people, turns)
    events = Events(Acted(scenario, world, transport, membership, clocks, seed, replication))
    schedule_policies(env, policies, pilots, scenario.frame_s)
    return Parts(
        scenario,
        env,
        recorder,
        scene,
        batteries,
        air,
        world,
        transport,
        membership,
        events,
        manoeuvres,
        planners,
        Separation(scenario, world),
        pilots,
        agents,
        detector,
        scorer,
        finding,
        audit,
        notes,
        journal,
    )


def stages(parts: Parts) -> tuple[Callable[[int], None], ...]:
    """What happens as a frame begins, in this order. The drones act afterwards, each at its own moment."""
    world = parts.world
    return (
        world.end_frame,
        world.begin_frame,
        parts.membership.renew,
        parts.manoeuvres.renew,
        parts.events.step,
        parts.separation.check,
        world.renew_links,
        world.write,
    )


def run_frames(parts: Parts, on_second: Callable[[float], None]) -> Generator[simpy.Event, Any, None]:
    """Begins each frame of the flight; `on_second` is called once a second and must not change anything."""
    env, scenario, all_stages = parts.env, parts.scenario, stages(parts)
    for frame in range(scenario.frames):
        yield env.timeout(max(0.0, frame * scenario.frame_s - env.now))
        for stage in all_stages:
            stage(frame)
        if parts.world.is_second(frame):
            on_second(env.now)


def fly(parts: Parts, progress: Callable[[float], None] | None = None, observer: Observer | None = None) -> None:
    """Start every process, run the clock to the end, and record what is still in flight."""
    world, scorer, recorder = parts.world, parts.scorer, parts.recorder

    def each_second(t_s: float) -> None:
        if progress is not None:
            progress(t_s)
        if observer is not None:
            if scorer is not None:
                scorer.flush()
            observer.second(t_s, recorder.take_new())
        recorder.spill()

    if observer is not None:
        observer.begin(parts.scenario, parts.scene)
    parts.env.process(run_frames(parts, each_second))
    for agent in parts.agents:
        agent.start()
    if scorer is not None:
        scorer.start()
    if parts.finding is not None:
        parts.finding.start(parts.agents)
    parts.env.run(until=parts.scenario.duration_s)
    world.drain()
    world.write_receptions()
    parts.transport.finish()
    parts.audit.finish()
    energy_j = parts.batteries.energy_j
    recorder.rows["energy"].extend((i, cause, j) for cause, each in energy_j.items() for i, j in enumerate(each))
    if scorer is not None:
        scorer.flush()
    each_second(parts.env.now)


def _collect(parts: Parts, policies: PolicyPlan, policy: str, seed: int, replication: int) -> SortieRecord:
    """The record of a sortie that has ended."""
    air, notes, recorder = parts.air, parts.notes, parts.recorder
    more = {} if parts.journal is None else _decided(parts.journal, policies, parts.scenario)
    if parts.scenario.publishes_rosters:
        more[rosters.TABLE] = notes.rosters.table()
    if parts.scenario.record.beliefs:
        more[beliefs.TABLE] = beliefs.table(*parts.world.believed())
    for name, table in more.items():
        recorder.spool.add_table(name, table)
    counters = {f.name: getattr(air.counters, f.name) for f in dataclasses.fields(air.counters) if f.name != "lost_to"}
    return SortieRecord(
        scenario=parts.scenario,
        policy=policy,
        seed=seed,
        replication=replication,
        version=code_version(),
        detector="none" if parts.detector is None else name_of(parts.detector),
        tables=recorder.finish(),
        totals={**notes.totals(), **parts.audit.totals(), **counters, "medium_busy_fraction": air.utilisation},
        calibration=parts.detector.calibration if isinstance(parts.detector, DetectsMany) else None,
        wall=notes.policy_eval_us(),
    )


def _decided(journal: Journal, policies: PolicyPlan, scenario: Scenario) -> dict[str, pa.Table]:
    """The tables of decisions that the scenario wants to be kept."""
    views, wanted = journal.tables(), scenario.record
    tables = {name: views[name] for name in VIEW_TABLES if wanted.views}
    if wanted.disagreement:
        known = policies.policies
        pairs = disagreement.measure(decisions(views), lambda d: known[d.policy].decide, scenario.frame_s)
        tables[disagreement.TABLE] = disagreement.pairs_table(pairs)
    return tables


def _rates_mbps(scenario: Scenario) -> Sequence[float]:
    """The channel's data rates by MCS; none where links are traced."""
    radio = scenario.radio
    return STANDARDS[radio.standard].rates_mbps[radio.bandwidth_mhz] if radio.trace is None else ()


def _policy(scenario: Scenario, policy: str | Policy | None) -> tuple[str, PolicyPlan]:
    """The policy's name in the record, and who decides when.

    The scenario's parameters, changes and policies of makes go with the scenario's own policy only; its invariants and
    shield with all.
    """
    section = scenario.policy
    if policy is None or policy == section.name:
        return section.name, plan_for(scenario)
    first = named_policy(policy, {}) if isinstance(policy, str) else NamedPolicy(name_of(policy), guarded(policy))
    return first.name, plan_of(section, first)
