"""Fly a sortie: the one place that wires the rooms together, on one SimPy clock."""

from __future__ import annotations

import dataclasses
import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

import pyarrow as pa
import simpy

from sortie.fleet.agent import Agent, PlaneRules
from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.flight.frames import up_vector
from sortie.fleet.flight.motion import fly
from sortie.fleet.messages.auth import Sealer
from sortie.fleet.messages.compact import Form
from sortie.fleet.traces import follow, read_traces
from sortie.perception.detectors import Detector, DetectsMany, make_detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture
from sortie.policies.contract import Disc, Policy
from sortie.radio import Air
from sortie.radio.rates import STANDARDS
from sortie.radio.settings import AirSettings
from sortie.scenarios.schema import Perception, Scenario
from sortie.scenarios.streams import stream
from sortie.sim.engine.choreography import Choreography
from sortie.sim.engine.events import group_key, schedule
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.pilot import Audit, Named, Pilot, PolicyPlan, named, plan_of, schedule_policies
from sortie.sim.engine.scoring import Scorer
from sortie.sim.engine.transport import Ether
from sortie.sim.engine.world import World, route_bounds
from sortie.sim.identity import code_version
from sortie.sim.results.record import AgentNotes, Recorder, SortieRecord

KEY_ID = 1
PHASE_SHARE, PHASE_S = 0.1, 0.01
"""Drones act within the first tenth of a frame, and within its first 10 ms, each at its own moment: clocks disciplined,
not locked."""


class Observer(Protocol):
    """Watches a sortie while it flies; nothing that it does changes the record."""

    def begin(self, scenario: Scenario, scene: SceneModel) -> None: ...
    def second(self, t_s: float, new: dict[str, pa.Table]) -> None: ...


