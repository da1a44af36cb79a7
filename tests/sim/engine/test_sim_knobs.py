"""Every documented knob of a scenario acts: changing it changes the record, in the direction that physics or its definition says.

`TRAFFIC` and `SEEN` name, for every leaf field of the schema, another value and whatever else has to be set for the
field to matter. `knob_moves` names a figure of the record that must rise, fall or grow by a factor, or says why none
must. Tests hold both to the schema, so that a new field cannot come without its effect.
"""

from __future__ import annotations

import functools
import json
import types
import typing
from pathlib import Path

import pytest
from knob_moves import MOVES, UNSIGNED, figure
from pydantic import BaseModel
from recording_examples import record_flight
from sim_examples import example

from sortie.policies.contract import Descriptor, FleetView, TaskPhase
from sortie.policies.verification.kit.views import to_json
from sortie.scenarios.schema import FlightGroup, Scenario
from sortie.scenarios.schema.fleet import Make
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import SortieRecord

NOT_KNOBS = ("name", "description", "expect", "expect_decisions", "record", "limits", "metrics")
"""Words for people, what is asserted about the outcome or computed from the record, what is kept beside the record, and wall-clock time."""

IN_MAKES = {"fleet.makes.name", "fleet.makes.weights", "fleet.makes.codebook"}
"""Networks and codebooks of makes, which the name stands for; test_sim_makes.py."""

JAM = "events=[{kind: jam, at_s: 1, position_m: [0, 0, 60], power_dbm: 0, until_s: 4}]"
DROP = "events=[{kind: link_drop, at_s: 1, drone: 1, loss_db: 40, until_s: 4}]"
SPOOF = "events=[{kind: spoof, at_s: 1, drone: 1, until_s: 4}]"
LIE = "events=[{kind: lie, at_s: 1, drone: 1, until_s: 4}]"
LOST = "events=[{kind: drone_lost, at_s: 1, drone: 1}]"
JOINS, LEAVES = (f"events=[{{kind: {kind}, at_s: 1, drone: 1}}]" for kind in ("drone_joins", "drone_leaves"))
FAULT = "events=[{kind: battery_fault, at_s: 1, drone: 1, lost_fraction: 0.5}]"
CELL = "events=[{kind: cell_failure, at_s: 1, drone: 1}]"
DRIFT = "events=[{kind: clock_drift, at_s: 1, drone: 1, drift_ppm: -100000}]"
SKEW = "events=[{kind: clock_skew, at_s: 1, drone: 1, skew_s: -0.5}]"
TIRED = "fleet.overrides=[{drone: 1, initial_soc: 0.5, capacity_wh: 50, cell_resistance_mohm: 20, cycles: 10, payload_kg: 0.1}]"
MADE = "fleet.makes=[{name: slow, drones: [1], airframe: solo, battery: {}, computer: {}, camera: {}, antenna: isotropic, tx_power_dbm: 10, policy: all-4, policy_params: {received_budget: 0.2}, feature_space: theirs}]"
APART = "fleet.groups=[{drones: [1], formation: {altitude_m: 40}, route: {waypoints_m: [[0, 40]]}, legs: [{to_m: [60, 40], altitude_m: 60}]}]"
STATION = "fleet.ground=[{drone: 1, position_m: [0, 20, 3]}]"
FAR = "fleet.formation.spacing_m=150"  # links weak enough that rates, retries and repairs matter
HEAVY = ("policy.name=all-4", "policy.params={received_budget: 0.4}")  # fills the medium
CODED = ("policy.name=codes", "policy.params={received_budget: 0.2}")
QUIET_TOO = "radio.preamble_detection_dbm=-110"
BOXES = "fleet.battery.initial_soc=0.25"  # below 30 % the worked policy sends detections, reliably
FIXED = "mission.phases=[{at_s: 0, phase: track, region: {centre_m: [0, 0], radius_m: 32}}]"
OTHER = "mission.more_targets=[{waypoints_m: [[0, 0], [60, 0]], speed_mps: 3}]"
GROUP = "mission.groups=[{drones: [1, 2], phases: [{phase: search}, {at_s: 2, phase: track, target: 1, region: {radius_m: 32}}]}]"
TRACK = "mission.phases=[{at_s: 0, phase: track, region: {radius_m: 32}}]"
CROSSES = "perception.people=[{waypoints_m: [[0, -8], [0, 0]]}]"
WARM = "perception.thermal={remembers_s: 1}"
HOVER = "fleet.route.waypoints_m=[[0, 0]]"
TURN = "fleet.route.waypoints_m=[[-20, 0], [0, 0], [0, 60]]"

