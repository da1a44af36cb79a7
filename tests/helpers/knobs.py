"""Every knob of a scenario: another value, the figure of the record that it must move, and which way.

`knob_figures` has the figures. Where none must move in one direction, the reason stands in the figure's place.
"""

from __future__ import annotations

import json

from places import ROOT

from sortie.policies.contract import Descriptor, FleetView, TaskPhase
from sortie.policies.verification.kit.views import to_json

HERE = ROOT / "tests" / "sim" / "engine"
CHANCE = "another draw of chance"
KIND = "another kind, neither more nor less"
BELIEF = "what a drone believes is in no table"
CONTENTION = "what one class of traffic gains another loses"
LIGHT = "what a network makes of other pictures is not known beforehand"

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
TIRED = (
    "fleet.overrides=[{drone: 1, initial_soc: 0.5, capacity_wh: 50, cell_resistance_mohm: 20, cycles: 10, "
    "payload_kg: 0.1}]"
)
MADE = (
    "fleet.makes=[{name: slow, drones: [1], airframe: solo, battery: {}, computer: {}, camera: {}, antenna: isotropic, "
    "tx_power_dbm: 10, policy: all-4, policy_params: {received_budget: 0.2}, feature_space: theirs}]"
)
APART = (
    "fleet.groups=[{drones: [1], formation: {altitude_m: 40}, route: {waypoints_m: [[0, 40]]}, "
    "legs: [{to_m: [60, 40], altitude_m: 60}]}]"
)
CLIMBS = "fleet.groups.0.climb_mps=10"
GROUP_OF_1 = "fleet.groups=[{drones: [1]}]"
GROUP_WANDERS = "fleet.groups=[{drones: [1], mobility: random_waypoint}]"
WANDERS = "fleet.mobility=random_waypoint"
STATION = "fleet.ground=[{drone: 1, position_m: [0, 20, 3]}]"
FAR = "fleet.formation.spacing_m=150"  # links weak enough that rates, retries and repairs matter
HEAVY = ("policy.name=all-4", "policy.params={received_budget: 0.4}")  # fills the medium
LOW = ("radio.path_loss=two_ray", "fleet.formation.altitude_m=10")
SMALL_MAPS = ("policy.name=all-4", "policy.params={received_budget: 0.02}")
CODED = ("policy.name=codes", "policy.params={received_budget: 0.2}")
QUIET_TOO = "radio.preamble_detection_dbm=-110"
BOXES = "fleet.battery.initial_soc=0.25"  # below 30 % the worked policy sends detections, reliably
REPAIRED = (BOXES, FAR, "radio.retry_limit=0", "radio.tx_power_dbm=0", QUIET_TOO)
FIXED = "mission.phases=[{at_s: 0, phase: track, region: {centre_m: [0, 0], radius_m: 32}}]"
OTHER = "mission.more_targets=[{waypoints_m: [[0, 0], [60, 0]], speed_mps: 3}]"
GROUP = (
    "mission.groups=[{drones: [1, 2], phases: [{phase: search}, "
    "{at_s: 2, phase: track, target: 1, region: {radius_m: 32}}]}]"
)
TRACK = "mission.phases=[{at_s: 0, phase: track, region: {radius_m: 32}}]"
CROSSES = "perception.people=[{waypoints_m: [[0, -8], [0, 0]]}]"
WARM = "perception.thermal={remembers_s: 1}"
TURN = "fleet.route.waypoints_m=[[-20, 0], [0, 0], [0, 60]]"

ASIDE = "mission.target.waypoints_m=[[-60, 60], [200, 60]]"
LOOKS = ("policy.name=vantage", "policy.params={received_budget: 0.02}", ASIDE, "fleet.formation.spacing_m=14")
SHARP = (*LOOKS, "fleet.viewpoints.acceleration_mps2=5", "fleet.viewpoints.reach_m=30")  # speed binds, not acceleration
FAST = (*LOOKS, "fleet.viewpoints.speed_mps=15", "fleet.viewpoints.acceleration_mps2=5")
FENCE = "fleet.viewpoints.fence_m=[-100, -50, 100, 150]"