@contextmanager
def _not_collecting() -> Iterator[None]:
    """No look for reference cycles in a flight: it makes none, and every look goes over its record."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


DetectorOf = Callable[[SceneModel, Perception, int, int], Detector | None]
"""As `sortie.perception.detectors.Constructor`; None flies without."""


@_not_collecting()
def run_sortie(
    scenario: Scenario,
    policy: str | Policy | None = None,
    seed: int | None = None,
    *,
    replication: int = 0,
    progress: Callable[[float], None] | None = None,
    observer: Observer | None = None,
    detector_of: DetectorOf = make_detector,
) -> SortieRecord:
    """Fly one sortie from 0 to `scenario.duration_s` (exclusive) and return its record.

    Args:
        scenario: what is to be flown.
        policy: a policy's name, `file.py:function`, or a callable; None takes the scenario's own.
        seed: None takes the scenario's own.
        replication: another draw of everything random, for campaigns.
        progress: called with the simulated time once a simulated second.
        observer: gets the new rows once a simulated second.
        detector_of: makes the detector; left out, the one that the scenario names.

    Returns:
        The record; equal (scenario, policy, seed, replication, version) give equal records and fingerprints.

    Raises:
        PolicyError: an unknown policy, or one that breaks its contract.
    """
    begin_s = time.perf_counter()
    seed = scenario.seed if seed is None else seed
    name, flight_plan = _policy(scenario, policy)
    n, config, air_of = scenario.fleet.drones, scenario.perception, scenario.radio
    env, recorder = simpy.Environment(), Recorder()

    motion = fly(scenario.fleet, scenario.duration_s, scenario.frame_s, seed, replication)
    traces = {} if scenario.fleet.trace is None else read_traces(scenario.fleet.trace, n)
    motion = follow(motion, traces, scenario.frame_s)
    charges = {i: trace.battery for i, trace in traces.items() if trace.battery is not None}
    batteries = FleetBatteries(scenario.fleet.battery, scenario.fleet.overrides, n, charges)
    air = Air(
        env,
        AirSettings.of(scenario.radio.model_dump(exclude={"framing"})),
        motion.position_m,
        seed=seed,
        replication=replication,
        frame_s=scenario.frame_s,
        up=up_vector(motion.orientation_xyzw),
    )
    scene = SceneModel(config.scene, scenario.mission.target, route_bounds(motion))
    plan = MissionPlan(scenario.mission)
    world = World(env, scenario, motion, batteries, air, scene, plan, recorder)
    keys = {KEY_ID: group_key(seed)} if scenario.context.authentication else None
    rates_mbps = STANDARDS[air_of.standard].rates_mbps[air_of.bandwidth_mhz] if air_of.trace is None else ()
    ether = Ether(air, recorder, keys=keys, rates_mbps=rates_mbps)
    detector = detector_of(scene, config, seed, replication)

    def count_boxes(capture: Capture, roi: Disc | None) -> int:
        assert detector is not None  # noqa: S101
        return detector.count_boxes(capture, roi)

    rules = PlaneRules(
        period_s=scenario.frame_s,
        frames=scenario.frames,
        degraded_after_periods=scenario.context.degraded_after_periods,
        detached_after_periods=scenario.context.detached_after_periods,
        dwell_s=scenario.policy.dwell_s,
        hysteresis=scenario.policy.hysteresis,
        compute_delay_s=config.compute_delay_s,
        tile_limit_bytes=scenario.radio.fragment_bytes if scenario.radio.framing == "tiles" else None,
        trust=scenario.context.trust,
        publish_every=scenario.context.publish_every,
        form=Form(**scenario.context.form.model_dump()),
    )
    audit = Audit(env, recorder)
    choreography: Choreography | None = None
    if flight_plan.looks:
        posed = any(trace.pose is not None for trace in traces.values())
        choreography = Choreography(scenario, world, posed_by_trace=posed)
        world.before_frame = choreography.renew
    wish = None if choreography is None else choreography.ask
    pilots = [Pilot(i, flight_plan, audit, wish) for i in range(n)]
    notes = AgentNotes(recorder, lambda drone: pilots[drone].policy.name)
    agents = [
        Agent(
            env,
            i,
            rules=rules,
            policy=pilots[i],
            senses=world.senses(i, count_boxes if detector is not None else None),
            modem=ether.modem(i),
            log=notes,
            sealer=None if keys is None else Sealer(keys[KEY_ID], KEY_ID),
            phase_s=min(PHASE_SHARE * scenario.frame_s, PHASE_S) * stream(seed, replication, i, "phase").random(),
            handshake_bytes=flight_plan.first.handshake_bytes,
        )
        for i in range(n)
    ]
    world.agents = ether.agents = agents

    scorer = None if detector is None else Scorer(env, scenario, detector, agents, recorder)

    def each_second(t_s: float) -> None:
        if progress is not None:
            progress(t_s)
        if observer is not None:
            if scorer is not None:
                scorer.flush()
            observer.second(t_s, recorder.take_new())

    world.on_second = each_second
    if observer is not None:
        observer.begin(scenario, scene)
    schedule(scenario, world, ether, seed=seed, replication=replication)
    schedule_policies(env, flight_plan, pilots, agents, scenario.frame_s)
    world.start()
    for agent in agents:
        agent.start()
    if scorer is not None:
        scorer.start()

    env.run(until=scenario.duration_s)
    world.drain()
    ether.finish()
    recorder.rows["energy"].extend(
        (i, cause, joules) for cause, per_drone in batteries.energy_j.items() for i, joules in enumerate(per_drone)
    )
    if scorer is not None:
        scorer.flush()
    each_second(env.now)
    tables = recorder.tables()
    recorder.rows.clear()  # agents and air hold one another, so that nothing else lets go of the rows at once
    return SortieRecord(
        scenario=scenario,
        policy=name,
        seed=seed,
        replication=replication,
        version=code_version(),
        tables=tables,
        totals={**notes.totals(), **audit.totals(), **_air_totals(air)},
        calibration=detector.calibration if isinstance(detector, DetectsMany) else None,
        wall={"wall_s": time.perf_counter() - begin_s, **notes.policy_eval_us()},
    )


def _air_totals(air: Air) -> dict[str, float]:
    counters = {f.name: getattr(air.counters, f.name) for f in dataclasses.fields(air.counters)}
    return {**counters, "medium_busy_fraction": air.utilisation}


def _policy(scenario: Scenario, policy: str | Policy | None) -> tuple[str, PolicyPlan]:
    """The policy's name in the record, and who decides when.

    The scenario's parameters and changes go with the scenario's own policy only; its invariants and shield with all.
    """
    section = scenario.policy
    if policy is None or policy == section.name:
        return section.name, plan_of(section)
    first = named(policy, {}) if isinstance(policy, str) else Named(getattr(policy, "__name__", "policy"), policy)
    return first.name, plan_of(section, first)