ASIDE = "mission.target.waypoints_m=[[-60, 60], [200, 60]]"
LOOKS = ("policy.name=vantage", "policy.params={received_budget: 0.02}", ASIDE, "fleet.formation.spacing_m=14")
SHARP = (*LOOKS, "fleet.viewpoints.acceleration_mps2=5", "fleet.viewpoints.reach_m=30")  # speed binds, not acceleration
FAST = (*LOOKS, "fleet.viewpoints.speed_mps=15", "fleet.viewpoints.acceleration_mps2=5")
FENCE = "fleet.viewpoints.fence_m=[-100, -50, 100, 150]"

BURSTS = "radio.bursts.good_to_bad=0.3"
GLOBE = (
    f"fleet.trace={Path(__file__).parent / 'globe.csv'}",
    "fleet.origin={latitude_deg: 47, longitude_deg: 8, altitude_m: 450}",
)
LINKS = str(Path(__file__).parent / "links.csv")
OWN = Path(__file__).parent / "own_models.py"
WALL, NOISY, POWER, CURVE, ALL_SEEN, STORM, DRIFTS = (
    f"{OWN}:{name}" for name in ("wall", "Noisy", "constant", "straight", "Omniscient", "Storm", "drifts")
)
GOES = f"fleet.mobility={OWN}:Goes"
UP = (
    "fleet.mobility_params={x_m: -60, z_m: 150}",
    GOES,
    "fleet.steering.altitude_m=[10, 400]",
    "fleet.steering.acceleration_mps2=8",
)
AHEAD = (GOES, "fleet.mobility_params={x_m: 300, only: 1}", "fleet.steering.acceleration_mps2=8")
MEET = (GOES, "fleet.mobility_params={x_m: -60, only: 1}", "fleet.steering.acceleration_mps2=8")
AWAY = "events=[{kind: position_fault, at_s: 1, drone: 1, offset_m: [0, 40, 0]}]"
ASTRAY = "events=[{kind: heading_fault, at_s: 1, drone: 1, offset_deg: 30}]"
SLOW = "events=[{kind: slow_perception, at_s: 1, drone: 1, extra_s: 0.02}]"
BLOCKED = "events=[{kind: camera_blocked, at_s: 1, until_s: 4, drone: 1}]"
LOST_GNSS = "events=[{kind: gnss_loss, at_s: 1, drone: 1}]"
STORMS = f"events=[{{kind: own, at_s: 1, until_s: 4, model: '{STORM}'}}]"

AT_2 = "policy.changes=[{at_s: 2, name: worst-2}]"
IN_TRACK = "policy.changes=[{phase: track, name: worst-2}]"
TOLD = "policy.changes=[{command: a, name: silence}, {command: b, name: best-2}, {command: a, name: worst-2}]"
TELL = "policy.commands=[{at_s: 2, command: a}]"


def tired(ego: int) -> str:
    """A view in which this drone has hardly any charge left, as a value of `--set`."""
    view = FleetView(ego, 0.1, {i: descriptor(i) for i in range(5)}, dict.fromkeys(range(5), 0.0))
    return json.dumps(to_json(view))


def descriptor(agent_id: int) -> Descriptor:
    at_m = (10.0 * agent_id, 0.0, 60.0)
    return Descriptor(
        0, agent_id, at_m, (0, 0, 0, 1), (0, 0, 0), 42.0, 0.15, 1, 1, (100.0,) * 4, bytes(64), 0, TaskPhase.SEARCH, None
    )


CROSSING = """
from sortie.policies.catalogue.baselines import everyone
from sortie.policies.contract import Reposition, looks_from

def nearer(view):
    me, middle = view.me, view.descriptors.get(0)
    if me is None or middle is None or view.ego == 0:
        return None
    x, y = ((a + b) / 2 for a, b in zip(me.position_m, middle.position_m[:2]))
    return Reposition(x, y)

@looks_from(nearer)
def decide(view):
    return everyone(view, received_budget=0.02)
"""
"""Everybody asks to be half as far from drone 0."""
TIRED_VIEW = [tired(0), tired(1)]
REPLAY = f"policy.replays=[{{at_s: 2, drone: 0, view: {TIRED_VIEW[0]}}}]"
STALE = json.dumps(json.loads(TIRED_VIEW[0]).replace('"age_s": 0.0', '"age_s": 0.5').replace("0.15", "0.5"))
SHOWN_STALE = f"policy.replays=[{{at_s: 2, drone: 0, view: {STALE}}}]"