BURSTS = "radio.bursts.good_to_bad=0.3"
GLOBE = (
    f"fleet.trace={HERE / 'globe.csv'}",
    "fleet.origin={latitude_deg: 47, longitude_deg: 8, altitude_m: 450}",
)
LINKS = str(HERE / "links.csv")
OWN = HERE / "own_models.py"
WALL, NOISY, POWER, CURVE, ALL_SEEN, STORM, DRIFTS = (
    f"{OWN}:{name}" for name in ("wall", "Noisy", "constant", "straight", "Omniscient", "Storm", "drifts")
)
GOES = f"fleet.mobility={OWN}:Goes"
CROSSING = f"policy={{name: '{OWN}:crossing'}}"  # everybody asks to be half as far from drone 0
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
OMNISCIENT = (f"perception.detector={ALL_SEEN}", "duration_s=4")
STORMS = f"events=[{{kind: own, at_s: 1, until_s: 4, model: '{STORM}'}}]"

EVENTS = (JAM, DROP, SPOOF, LIE, LOST, JOINS, LEAVES, FAULT, CELL, SKEW, DRIFT, AWAY, ASTRAY, SLOW, BLOCKED, LOST_GNSS)

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


TIRED_VIEW = [tired(0), tired(1)]
REPLAY = f"policy.replays=[{{at_s: 2, drone: 0, view: {TIRED_VIEW[0]}}}]"
STALE = json.dumps(json.loads(TIRED_VIEW[0]).replace('"age_s": 0.0', '"age_s": 0.5').replace("0.15", "0.5"))
SHOWN_STALE = f"policy.replays=[{{at_s: 2, drone: 0, view: {STALE}}}]"

Knob = tuple[object, ...]
"""Another value; the figure that it moves, or why none must; `<`, `>`, or how many times as much; what both have."""