# field: (new value, settings that both sorties get)
TRAFFIC: dict[str, tuple[str, tuple[str, ...]]] = {
    "seed": ("2", ()),
    "duration_s": ("5", ()),
    "fleet.drones": ("6", ()),
    "fleet.formation.shape": ("line", ()),
    "fleet.formation.spacing_m": ("25", ()),
    "fleet.formation.altitude_m": ("70", ()),
    "fleet.route.waypoints_m": ("[[-60, 0], [60, 20]]", ()),
    "fleet.route.speed_mps": ("6", ()),
    "fleet.route.turn_time_s": ("8", (TURN,)),
    "fleet.groups.drones": ("[1, 2]", (APART,)),
    "fleet.groups.formation": ("{altitude_m: 70}", (APART,)),
    "fleet.groups.route": ("{waypoints_m: [[0, 40]], speed_mps: 12}", (APART, "fleet.groups.0.climb_mps=10")),
    "fleet.groups.take_off": ("true", (APART,)),
    "fleet.groups.climb_mps": ("1", (APART,)),
    "fleet.groups.legs": ("[{to_m: [-60, 40]}]", (APART,)),
    "fleet.ground.drone": ("2", (STATION,)),
    "fleet.ground.position_m": ("[0, 20, 30]", (STATION,)),
    "fleet.ground.mains": ("false", (STATION,)),
    "fleet.ground.camera": ("true", (STATION,)),
    "fleet.groups.mobility": ("random_waypoint", ("fleet.groups=[{drones: [1]}]",)),
    "fleet.groups.mobility_params": (
        "{slowest_mps: 9.9}",
        ("fleet.groups=[{drones: [1], mobility: random_waypoint}]",),
    ),
    "fleet.mobility": ("random_waypoint", ()),
    "fleet.mobility_params": ("{fastest_mps: 20, slowest_mps: 19}", ("fleet.mobility=random_waypoint",)),
    "fleet.steering.reach_m": ("5", AHEAD),
    "fleet.steering.speed_mps": ("2", AHEAD),
    "fleet.steering.climb_mps": ("8", UP),
    "fleet.steering.acceleration_mps2": ("1", AHEAD),
    "fleet.steering.separation_m": ("15", MEET),
    "fleet.steering.altitude_m": ("[10, 62]", UP),
    "fleet.steering.fence_m": ("[-90, -60, -30, 60]", AHEAD),
    "fleet.motion.wind_mps": ("[5, 0]", ()),
    "fleet.motion.gust_sigma_mps": ("2", ()),
    "fleet.motion.gust_time_s": ("5", ()),
    "fleet.motion.pose_jitter_m": ("1", ()),
    "fleet.motion.pose_jitter_time_s": ("5", ()),
    "fleet.motion.pose_error_m": ("1", ()),
    "fleet.clock.gnss": ("false", ("fleet.clock.drift_ppm=40000",)),
    "fleet.clock.offset_s": ("0.3", ()),
    "fleet.clock.drift_ppm": ("40000", ("fleet.clock.gnss=false",)),
    "fleet.clock.drift_growth_ppm_per_min": ("100000", ("fleet.clock.gnss=false",)),
    "fleet.motion.heading_error_deg": ("5", (FIXED, "mission.target=null")),
    "fleet.viewpoints.reach_m": ("20", LOOKS),
    "fleet.viewpoints.speed_mps": ("6", SHARP),
    "fleet.viewpoints.acceleration_mps2": ("0.5", (*LOOKS, "fleet.viewpoints.speed_mps=15")),
    "fleet.viewpoints.separation_m": ("2", (*LOOKS, "policy.name=CROSSING")),
    "fleet.viewpoints.fence_m": ("[-100, -50, 100, 18]", (*FAST, FENCE)),
    "fleet.battery.capacity_wh": ("100", ()),
    "fleet.battery.cells": ("6", ()),
    "fleet.battery.initial_soc": ("0.8", ()),
    "fleet.battery.cell_resistance_mohm": ("20", ()),
    "fleet.battery.cell_model": (CURVE, ()),
    "fleet.battery.cell_params": ("{full_v: 4.4}", (f"fleet.battery.cell_model={CURVE}",)),
    "fleet.battery.drivetrain_efficiency": ("0.7", ()),
    "fleet.battery.avionics_w": ("12", ()),
    "fleet.battery.compute_idle_w": ("12", ()),
    "fleet.battery.compute_active_w": ("50", ()),
    "fleet.battery.radio_idle_w": ("3", ()),
    "fleet.battery.radio_tx_w": ("8", ()),
    "fleet.battery.landing_soc": ("0.3", ("fleet.battery.initial_soc=0.3005",)),
    "fleet.battery.cutoff_cell_v": ("4", ()),
    "fleet.battery.polarisation.resistance_mohm": ("5", ()),
    "fleet.battery.polarisation.time_s": ("5", ("fleet.battery.polarisation.resistance_mohm=5",)),
    "fleet.battery.ambient_c": ("5", ()),
    "fleet.battery.cycles": ("100", ()),
    "fleet.battery.life_cycles": ("500", ("fleet.battery.cycles=100",)),
    "fleet.camera.field_of_view_deg": ("50", ()),
    "fleet.camera.pitch_deg": ("30", ()),
    "fleet.camera.width_px": ("64", ()),
    "fleet.computer.cpu_cores": ("6", ()),
    "fleet.computer.decision_s": ("0.001", ()),
    "fleet.computer.payload_mbps": ("1000", ()),
    "fleet.computer.driving_cores": ("2", ()),
    "fleet.computer.fusion_s": ("0.001", ()),
    "fleet.airframe.mass_kg": ("2.2", ()),
    "fleet.airframe.payload_kg": ("0.3", ()),
    "fleet.airframe.disc_area_m2": ("0.4", ()),
    "fleet.airframe.figure_of_merit": ("0.6", ()),
    "fleet.airframe.tip_speed_mps": ("80", ()),
    "fleet.airframe.drag_area_m2": ("0.03", ()),
    "fleet.airframe.air_density_kgpm3": ("1.1", ()),
    "fleet.airframe.power_model": ("momentum", ()),
    "fleet.sensor": (DRIFTS, ()),
    "fleet.sensor_params": ("{mps: 20}", (f"fleet.sensor={DRIFTS}",)),
    "fleet.airframe.power_params": ("{power_w: 150}", (f"fleet.airframe.power_model={POWER}",)),
    "fleet.trace": ("TRACE", ()),
    "fleet.origin.latitude_deg": ("47.0004", GLOBE),
    "fleet.origin.longitude_deg": ("7.999", GLOBE),
    "fleet.origin.altitude_m": ("400", GLOBE),
    "fleet.makes.drones": ("[2]", (MADE,)),
    "fleet.makes.airframe": ("zeng_2019", (MADE,)),
    "fleet.makes.battery": ("{capacity_wh: 50}", (MADE,)),
    "fleet.makes.computer": ("{cpu_cores: 2}", (MADE,)),
    "fleet.makes.camera": ("{field_of_view_deg: 50}", (MADE,)),
    "fleet.makes.altitude_offset_m": ("20", (MADE,)),
    "fleet.makes.tx_power_dbm": ("5", (MADE,)),
    "fleet.makes.antenna": ("dipole", (MADE,)),
    "fleet.makes.compute_delay_s": ("0.08", (MADE,)),
    "fleet.makes.policy": ("silence", (MADE, "fleet.makes.0.policy_params={}")),
    "fleet.makes.policy_params": ("{received_budget: 0.1}", (MADE,)),
    "fleet.makes.feature_space": ("other", (MADE,)),
    "fleet.overrides.drone": ("2", (TIRED,)),
    "fleet.overrides.initial_soc": ("0.4", (TIRED,)),
    "fleet.overrides.capacity_wh": ("40", (TIRED,)),
    "fleet.overrides.cell_resistance_mohm": ("30", (TIRED,)),
    "fleet.overrides.cycles": ("200", (TIRED,)),
    "fleet.overrides.payload_kg": ("0.5", (TIRED,)),
    "mission.phases.at_s": ("2", ()),
    "mission.phases.target": ("1", (OTHER,)),
    "mission.more_targets.waypoints_m": ("[[0, 60], [90, 60]]", (OTHER, GROUP)),
    "mission.more_targets.speed_mps": ("8", (OTHER, GROUP)),
    "mission.groups.drones": ("[1]", (OTHER, GROUP)),
    "mission.groups.reserve": ("[2]", (OTHER, GROUP)),
    "mission.handover_soc": ("0.96", (OTHER, GROUP, "mission.groups.0.reserve=[2]")),
    "mission.descent_mps": ("6", ("events=[{kind: drone_leaves, at_s: 1, drone: 1}]",)),
    "mission.groups.phases.at_s": ("2.5", (OTHER, GROUP)),
    "mission.groups.phases.phase": ("return", (OTHER, GROUP)),
    "mission.groups.phases.region.radius_m": ("20", (OTHER, GROUP)),
    "mission.groups.phases.region.centre_m": ("[10, 0]", (OTHER, GROUP)),
    "mission.groups.phases.target": ("0", (OTHER, GROUP)),
    "mission.phases.phase": ("return", ()),
    "mission.phases.region.radius_m": ("20", ()),
    "mission.phases.region.centre_m": ("[10, 0]", (FIXED,)),
    "mission.target.waypoints_m": ("[[-60, 1.75], [200, 1.75]]", ()),
    "mission.target.speed_mps": ("8", ()),
    "radio.standard": ("ac", ()),
    "radio.carrier_ghz": ("2.4", ()),
    "radio.bandwidth_mhz": ("20", ()),
    "radio.tx_power_dbm": ("10", ()),
    "radio.noise_figure_db": ("10", ()),
    "radio.antenna": ("dipole", ()),
    "radio.path_loss": ("free_space", ()),
    "radio.path_loss_params": ("{wall_db: 3}", (f"radio.path_loss={WALL}",)),
    "radio.link": (NOISY, ()),
    "radio.link_params": ("{sigma_db: 3}", (f"radio.link={NOISY}",)),
    "radio.path_loss_exponent": ("2.6", ()),
    "radio.ground_roughness_m": ("5", ("radio.path_loss=two_ray", "fleet.formation.altitude_m=10", FAR)),
    "radio.shadowing_sigma_db": ("6", ()),
    "radio.shadowing_time_s": ("2", ()),
    "radio.shadowing_distance_m": ("20", ()),
    "radio.rician_k_db": ("3", ()),
    "radio.fading": ("frame", (FAR,)),
    "radio.preamble_detection_dbm": ("-60", (FAR,)),
    "radio.group_rate_mbps": ("12", ()),
    "radio.rate_control": ("minstrel", (FAR,)),
    "radio.context_class": ("best_effort", HEAVY),
    "radio.payload_class": ("video", ()),
    "radio.edca.voice.aifsn": ("5", HEAVY),
    "radio.edca.voice.cw_min": ("7", HEAVY),
    "radio.edca.voice.cw_max": ("31", (*HEAVY, "radio.payload_class=voice")),
    "radio.edca.video.aifsn": ("5", (*HEAVY, "radio.payload_class=video")),
    "radio.edca.video.cw_min": ("3", (*HEAVY, "radio.payload_class=video")),
    "radio.edca.video.cw_max": ("255", (*HEAVY, "radio.payload_class=video")),
    "radio.edca.best_effort.aifsn": ("9", HEAVY),
    "radio.edca.best_effort.cw_min": ("3", HEAVY),
    "radio.edca.best_effort.cw_max": ("15", HEAVY),
    "radio.edca.background.aifsn": ("3", (*HEAVY, "radio.payload_class=background")),
    "radio.edca.background.cw_min": ("3", (*HEAVY, "radio.payload_class=background")),
    "radio.edca.background.cw_max": ("15", (*HEAVY, "radio.payload_class=background")),
    "radio.rts": ("true", ()),
    "radio.block_ack_window": ("256", ()),
    "radio.retry_limit": ("0", (FAR,)),
    "radio.max_ampdu_frames": ("8", ()),
    "radio.fragment_bytes": ("8000", ()),
    "radio.framing": ("tiles", ()),
    "radio.relay_max_hops": ("3", (FAR, "fleet.formation.shape=line")),
    "radio.bursts.good_to_bad": ("0.3", ()),
    "radio.bursts.bad_to_good": ("0.9", (BURSTS,)),
    "radio.bursts.step_s": ("0.2", (BURSTS,)),
    "radio.bursts.loss_good": ("0.1", (BURSTS,)),
    "radio.bursts.loss_bad": ("0.5", (BURSTS,)),
    "radio.trace": (LINKS, ()),
    "radio.heartbeat_s": ("0.05", (BOXES, FAR, "radio.retry_limit=0", "radio.tx_power_dbm=0", QUIET_TOO)),
    "radio.nack_delay_s": ("0.02", (BOXES, FAR, "radio.retry_limit=0", "radio.tx_power_dbm=0", QUIET_TOO)),
    "context.rate_hz": ("5", ()),
    "context.degraded_after_periods": ("5", (LOST, "policy.name=all-4", "policy.params={received_budget: 0.02}")),
    "context.detached_after_periods": ("15", (LOST,)),
    "context.authentication": ("false", ()),
    "context.publish_every": ("2", ()),
    "context.form.grid_cells": ("8", ()),
    "context.form.grid_bits": ("1", ()),
    "context.form.number_bits": ("16", ()),
    "context.roster": ("true", ()),
    "context.trust": ("false", (LIE,)),
    "perception.detector": ("torch", ("duration_s=4",)),
    "perception.detector_params": ("{finds: false}", (f"perception.detector={ALL_SEEN}", "duration_s=4")),
    "perception.compute_delay_s": ("0.05", ()),
    "perception.tracking_rate_hz": ("5", (TRACK,)),
    "perception.people.waypoints_m": ("[[3, -8], [3, 0]]", (CROSSES,)),
    "perception.people.speed_mps": ("2", (CROSSES,)),
    "perception.people.begin_s": ("2", (CROSSES,)),
    "perception.thermal.field_of_view_deg": ("10", (CROSSES, WARM)),
    "perception.thermal.near_probability": ("0.2", (CROSSES, WARM)),
    "perception.thermal.half_range_m": ("60", (CROSSES, WARM)),
    "perception.thermal.range_width_m": ("40", (CROSSES, WARM)),
    "perception.thermal.false_alarms_per_min": ("60", (CROSSES, WARM)),
    "perception.thermal.position_error_m": ("4", (CROSSES, WARM)),
    "perception.thermal.remembers_s": ("0.2", (CROSSES, WARM)),
    "policy.name": ("deputies", ()),
    "policy.params": ("{rho: 0.1}", ()),
    "policy.dwell_s": ("0.6", ()),
    "policy.of_makes": ("false", (MADE,)),
    "policy.hysteresis": ("3", ("policy.name=adaptive", "policy.params={}", FAR)),
    "policy.changes.at_s": ("3", (AT_2,)),
    "policy.changes.phase": ("search", (IN_TRACK,)),
    "policy.changes.command": ("b", (TOLD, TELL)),
    "policy.changes.name": ("best-2", (AT_2,)),
    "policy.changes.params": ("{received_budget: 0.1}", (AT_2,)),
    "policy.commands.at_s": ("2.5", (TOLD, TELL)),
    "policy.commands.command": ("b", (TOLD, TELL)),
    "policy.commands.drones": ("[1]", (TOLD, TELL)),
    "policy.invariants": ("rate_hz <= 5", ()),
    "policy.shield": ("true", ("policy.invariants=rate_hz <= 5",)),
    "policy.replays.at_s": ("3", (REPLAY,)),
    "policy.replays.drone": ("1", (REPLAY,)),
    "policy.replays.read_by": ("drone", (SHOWN_STALE,)),
    "policy.replays.view": (TIRED_VIEW[0].replace("0.15", "0.5"), (REPLAY,)),
    "events.kind": ("battery_fault", ()),  # covered by every event below: the kind is what makes it one
    "events.at_s": ("2", (DROP,)),
    "events.until_s": ("3", (DROP,)),
    "events.drone": ("2", (DROP,)),
    "events.peer": ("2", (DROP,)),
    "events.loss_db": ("10", (DROP,)),
    "events.position_m": ("[300, 0, 60]", (JAM,)),
    "events.power_dbm": ("20", (JAM,)),
    "events.lost_fraction": ("0.2", (FAULT,)),
    "events.skew_s": ("-2", (SKEW,)),
    "events.drift_ppm": ("50000", (DRIFT,)),
    "events.model": (f"{OWN}:Calm", (STORMS,)),
    "events.params": ("{loss_db: 3}", (STORMS,)),
    "events.offset_m": ("[0, 0, 0]", (AWAY,)),
    "events.drift_mps": ("[0, 10, 0]", (AWAY,)),
    "events.offset_deg": ("0", (ASTRAY,)),
    "events.drift_degps": ("20", (ASTRAY,)),
    "events.position_walk_m": ("20", (LOST_GNSS,)),
    "events.extra_s": ("0.3", (SLOW,)),
    "events.about": ("battery", (LIE,)),
    "events.claim": ("little", (LIE,)),
    "events.attack": ("oversized", (SPOOF,)),
    "events.rate_hz": ("30", (SPOOF,)),
}

# These act through the detector, so their sorties fly with it, shortly.
SEEN: dict[str, tuple[str, tuple[str, ...]]] = {
    "perception.fusion": ("late", ()),
    "perception.fusion_params": ("{gain: 0}", (f"perception.fusion={OWN}:largest",)),
    "fleet.makes.detector": ("surrogate", (MADE,)),
    "fleet.ground.scored": ("true", (STATION,)),
    "perception.recording": ("OTHER", ("perception.detector=recorded", "perception.recording=RECORDING")),
    "perception.recorded_fusion": ("FUSION", ("perception.detector=recorded", "perception.recording=RECORDING")),
    "perception.weights": ("WEIGHTS", ()),
    "perception.codebook": ("CODEBOOK", CODED),
    "perception.code_bytes": ("3", CODED),
    "perception.precision": ("bfloat16", ()),
    "perception.sample_rate_hz": ("5", ()),
    "perception.egos": ("2", ()),
    "perception.fusion_delay_s": ("0.2", ()),
    "perception.max_age_s": ("0.05", ()),
    "perception.motion_compensation": ("false", ("perception.fusion_delay_s=0.042",)),
    "perception.score_threshold": ("0.5", ()),
    "perception.match_poses": ("true", ("policy.name=boxes", "policy.params={}")),
    "perception.maps_bring_boxes": ("true", ("policy.name=all-4", "policy.params={received_budget: 0.05}")),
    "perception.join": ("nms", ("policy.name=boxes", "policy.params={}")),
    "perception.unsent_cells": ("zero", ()),
    "perception.scene.seed": ("8", ()),
    "perception.scene.style": ("suburb", ()),
    "perception.scene.block_m": ("100", ()),
    "perception.scene.building_density": ("0.1", ()),
    "perception.scene.building_height_m": ("20", ()),
    "perception.scene.tree_density": ("1", ()),
    "perception.scene.parked_density": ("0.9", ()),
    "perception.scene.moving_cars_per_km": ("40", ()),
    "perception.scene.moving_speed_mps": ("15", ()),
    "perception.scene.trucks": ("0.8", ()),
    "perception.scene.sun_azimuth_deg": ("30", ()),
    "perception.scene.sun_elevation_deg": ("20", ()),
    "perception.scene.overcast": ("1", ()),
    "perception.scene.brightness": ("0.4", ()),
}