TRAFFIC: dict[str, Knob] = {
    "seed": ("2", CHANCE, None),
    "duration_s": ("5", "descriptors", 5 / 6),
    "fleet.drones": ("6", "descriptors", 6 / 5),
    "fleet.formation.shape": ("line", "distance to drone 0", ">"),
    "fleet.formation.spacing_m": ("25", "distance to drone 0", ">"),
    "fleet.formation.altitude_m": ("70", "height", 7 / 6),
    "fleet.route.waypoints_m": ("[[-60, 0], [60, 20]]", "north", ">"),
    "fleet.route.speed_mps": ("6", "ground speed", 6 / 5),
    "fleet.route.turn_time_s": ("8", "fastest turn", "<", TURN),
    "fleet.groups.drones": ("[1, 2]", "height", "<", APART),
    "fleet.groups.formation": ("{altitude_m: 70}", "height of 1", ">", APART),
    "fleet.groups.route": ("{waypoints_m: [[0, 40]], speed_mps: 12}", "ground speed", ">", APART, CLIMBS),
    "fleet.groups.take_off": ("true", "height of 1", "<", APART),
    "fleet.groups.climb_mps": ("1", "height of 1", "<", APART),
    "fleet.groups.legs": ("[{to_m: [-60, 40]}]", "height of 1", "<", APART),
    "fleet.ground.drone": ("2", "height of 1", ">", STATION),
    "fleet.ground.position_m": ("[0, 20, 30]", "height of 1", 10.0, STATION),
    "fleet.ground.mains": ("false", "charge of 1", "<", STATION),
    "fleet.ground.camera": ("true", "cells seen by 1", ">", STATION),
    "fleet.groups.mobility": ("random_waypoint", KIND, None, GROUP_OF_1),
    "fleet.groups.mobility_params": ("{slowest_mps: 9.9}", "ground speed", ">", GROUP_WANDERS),
    "fleet.mobility": ("random_waypoint", KIND, None),
    "fleet.mobility_params": ("{fastest_mps: 20, slowest_mps: 19}", "ground speed", ">", WANDERS),
    "fleet.steering.reach_m": ("5", "ground speed", "<", *AHEAD),
    "fleet.steering.speed_mps": ("2", "ground speed", "<", *AHEAD),
    "fleet.steering.climb_mps": ("8", "height", ">", *UP),
    "fleet.steering.acceleration_mps2": ("1", "ground speed", "<", *AHEAD),
    "fleet.steering.separation_m": ("15", "closest pair", ">", *MEET),
    "fleet.steering.altitude_m": ("[10, 62]", "height", "<", *UP),
    "fleet.steering.fence_m": ("[-90, -60, -30, 60]", "ground speed", "<", *AHEAD),
    "fleet.motion.wind_mps": ("[5, 0]", "rotor", ">"),
    "fleet.motion.gust_sigma_mps": ("2", "rates of roll and pitch", ">"),
    "fleet.motion.gust_time_s": ("5", "rates of roll and pitch", "<"),
    "fleet.motion.pose_jitter_m": ("1", "height's spread", 5 / 2),
    "fleet.motion.pose_jitter_time_s": ("5", "vertical speed", "<"),
    "fleet.motion.pose_error_m": ("1", BELIEF, None),
    "fleet.clock.gnss": ("false", "error of stamps", ">", "fleet.clock.drift_ppm=40000"),
    "fleet.clock.offset_s": ("0.3", "error of stamps", ">"),
    "fleet.clock.drift_ppm": ("40000", "error of stamps", ">", "fleet.clock.gnss=false"),
    "fleet.clock.drift_growth_ppm_per_min": ("100000", "error of stamps", ">", "fleet.clock.gnss=false"),
    "fleet.motion.heading_error_deg": ("5", BELIEF, None, FIXED, "mission.target=null"),
    "fleet.viewpoints.reach_m": ("20", "longest move", "<", *LOOKS),
    "fleet.viewpoints.speed_mps": ("6", "north", ">", *SHARP),
    "fleet.viewpoints.acceleration_mps2": ("0.5", "north", "<", *LOOKS, "fleet.viewpoints.speed_mps=15"),
    "fleet.viewpoints.separation_m": ("2", "closest pair", "<", *LOOKS, CROSSING),
    "fleet.viewpoints.fence_m": ("[-100, -50, 100, 18]", "farthest north", "<", *FAST, FENCE),
    "fleet.battery.capacity_wh": ("100", "charge", "<"),
    "fleet.battery.cells": ("6", "voltage", ">"),
    "fleet.battery.initial_soc": ("0.8", "charge", "<"),
    "fleet.battery.cell_resistance_mohm": ("20", "ohmic", ">"),
    "fleet.battery.cell_model": (CURVE, "voltage", ">"),
    "fleet.battery.cell_params": ("{full_v: 4.4}", "voltage", ">", f"fleet.battery.cell_model={CURVE}"),
    "fleet.battery.drivetrain_efficiency": ("0.7", "rotor", 8 / 7),
    "fleet.battery.avionics_w": ("12", "avionics", 3 / 2),
    "fleet.battery.compute_idle_w": ("12", "compute", ">"),
    "fleet.battery.compute_active_w": ("50", "compute", ">"),
    "fleet.battery.radio_idle_w": ("3", "radio", ">"),
    "fleet.battery.radio_tx_w": ("8", "radio", ">"),
    "fleet.battery.landing_soc": ("0.3", "flying", "<", "fleet.battery.initial_soc=0.3005"),
    "fleet.battery.cutoff_cell_v": ("4", "flying", "<"),
    "fleet.battery.polarisation.resistance_mohm": ("5", "ohmic", ">"),
    "fleet.battery.polarisation.time_s": ("5", "ohmic", ">", "fleet.battery.polarisation.resistance_mohm=5"),
    "fleet.battery.ambient_c": ("5", "ohmic", ">"),
    "fleet.battery.cycles": ("100", "charge", "<"),
    "fleet.battery.life_cycles": ("500", "charge", ">", "fleet.battery.cycles=100"),
    "fleet.camera.field_of_view_deg": ("50", "cells seen", "<"),
    "fleet.camera.pitch_deg": ("30", "the cells that it wins ahead it loses below", None),
    "fleet.camera.width_px": ("64", "cells seen well", "<"),
    "fleet.computer.cpu_cores": ("6", "processor left", "<"),
    "fleet.computer.decision_s": ("0.001", "processor left", "<"),
    "fleet.computer.payload_mbps": ("1000", "processor left", "<"),
    "fleet.computer.driving_cores": ("2", "processor left", "<"),
    "fleet.computer.fusion_s": ("0.001", "accelerator left", "<"),
    "fleet.airframe.mass_kg": ("2.2", "rotor", ">"),
    "fleet.airframe.payload_kg": ("0.3", "rotor", ">"),
    "fleet.airframe.disc_area_m2": ("0.4", "rotor", ">"),
    "fleet.airframe.figure_of_merit": ("0.6", "rotor", "<"),
    "fleet.airframe.tip_speed_mps": ("80", "rotor", ">"),
    "fleet.airframe.drag_area_m2": ("0.03", "rotor", ">"),
    "fleet.airframe.air_density_kgpm3": ("1.1", "rotor", ">"),
    "fleet.airframe.power_model": ("momentum", KIND, None),
    "fleet.sensor": (DRIFTS, BELIEF, None),
    "fleet.sensor_params": ("{mps: 20}", BELIEF, None, f"fleet.sensor={DRIFTS}"),
    "fleet.airframe.power_params": ("{power_w: 150}", "rotor", 1 / 2, f"fleet.airframe.power_model={POWER}"),
    "fleet.trace": ("TRACE", "charge of 1", "<"),
    "fleet.origin.latitude_deg": ("47.0004", "north", "<", *GLOBE),
    "fleet.origin.longitude_deg": ("7.999", "distance to drone 0", ">", *GLOBE),
    "fleet.origin.altitude_m": ("400", "height of 1", ">", *GLOBE),
    "fleet.makes.drones": ("[2]", "snr from 1", ">", MADE),
    "fleet.makes.airframe": ("zeng_2019", KIND, None, MADE),
    "fleet.makes.battery": ("{capacity_wh: 50}", "charge of 1", "<", MADE),
    "fleet.makes.computer": ("{cpu_cores: 2}", "processor left of 1", "<", MADE),
    "fleet.makes.camera": ("{field_of_view_deg: 50}", "cells seen by 1", "<", MADE),
    "fleet.makes.altitude_offset_m": ("20", "height of 1", 4 / 3, MADE),
    "fleet.makes.tx_power_dbm": ("5", "snr from 1", "<", MADE),
    "fleet.makes.antenna": ("dipole", "snr from 1", "<", MADE),
    "fleet.makes.compute_delay_s": ("0.08", "time from look to sending of 1", ">", MADE),
    "fleet.makes.policy": ("silence", "payloads of 1", "<", MADE, "fleet.makes.0.policy_params={}"),
    "fleet.makes.policy_params": ("{received_budget: 0.1}", "peers of another network get boxes", None, MADE),
    "fleet.makes.feature_space": ("other", KIND, None, MADE),
    "fleet.overrides.drone": ("2", "charge of 1", ">", TIRED),
    "fleet.overrides.initial_soc": ("0.4", "charge of 1", "<", TIRED),
    "fleet.overrides.capacity_wh": ("40", "charge of 1", "<", TIRED),
    "fleet.overrides.cell_resistance_mohm": ("30", "ohmic of 1", ">", TIRED),
    "fleet.overrides.cycles": ("200", "charge of 1", "<", TIRED),
    "fleet.overrides.payload_kg": ("0.5", "rotor of 1", ">", TIRED),
    "mission.phases.at_s": ("2", "tracking", ">"),
    "mission.phases.target": ("1", "region's east", ">", OTHER),
    "mission.more_targets.waypoints_m": ("[[0, 60], [90, 60]]", "region's north of group 1", ">", OTHER, GROUP),
    "mission.more_targets.speed_mps": ("8", "region's east of group 1", ">", OTHER, GROUP),
    "mission.groups.drones": ("[1]", "one drone changes its mission", None, OTHER, GROUP),
    "mission.groups.reserve": ("[2]", "flying", "<", OTHER, GROUP),
    "mission.handover_soc": ("0.96", "going home", ">", OTHER, GROUP, "mission.groups.0.reserve=[2]"),
    "mission.descent_mps": ("6", "height", "<", "events=[{kind: drone_leaves, at_s: 1, drone: 1}]"),
    "mission.groups.phases.at_s": ("2.5", "tracking", "<", OTHER, GROUP),
    "mission.groups.phases.phase": ("return", "tracking", "<", OTHER, GROUP),
    "mission.groups.phases.region.radius_m": ("20", "region's radius", "<", OTHER, GROUP),
    "mission.groups.phases.region.centre_m": ("[10, 0]", "region's way of group 1", "<", OTHER, GROUP),
    "mission.groups.phases.target": ("0", "region's east of group 1", "<", OTHER, GROUP),
    "mission.phases.phase": ("return", "tracking", "<"),
    "mission.phases.region.radius_m": ("20", "region's radius", 5 / 8),
    "mission.phases.region.centre_m": ("[10, 0]", "region's east", ">", FIXED),
    "mission.target.waypoints_m": ("[[-60, 1.75], [200, 1.75]]", "region's north", ">"),
    "mission.target.speed_mps": ("8", "region's east", ">"),
    "radio.standard": ("ac", "airtime", ">"),
    "radio.carrier_ghz": ("2.4", "snr", ">"),
    "radio.bandwidth_mhz": ("20", "snr", ">"),
    "radio.tx_power_dbm": ("10", "snr", "<"),
    "radio.noise_figure_db": ("10", "snr", "<"),
    "radio.antenna": ("dipole", "snr", "<"),
    "radio.path_loss": ("free_space", "snr", ">"),
    "radio.path_loss_params": ("{wall_db: 3}", "snr", ">", f"radio.path_loss={WALL}"),
    "radio.link": (NOISY, "snr's spread", ">"),
    "radio.link_params": ("{sigma_db: 3}", "snr's spread", "<", f"radio.link={NOISY}"),
    "radio.path_loss_exponent": ("2.6", "snr", "<"),
    "radio.ground_roughness_m": ("5", "reflections add or cancel", None, *LOW, FAR),
    "radio.shadowing_sigma_db": ("6", "snr's spread", ">"),
    "radio.shadowing_time_s": ("2", CHANCE, None),
    "radio.shadowing_distance_m": ("20", CHANCE, None),
    "radio.rician_k_db": ("3", "airtime", ">"),
    "radio.fading": ("frame", KIND, None, FAR),
    "radio.preamble_detection_dbm": ("-60", "descriptors heard", "<", FAR),
    "radio.group_rate_mbps": ("12", "faster frames are shorter and need more signal", None),
    "radio.rate_control": ("minstrel", "mcs", "<", FAR),
    "radio.context_class": ("best_effort", CONTENTION, None, *HEAVY),
    "radio.payload_class": ("video", CONTENTION, None),
    "radio.edca.voice.aifsn": ("5", CONTENTION, None, *HEAVY),
    "radio.edca.voice.cw_min": ("7", CONTENTION, None, *HEAVY),
    "radio.edca.voice.cw_max": ("31", CONTENTION, None, *HEAVY, "radio.payload_class=voice"),
    "radio.edca.video.aifsn": ("5", CONTENTION, None, *HEAVY, "radio.payload_class=video"),
    "radio.edca.video.cw_min": ("3", CONTENTION, None, *HEAVY, "radio.payload_class=video"),
    "radio.edca.video.cw_max": ("255", CONTENTION, None, *HEAVY, "radio.payload_class=video"),
    "radio.edca.best_effort.aifsn": ("9", CONTENTION, None, *HEAVY),
    "radio.edca.best_effort.cw_min": ("3", CONTENTION, None, *HEAVY),
    "radio.edca.best_effort.cw_max": ("15", CONTENTION, None, *HEAVY),
    "radio.edca.background.aifsn": ("3", CONTENTION, None, *HEAVY, "radio.payload_class=background"),
    "radio.edca.background.cw_min": ("3", CONTENTION, None, *HEAVY, "radio.payload_class=background"),
    "radio.edca.background.cw_max": ("15", CONTENTION, None, *HEAVY, "radio.payload_class=background"),
    "radio.rts": ("true", "a clearance costs time and saves collisions", None),
    "radio.block_ack_window": ("256", "airtime", ">"),
    "radio.retry_limit": ("0", "delivered", "<", FAR),
    "radio.max_ampdu_frames": ("8", "airtime", ">"),
    "radio.fragment_bytes": ("8000", "fragments", "<"),
    "radio.framing": ("tiles", "payload's bytes", ">"),
    "radio.relay_max_hops": ("3", "hops", ">", FAR, "fleet.formation.shape=line"),
    "radio.bursts.good_to_bad": ("0.3", "descriptors heard", "<"),
    "radio.bursts.bad_to_good": ("0.9", "descriptors heard", ">", BURSTS),
    "radio.bursts.step_s": ("0.2", CHANCE, None, BURSTS),
    "radio.bursts.loss_good": ("0.1", "descriptors heard", "<", BURSTS),
    "radio.bursts.loss_bad": ("0.5", "descriptors heard", ">", BURSTS),
    "radio.trace": (LINKS, KIND, None),
    "radio.heartbeat_s": ("0.05", "wait for a repair", ">", *REPAIRED),
    "radio.nack_delay_s": ("0.02", "wait for a repair", ">", *REPAIRED),
    "context.rate_hz": ("5", "descriptors", 1 / 2),
    "context.degraded_after_periods": ("5", "degraded at", ">", LOST, *SMALL_MAPS),
    "context.detached_after_periods": ("15", "detached at", ">", LOST),
    "context.authentication": ("false", "descriptor's bytes", "<"),
    "context.publish_every": ("2", "descriptors", 1 / 2),
    "context.form.grid_cells": ("8", "descriptor's bytes", "<"),
    "context.form.grid_bits": ("1", "descriptor's bytes", "<"),
    "context.form.number_bits": ("16", "descriptor's bytes", "<"),
    "context.roster": ("true", "descriptor's bytes", ">"),
    "context.trust": ("false", "doubts", "<", LIE),
    "perception.detector": ("torch", "detections", ">", "duration_s=4"),
    "perception.detector_params": ("{finds: false}", "detections", "<", *OMNISCIENT),
    "perception.compute_delay_s": ("0.05", "time from look to sending", ">"),
    "perception.tracking_rate_hz": ("5", KIND, None, TRACK),
    "perception.people.waypoints_m": ("[[3, -8], [3, 0]]", "people's east", ">", CROSSES),
    "perception.people.speed_mps": ("2", "people's north", ">", CROSSES),
    "perception.people.begin_s": ("2", "people's north", "<", CROSSES),
    "perception.thermal.field_of_view_deg": ("10", "people found", "<", CROSSES, WARM),
    "perception.thermal.near_probability": ("0.2", "people found", "<", CROSSES, WARM),
    "perception.thermal.half_range_m": ("60", "people found", "<", CROSSES, WARM),
    "perception.thermal.range_width_m": ("40", "people found", "<", CROSSES, WARM),
    "perception.thermal.false_alarms_per_min": ("60", "false alarms", ">", CROSSES, WARM),
    "perception.thermal.position_error_m": ("4", "error of sightings", ">", CROSSES, WARM),
    "perception.thermal.remembers_s": ("0.2", "what is forgotten may be found again", None, CROSSES, WARM),
    "policy.name": ("deputies", KIND, None),
    "policy.params": ("{rho: 0.1}", "cells sent", "<"),
    "policy.dwell_s": ("0.6", "first features", ">"),
    "policy.of_makes": ("false", KIND, None, MADE),
    "policy.hysteresis": ("3", KIND, None, "policy.name=adaptive", "policy.params={}", FAR),
    "policy.changes.at_s": ("3", "decisions of worst-2", "<", AT_2),
    "policy.changes.phase": ("search", "decisions of worst-2", ">", IN_TRACK),
    "policy.changes.command": ("b", KIND, None, TOLD, TELL),
    "policy.changes.name": ("best-2", "decisions of worst-2", "<", AT_2),
    "policy.changes.params": ("{received_budget: 0.1}", "fewer cells a map, of other peers", None, AT_2),
    "policy.commands.at_s": ("2.5", "decisions of worst-2", "<", TOLD, TELL),
    "policy.commands.command": ("b", KIND, None, TOLD, TELL),
    "policy.commands.drones": ("[1]", "decisions of worst-2", "<", TOLD, TELL),
    "policy.invariants": ("rate_hz <= 5", "violations", ">"),
    "policy.shield": ("true", "interventions", ">", "policy.invariants=rate_hz <= 5"),
    "policy.replays.at_s": ("3", KIND, None, REPLAY),
    "policy.replays.drone": ("1", KIND, None, REPLAY),
    "policy.replays.read_by": ("drone", KIND, None, SHOWN_STALE),
    "policy.replays.view": (TIRED_VIEW[0].replace("0.15", "0.5"), KIND, None, REPLAY),
    "events.at_s": ("2", "snr at 1", ">", DROP),
    "events.until_s": ("3", "snr at 1", ">", DROP),
    "events.drone": ("2", "snr at 1", ">", DROP),
    "events.peer": ("2", "snr at 1", ">", DROP),
    "events.loss_db": ("10", "descriptors heard", ">", DROP),
    "events.position_m": ("[300, 0, 60]", "snr", ">", JAM),
    "events.power_dbm": ("20", "snr", "<", JAM),
    "events.lost_fraction": ("0.2", "charge of 1", ">", FAULT),
    "events.skew_s": ("-2", "error of stamps", ">", SKEW),
    "events.drift_ppm": ("50000", "error of stamps", "<", DRIFT),
    "events.model": (f"{OWN}:Calm", "snr", ">", STORMS),
    "events.params": ("{loss_db: 3}", "snr", ">", STORMS),
    "events.offset_m": ("[0, 0, 0]", BELIEF, None, AWAY),
    "events.drift_mps": ("[0, 10, 0]", BELIEF, None, AWAY),
    "events.offset_deg": ("0", BELIEF, None, ASTRAY),
    "events.drift_degps": ("20", BELIEF, None, ASTRAY),
    "events.position_walk_m": ("20", BELIEF, None, LOST_GNSS),
    "events.extra_s": ("0.3", "time from look to sending of 1", ">", SLOW),
    "events.about": ("battery", KIND, None, LIE),
    "events.claim": ("little", KIND, None, LIE),
    "events.attack": ("oversized", KIND, None, SPOOF),
    "events.rate_hz": ("30", "drops", ">", SPOOF),
}