def leaves(model: type[BaseModel], prefix: str = "") -> set[str]:
    """Dotted names of every leaf field; list items share their list's name, union members their field's."""
    found: set[str] = set()
    for name, field in model.model_fields.items():
        inner = [] if model in (Make, FlightGroup) else sections(field.annotation)  # they stand whole for the fleet's
        for section in inner:
            found |= leaves(section, f"{prefix}{name}.")
        if not inner:
            found.add(f"{prefix}{name}")
    return found


def sections(annotation: object) -> list[type[BaseModel]]:
    """The sections inside a field's type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is not None:
        return [s for part in typing.get_args(annotation) for s in sections(part)]
    return []


def test_the_table_names_every_field_of_the_schema() -> None:
    knobs = {f for f in leaves(Scenario) if f.split(".")[0] not in NOT_KNOBS} - IN_MAKES
    assert knobs == set(TRAFFIC) | set(SEEN)


def test_every_knob_has_a_direction_or_a_reason_for_none() -> None:
    assert MOVES.keys() | UNSIGNED.keys() == {f for f in (*TRAFFIC, *SEEN) if f != "events.kind"}
    assert not MOVES.keys() & UNSIGNED.keys()


@functools.cache
def flown(*settings: str) -> SortieRecord:
    """Many knobs are changed from one and the same sortie."""
    return run_sortie(example(*settings))


def assert_moved(field: str, before: SortieRecord, after: SortieRecord) -> None:
    """The figure that the knob acts on has moved as it must."""
    if field in MOVES:
        name, way = MOVES[field]
        a, b = figure(name, before), figure(name, after)
        if isinstance(way, str):
            assert (b > a) if way == ">" else (b < a), f"{name}: {a:.6g} before, {b:.6g} after, must be {way}"
        else:
            assert b == pytest.approx(way * a, rel=0.02), (
                f"{name}: {a:.6g} before, {b:.6g} after, must be {way:g} times it"
            )


def place(field: str, shared: tuple[str, ...]) -> str:
    """Where `--set` finds the field: lists are addressed by the item that the settings put there."""
    last_phase = 0 if FIXED in shared else 1
    return (
        field.replace("fleet.overrides.", "fleet.overrides.0.")
        .replace("fleet.makes.", "fleet.makes.0.")
        .replace("fleet.groups.", "fleet.groups.0.")
        .replace("fleet.ground.", "fleet.ground.0.")
        .replace("perception.people.", "perception.people.0.")
        .replace("mission.groups.phases.", "mission.groups.phases.1.")
        .replace("mission.groups.", "mission.groups.0.")
        .replace("mission.more_targets.", "mission.more_targets.0.")
        .replace("mission.phases.", f"mission.phases.{last_phase}.")
        .replace("events.", "events.0.")
        .replace("policy.changes.", "policy.changes.0.")
        .replace("policy.commands.", "policy.commands.0.")
        .replace("policy.replays.", "policy.replays.0.")
    )


@pytest.mark.parametrize("field", [f for f in TRAFFIC if f != "events.kind"])
def test_a_knob_changes_the_record(field: str, tmp_path: Path) -> None:
    value, shared = TRAFFIC[field]
    if value == "TRACE":
        value = str(tmp_path / "trace.csv")
        Path(value).write_text("t_s,drone,soc\n0,1,0.7\n6,1,0.5\n")
    change = [f"{place(field, shared)}={value}"]
    if field == "policy.replays.drone":
        change.append(f"policy.replays.0.view={TIRED_VIEW[1]}")  # a view is its drone's own
    if "policy.name=CROSSING" in shared:
        Path(tmp_path / "crossing.py").write_text(CROSSING)
        shared = (*shared, f"policy.name={tmp_path / 'crossing.py'}:decide", "policy.params={}")
    before, after = flown(*shared), run_sortie(example(*shared, *change))
    assert after.fingerprint != before.fingerprint
    assert_moved(field, before, after)


@pytest.mark.parametrize(
    "event", [JAM, DROP, SPOOF, LIE, LOST, JOINS, LEAVES, FAULT, CELL, SKEW, STORMS, AWAY, ASTRAY, SLOW, BLOCKED]
)
def test_every_kind_of_event_changes_the_record(event: str) -> None:
    assert flown(event).fingerprint != flown().fingerprint


SHORT = (
    "perception.detector=torch",
    "duration_s=2.5",
    "mission.phases=[{at_s: 0, phase: search}]",
    "policy.params={rho: 0.05}",
)


@pytest.mark.slow
@pytest.mark.parametrize("field", SEEN)
def test_a_knob_of_perception_changes_the_record(field: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    value, shared = SEEN[field]
    value, *shared = recorded(tmp_path_factory.mktemp("recorded"), value, *shared)
    before = flown(*SHORT, *shared)
    if value == "WEIGHTS":
        value = str(other_weights(tmp_path_factory.mktemp("weights") / "other.safetensors"))
    if value == "CODEBOOK":
        value = str(other_codebook(tmp_path_factory.mktemp("codebook") / "other.safetensors"))
    change = f"{place(field, tuple(shared))}={value}"
    after = run_sortie(example(*SHORT, *shared, change))
    assert after.fingerprint != before.fingerprint
    assert_moved(field, before, after)


def recorded(folder: Path, *texts: str) -> list[str]:
    """The texts with the names of a recording of the short flight, another of it, and a fusion put in."""
    files = {name: folder / name.lower() for name in ("RECORDING", "OTHER", "FUSION")}
    if any(name in text for text in texts for name in files):
        flight = example(*SHORT)
        record_flight(flight, files["RECORDING"].with_suffix(".npz"))
        record_flight(flight, files["OTHER"].with_suffix(".npz"), lower=0.3)
        code = "import numpy as np\n\ndef deaf(agents, takes_part, weight):\n    return np.zeros((0, 6))\n"
        files["FUSION"].with_suffix(".py").write_text(code)
    for name, suffix in (("RECORDING", ".npz"), ("OTHER", ".npz"), ("FUSION", ".py:deaf")):
        texts = tuple(text.replace(name, f"{files[name]}{suffix}") for text in texts)
    return list(texts)


def other_codebook(path):  # type: ignore[no-untyped-def]
    """The shipped codebook with its entries in another order, so that a code's bytes mean coarser cells."""
    from dataclasses import replace

    from sortie.perception.network.checkpoint import load_weights
    from sortie.perception.network.codebook import load_codebook, save_codebook
    from sortie.perception.network.detector import SHIPPED_WEIGHTS
    from sortie.scenarios.shipped import CODEBOOK, beside

    codebook = load_codebook(beside(SHIPPED_WEIGHTS, CODEBOOK), load_weights(SHIPPED_WEIGHTS))
    save_codebook(replace(codebook, stages=codebook.stages.flip(0)), path, {})
    return path


def other_weights(path):  # type: ignore[no-untyped-def]
    """The shipped weights with a more hesitant head."""
    import torch

    from sortie.perception.network.checkpoint import load_weights, save_weights
    from sortie.perception.network.detector import SHIPPED_WEIGHTS

    net = load_weights(SHIPPED_WEIGHTS)
    with torch.no_grad():
        net.head.out.bias[0] -= 1.0
    save_weights(net, path, {})
    return path
