"""What each knob of a scenario must move: a figure of the record, and which way. Used by test_sim_knobs.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sortie.fleet.coverage import unpack_grid
from sortie.sim.results.record import SortieRecord

Array = np.ndarray[Any, Any]


def _columns(record: SortieRecord, table: str, *names: str) -> list[Array]:
    return [record.tables[table][n].to_numpy(zero_copy_only=False) for n in names]


def _states(record: SortieRecord, name: str) -> Array:
    """[T, N]"""
    return np.reshape(_columns(record, "states", name)[0], (-1, record.scenario.fleet.drones)).astype(float)


def _energy(record: SortieRecord, cause: str | None = None, drone: int | None = None) -> float:
    rows = record.tables["energy"].to_pylist()
    return sum(r["energy_j"] for r in rows if cause in (None, r["cause"]) and drone in (None, r["drone"]))


def _sent(record: SortieRecord, column: str, *, drone: int | None = None, features: bool = False) -> float:
    """The mean over payloads, of one drone or of feature maps alone."""
    values, who, what = _columns(record, "transmissions", column, "drone", "representation")
    some = (who == drone if drone is not None else np.ones(len(who), bool)) & ((what == "features") | (not features))
    return float(np.nanmean(values[some])) if some.any() else 0.0


def _delivered(record: SortieRecord) -> Array:
    return np.asarray(_columns(record, "transmissions", "status")[0] == "delivered")


def _link(record: SortieRecord, link: str) -> float:
    """When a gate first called the link to drone 1, which is lost at 1 s, degraded or detached."""
    t_s, peer, state = _columns(record, "directives", "t_s", "peer", "link")
    return float(t_s[(peer == 1) & (state == link) & (t_s > 1.0)].min())


def _descriptor(record: SortieRecord, column: str, drone: int | None = None) -> float:
    values, who, t_s = _columns(record, "descriptors", column, "drone", "t_s")
    return float(values[(t_s > 1.0) & ((who == drone) if drone is not None else True)].mean())


def _cells(record: SortieRecord, least: int, drone: int | None = None) -> float:
    """Cells of the coverage grid seen at least so well, per descriptor."""
    rows = zip(*(record.tables["descriptors"][c].to_pylist() for c in ("coverage_grid", "drone")), strict=True)
    return float(np.mean([(unpack_grid(grid) >= least).sum() for grid, who in rows if drone in (None, who)]))


def _closest(record: SortieRecord) -> float:
    at = np.stack([_states(record, c) for c in ("x_m", "y_m")], axis=-1)
    apart = np.linalg.norm(at[:, :, None] - at[:, None], axis=-1)
    return float(apart[:, ~np.eye(at.shape[1], dtype=bool)].min())


def _region(record: SortieRecord, column: str, group: int | None = None) -> Array:
    values, of = _columns(record, "mission", column, "group")
    values = values[of == group] if group is not None else values
    return values[~np.isnan(values)]


def _tracking(record: SortieRecord) -> float:
    return float(np.mean(_columns(record, "mission", "phase")[0] == "track"))


def _repair_s(record: SortieRecord) -> float:
    """Time from the first service to the end, for each round of repairs."""
    begin_s, end_s, repairs = _columns(record, "transmissions", "t_start_s", "t_done_s", "repairs")
    some = (repairs > 0) & _delivered(record)
    return float(((end_s - begin_s)[some] / repairs[some]).mean())


def _delay_s(record: SortieRecord) -> float:
    sent_s, done_s = _columns(record, "transmissions", "t_sent_s", "t_done_s")
    return float((done_s - sent_s)[_delivered(record)].mean())


def _stamp_error_s(record: SortieRecord) -> float:
    t_s, stamp = _columns(record, "descriptors", "t_s", "stamp_ns")
    return float(np.abs(stamp * 1e-9 - t_s).mean())


def _heard(record: SortieRecord) -> float:
    every = {c: float(_columns(record, "receptions", c)[0].sum()) for c in record.tables["receptions"].column_names[1:]}
    return every["heard"] / sum(every.values())


def _sighting_error_m(record: SortieRecord) -> float:
    """Of the only person's sightings."""
    t_s, x, y, who = _columns(record, "sightings", "t_s", "x_m", "y_m", "person")
    at_s, px, py = _columns(record, "people", "t_s", "x_m", "y_m")
    k = np.searchsorted(at_s, t_s[who == 0] - 1e-6)
    return float(np.hypot(x[who == 0] - px[k], y[who == 0] - py[k]).mean())


def _snr(record: SortieRecord, *ends: int) -> float:
    snr, a, b = _columns(record, "transmissions", "snr_db", "drone", "peer")
    some = np.isin(a, ends) | np.isin(b, ends) if ends else np.ones(len(a), bool)
    return float(np.nanmean(snr[some]))


def _first_features_s(record: SortieRecord) -> float:
    t_s, what = _columns(record, "transmissions", "t_sent_s", "representation")
    return float(t_s[what == "features"].min())


def _count(table: str, **where: Any) -> Callable[[SortieRecord], float]:
    def count(record: SortieRecord) -> float:
        rows = record.tables[table].to_pylist()
        return sum(all(r[k] == v for k, v in where.items()) for r in rows)

    return count


def _list_mean(column: str, of: Callable[[list[float]], float]) -> Callable[[SortieRecord], float]:
    return lambda record: float(np.mean([of(v) for v in record.tables["fusions"][column].to_pylist()]))


FIGURES: dict[str, Callable[[SortieRecord], float]] = {
    "energy": _energy,
    **{
        cause: lambda r, cause=cause: _energy(r, cause)  # type: ignore[misc]
        for cause in ("rotor", "avionics", "compute", "radio", "ohmic")
    },
    "rotor of 1": lambda r: _energy(r, "rotor", 1),
    "ohmic of 1": lambda r: _energy(r, "ohmic", 1),
    "charge": lambda r: float(_states(r, "soc")[-1].mean()),
    "charge of 1": lambda r: float(_states(r, "soc")[-1, 1]),
    "voltage": lambda r: float(_states(r, "voltage_v")[-1].mean()),
    "flying": lambda r: float(_states(r, "airborne").mean()),
    "ground speed": lambda r: float(np.hypot(_states(r, "vx_mps"), _states(r, "vy_mps")).mean()),
    "height": lambda r: float(_states(r, "z_m").mean()),
    "height of 1": lambda r: float(_states(r, "z_m")[:, 1].mean()),
    "height's spread": lambda r: float(_states(r, "z_m").std()),
    "vertical speed": lambda r: float(np.abs(_states(r, "vz_mps")).mean()),
    "north": lambda r: float(_states(r, "y_m").mean()),
    "farthest north": lambda r: float(_states(r, "y_m").max()),
    "distance to drone 0": lambda r: float(
        np.hypot(*(_states(r, c)[0, 1:] - _states(r, c)[0, :1] for c in ("x_m", "y_m"))).mean()
    ),
    "closest pair": _closest,
    "rates of roll and pitch": lambda r: float(np.hypot(_states(r, "p_radps"), _states(r, "q_radps")).mean()),
    "fastest turn": lambda r: float(np.sort(np.abs(_states(r, "r_radps")), axis=0)[-5:].mean()),
    "error of stamps": _stamp_error_s,
    "descriptors": lambda r: float(r.tables["descriptors"].num_rows),
    "descriptor's bytes": lambda r: _descriptor(r, "wire_bytes"),
    "processor left": lambda r: _descriptor(r, "cpu_headroom"),
    "processor left of 1": lambda r: _descriptor(r, "cpu_headroom", 1),
    "accelerator left": lambda r: _descriptor(r, "gpu_headroom"),
    "cells seen": lambda r: _cells(r, 1),
    "cells seen by 1": lambda r: _cells(r, 1, 1),
    "cells seen well": lambda r: _cells(r, 2),
    "descriptors heard": _heard,
    "drops": _count("drops"),
    "doubts": _count("trust"),
    "payloads": lambda r: float(r.tables["transmissions"].num_rows),
    "payloads of 1": _count("transmissions", drone=1),
    "cells sent": lambda r: _sent(r, "cells", features=True),
    "cells sent by 1": lambda r: _sent(r, "cells", drone=1, features=True),
    "payload's bytes": lambda r: _sent(r, "payload_bytes", features=True),
    "codes' bytes": lambda r: _sent(r, "payload_bytes"),
    "fragments": lambda r: _sent(r, "fragments"),
    "airtime": lambda r: _sent(r, "airtime_s", features=True),
    "hops": lambda r: _sent(r, "hops"),
    "mcs": lambda r: _sent(r, "mcs"),
    "time from look to sending": lambda r: _sent(r, "t_sent_s") - _sent(r, "captured_s"),
    "time from look to sending of 1": lambda r: _sent(r, "t_sent_s", drone=1) - _sent(r, "captured_s", drone=1),
    "delivered": lambda r: float(_delivered(r).mean()),
    "delay": _delay_s,
    "wait for a repair": _repair_s,
    "snr": _snr,
    "snr at 1": lambda r: _snr(r, 1),
    "snr from 1": lambda r: _sent(r, "snr_db", drone=1),
    "snr's spread": lambda r: float(np.nanstd(_columns(r, "transmissions", "snr_db")[0])),
    "first features": _first_features_s,
    "busy": lambda r: r.totals["medium_busy_fraction"],
    "degraded at": lambda r: _link(r, "degraded"),
    "detached at": lambda r: _link(r, "detached"),
    "tracking": _tracking,
    "region's radius": lambda r: float(_region(r, "region_radius_m").mean()),
    "region's east": lambda r: float(_region(r, "region_x_m").mean()),
    "region's north": lambda r: float(_region(r, "region_y_m").mean()),
    "region's east of group 1": lambda r: float(_region(r, "region_x_m", 1).mean()),
    "region's north of group 1": lambda r: float(_region(r, "region_y_m", 1).mean()),
    "region's way of group 1": lambda r: float(np.ptp(_region(r, "region_x_m", 1))),
    "longest move": lambda r: max(
        float(e["text"].split()[1]) for e in r.tables["events"].to_pylist() if e["text"].startswith("moves ")
    ),
    "going home": _count("events", kind="drone_leaves"),
    "people's east": lambda r: float(_columns(r, "people", "x_m")[0].mean()),
    "people's north": lambda r: float(_columns(r, "people", "y_m")[0].mean()),
    "people found": _count("sightings", person=0),
    "false alarms": _count("sightings", person=-1),
    "error of sightings": _sighting_error_m,
    "decisions of worst-2": lambda r: r.totals.get("decisions_of worst-2", 0.0)
    + r.totals.get("decisions_of worst-2(received_budget=0.1)", 0.0),
    "violations": lambda r: r.totals["invariant_violations"],
    "interventions": lambda r: r.totals["shield_interventions"],
    "detections": lambda r: float(r.tables["detections"].num_rows),
    "truths": lambda r: float(r.tables["truths"].num_rows),
    "fusions": lambda r: float(r.tables["fusions"].num_rows),
    "peers fused": _list_mean("peers", len),
    "age at fusion": lambda r: float(np.mean(np.concatenate(r.tables["fusions"]["ages_s"].to_pylist()))),
}  # fmt: skip


def figure(name: str, record: SortieRecord) -> float:
    """A figure of a record by its name."""
    return FIGURES[name](record)


MOVES: dict[str, tuple[str, str | float]] = {
    "duration_s": ("descriptors", 5 / 6),
    "fleet.drones": ("descriptors", 6 / 5),
    "fleet.formation.shape": ("distance to drone 0", ">"),  # a line is longer than a cross
    "fleet.formation.spacing_m": ("distance to drone 0", ">"),
    "fleet.formation.altitude_m": ("height", 70 / 60),
    "fleet.route.waypoints_m": ("north", ">"),
    "fleet.route.speed_mps": ("ground speed", 6 / 5),
    "fleet.route.turn_time_s": ("fastest turn", "<"),
    "fleet.groups.drones": ("height", "<"),
    "fleet.groups.formation": ("height of 1", ">"),
    "fleet.groups.route": ("ground speed", ">"),
    "fleet.groups.take_off": ("height of 1", "<"),
    "fleet.groups.climb_mps": ("height of 1", "<"),
    "fleet.groups.legs": ("height of 1", "<"),  # they do not climb
    "fleet.ground.drone": ("height of 1", ">"),
    "fleet.ground.position_m": ("height of 1", 10.0),
    "fleet.ground.mains": ("charge of 1", "<"),
    "fleet.ground.camera": ("cells seen by 1", ">"),
    "fleet.ground.scored": ("fusions", ">"),
    "fleet.groups.mobility_params": ("ground speed", ">"),
    "fleet.mobility_params": ("ground speed", ">"),
    "fleet.steering.reach_m": ("ground speed", "<"),
    "fleet.steering.speed_mps": ("ground speed", "<"),
    "fleet.steering.climb_mps": ("height", ">"),
    "fleet.steering.acceleration_mps2": ("ground speed", "<"),
    "fleet.steering.separation_m": ("closest pair", ">"),
    "fleet.steering.altitude_m": ("height", "<"),
    "fleet.steering.fence_m": ("ground speed", "<"),
    "fleet.motion.wind_mps": ("rotor", ">"),  # carried by the wind, a drone hovers in it
    "fleet.motion.gust_sigma_mps": ("rates of roll and pitch", ">"),
    "fleet.motion.gust_time_s": ("rates of roll and pitch", "<"),
    "fleet.motion.pose_jitter_m": ("height's spread", 2.5),
    "fleet.motion.pose_jitter_time_s": ("vertical speed", "<"),
    "fleet.clock.gnss": ("error of stamps", ">"),
    "fleet.clock.offset_s": ("error of stamps", ">"),
    "fleet.clock.drift_ppm": ("error of stamps", ">"),
    "fleet.clock.drift_growth_ppm_per_min": ("error of stamps", ">"),
    "fleet.viewpoints.reach_m": ("longest move", "<"),
    "fleet.viewpoints.speed_mps": ("north", ">"),
    "fleet.viewpoints.acceleration_mps2": ("north", "<"),
    "fleet.viewpoints.separation_m": ("closest pair", "<"),
    "fleet.viewpoints.fence_m": ("farthest north", "<"),
    "fleet.battery.capacity_wh": ("charge", "<"),
    "fleet.battery.cells": ("voltage", ">"),
    "fleet.battery.initial_soc": ("charge", "<"),
    "fleet.battery.cell_resistance_mohm": ("ohmic", ">"),
    "fleet.battery.cell_model": ("voltage", ">"),
    "fleet.battery.cell_params": ("voltage", ">"),
    "fleet.battery.drivetrain_efficiency": ("rotor", 8 / 7),
    "fleet.battery.avionics_w": ("avionics", 12 / 8),
    "fleet.battery.compute_idle_w": ("compute", ">"),
    "fleet.battery.compute_active_w": ("compute", ">"),
    "fleet.battery.radio_idle_w": ("radio", ">"),
    "fleet.battery.radio_tx_w": ("radio", ">"),
    "fleet.battery.landing_soc": ("flying", "<"),
    "fleet.battery.cutoff_cell_v": ("flying", "<"),
    "fleet.battery.polarisation.resistance_mohm": ("ohmic", ">"),
    "fleet.battery.polarisation.time_s": ("ohmic", ">"),
    "fleet.battery.ambient_c": ("ohmic", ">"),
    "fleet.battery.cycles": ("charge", "<"),
    "fleet.battery.life_cycles": ("charge", ">"),
    "fleet.camera.field_of_view_deg": ("cells seen", "<"),
    "fleet.camera.width_px": ("cells seen well", "<"),
    "fleet.computer.cpu_cores": ("processor left", "<"),
    "fleet.computer.decision_s": ("processor left", "<"),
    "fleet.computer.payload_mbps": ("processor left", "<"),
    "fleet.computer.driving_cores": ("processor left", "<"),
    "fleet.computer.fusion_s": ("accelerator left", "<"),
    "fleet.airframe.mass_kg": ("rotor", ">"),
    "fleet.airframe.payload_kg": ("rotor", ">"),
    "fleet.airframe.disc_area_m2": ("rotor", ">"),
    "fleet.airframe.figure_of_merit": ("rotor", "<"),
    "fleet.airframe.tip_speed_mps": ("rotor", ">"),
    "fleet.airframe.drag_area_m2": ("rotor", ">"),
    "fleet.airframe.air_density_kgpm3": ("rotor", ">"),
    "fleet.airframe.power_params": ("rotor", 1 / 2),
    "fleet.origin.latitude_deg": ("north", "<"),
    "fleet.origin.longitude_deg": ("distance to drone 0", ">"),
    "fleet.origin.altitude_m": ("height of 1", ">"),
    "fleet.trace": ("charge of 1", "<"),
    "fleet.makes.drones": ("snr from 1", ">"),  # drone 1 is no longer the weak sender
    "fleet.makes.battery": ("charge of 1", "<"),
    "fleet.makes.computer": ("processor left of 1", "<"),
    "fleet.makes.camera": ("cells seen by 1", "<"),
    "fleet.makes.altitude_offset_m": ("height of 1", 80 / 60),
    "fleet.makes.tx_power_dbm": ("snr from 1", "<"),
    "fleet.makes.antenna": ("snr from 1", "<"),
    "fleet.makes.compute_delay_s": ("time from look to sending of 1", ">"),
    "fleet.makes.policy": ("payloads of 1", "<"),
    "fleet.overrides.drone": ("charge of 1", ">"),
    "fleet.overrides.initial_soc": ("charge of 1", "<"),
    "fleet.overrides.capacity_wh": ("charge of 1", "<"),
    "fleet.overrides.cell_resistance_mohm": ("ohmic of 1", ">"),
    "fleet.overrides.cycles": ("charge of 1", "<"),
    "fleet.overrides.payload_kg": ("rotor of 1", ">"),
    "mission.phases.at_s": ("tracking", ">"),
    "mission.phases.target": ("region's east", ">"),
    "mission.more_targets.waypoints_m": ("region's north of group 1", ">"),
    "mission.more_targets.speed_mps": ("region's east of group 1", ">"),
    "mission.groups.reserve": ("flying", "<"),
    "mission.handover_soc": ("going home", ">"),
    "mission.descent_mps": ("height", "<"),
    "mission.groups.phases.at_s": ("tracking", "<"),
    "mission.groups.phases.phase": ("tracking", "<"),
    "mission.groups.phases.region.radius_m": ("region's radius", "<"),
    "mission.groups.phases.region.centre_m": ("region's way of group 1", "<"),
    "mission.groups.phases.target": ("region's east of group 1", "<"),
    "mission.phases.phase": ("tracking", "<"),
    "mission.phases.region.radius_m": ("region's radius", 20 / 32),
    "mission.phases.region.centre_m": ("region's east", ">"),
    "mission.target.waypoints_m": ("region's north", ">"),
    "mission.target.speed_mps": ("region's east", ">"),
    "radio.standard": ("airtime", ">"),
    "radio.carrier_ghz": ("snr", ">"),
    "radio.bandwidth_mhz": ("snr", ">"),
    "radio.tx_power_dbm": ("snr", "<"),
    "radio.noise_figure_db": ("snr", "<"),
    "radio.antenna": ("snr", "<"),
    "radio.path_loss": ("snr", ">"),
    "radio.path_loss_params": ("snr", ">"),
    "radio.link": ("snr's spread", ">"),
    "radio.link_params": ("snr's spread", "<"),
    "radio.path_loss_exponent": ("snr", "<"),
    "radio.shadowing_sigma_db": ("snr's spread", ">"),
    "radio.rician_k_db": ("airtime", ">"),
    "radio.preamble_detection_dbm": ("descriptors heard", "<"),
    "radio.rate_control": ("mcs", "<"),  # it begins at the slowest
    "radio.block_ack_window": ("airtime", ">"),  # its answers are longer
    "radio.retry_limit": ("delivered", "<"),
    "radio.max_ampdu_frames": ("airtime", ">"),
    "radio.fragment_bytes": ("fragments", "<"),
    "radio.framing": ("payload's bytes", ">"),
    "radio.relay_max_hops": ("hops", ">"),
    "radio.bursts.good_to_bad": ("descriptors heard", "<"),
    "radio.bursts.bad_to_good": ("descriptors heard", ">"),
    "radio.bursts.loss_good": ("descriptors heard", "<"),
    "radio.bursts.loss_bad": ("descriptors heard", ">"),
    "radio.heartbeat_s": ("wait for a repair", ">"),
    "radio.nack_delay_s": ("wait for a repair", ">"),
    "context.rate_hz": ("descriptors", 1 / 2),
    "context.degraded_after_periods": ("degraded at", ">"),
    "context.detached_after_periods": ("detached at", ">"),
    "context.authentication": ("descriptor's bytes", "<"),
    "context.publish_every": ("descriptors", 1 / 2),
    "context.form.grid_cells": ("descriptor's bytes", "<"),
    "context.form.grid_bits": ("descriptor's bytes", "<"),
    "context.form.number_bits": ("descriptor's bytes", "<"),
    "context.roster": ("descriptor's bytes", ">"),
    "context.trust": ("doubts", "<"),
    "perception.detector": ("detections", ">"),
    "perception.detector_params": ("detections", "<"),
    "perception.compute_delay_s": ("time from look to sending", ">"),
    "perception.people.waypoints_m": ("people's east", ">"),
    "perception.people.speed_mps": ("people's north", ">"),
    "perception.people.begin_s": ("people's north", "<"),
    "perception.thermal.field_of_view_deg": ("people found", "<"),
    "perception.thermal.near_probability": ("people found", "<"),
    "perception.thermal.half_range_m": ("people found", "<"),
    "perception.thermal.range_width_m": ("people found", "<"),
    "perception.thermal.false_alarms_per_min": ("false alarms", ">"),
    "perception.thermal.position_error_m": ("error of sightings", ">"),
    "policy.params": ("cells sent", "<"),
    "policy.dwell_s": ("first features", ">"),
    "policy.changes.at_s": ("decisions of worst-2", "<"),
    "policy.changes.phase": ("decisions of worst-2", ">"),
    "policy.changes.name": ("decisions of worst-2", "<"),
    "policy.commands.at_s": ("decisions of worst-2", "<"),
    "policy.commands.drones": ("decisions of worst-2", "<"),
    "policy.invariants": ("violations", ">"),
    "policy.shield": ("interventions", ">"),
    "events.at_s": ("snr at 1", ">"),
    "events.until_s": ("snr at 1", ">"),
    "events.drone": ("snr at 1", ">"),
    "events.peer": ("snr at 1", ">"),
    "events.loss_db": ("descriptors heard", ">"),  # over a dead link no payload is sent
    "events.position_m": ("snr", ">"),
    "events.power_dbm": ("snr", "<"),
    "events.model": ("snr", ">"),  # a calm weakens no link
    "events.params": ("snr", ">"),
    "events.lost_fraction": ("charge of 1", ">"),
    "events.skew_s": ("error of stamps", ">"),
    "events.drift_ppm": ("error of stamps", "<"),
    "events.extra_s": ("time from look to sending of 1", ">"),
    "events.rate_hz": ("drops", ">"),
    "perception.weights": ("detections", "<"),
    "perception.code_bytes": ("codes' bytes", "<"),
    "perception.sample_rate_hz": ("fusions", ">"),
    "perception.egos": ("fusions", "<"),
    "perception.fusion_delay_s": ("age at fusion", ">"),
    "perception.max_age_s": ("peers fused", "<"),
    "perception.score_threshold": ("detections", "<"),
    "perception.scene.parked_density": ("truths", ">"),
    "perception.scene.moving_cars_per_km": ("truths", ">"),
}
"""By field: the figure that its other value in test_sim_knobs.py moves, and how: more, less, or so many times as much."""

_CHANCE = "another draw of chance"
_KIND = "another kind, neither more nor less"
_BELIEF = "what a drone believes is in no table"
_CONTENTION = "what one class of traffic gains another loses"
_LIGHT = "what a network makes of other pictures is not known beforehand"

UNSIGNED: dict[str, str] = {
    "seed": _CHANCE,
    "fleet.motion.pose_error_m": _BELIEF,
    "fleet.motion.heading_error_deg": _BELIEF,
    "fleet.camera.pitch_deg": "the cells that it wins ahead it loses below",
    "fleet.airframe.power_model": _KIND,
    "fleet.groups.mobility": _KIND,
    "fleet.mobility": _KIND,
    "fleet.makes.airframe": _KIND,
    "fleet.makes.feature_space": _KIND,
    "fleet.makes.policy_params": "its maps are of another network, so its peers get boxes",
    "mission.groups.drones": "one drone changes its mission",
    "radio.ground_roughness_m": "reflections add or cancel",
    "radio.shadowing_time_s": _CHANCE,
    "radio.shadowing_distance_m": _CHANCE,
    "radio.fading": _KIND,
    "radio.rts": "a clearance costs time and saves collisions",
    "radio.group_rate_mbps": "faster frames are shorter and need more signal",
    "radio.context_class": _CONTENTION,
    "radio.payload_class": _CONTENTION,
    **{
        f"radio.edca.{name}.{field}": _CONTENTION
        for name in ("voice", "video", "best_effort", "background")
        for field in ("aifsn", "cw_min", "cw_max")
    },
    "radio.bursts.step_s": _CHANCE,
    "radio.trace": _KIND,
    "perception.tracking_rate_hz": _KIND,
    "perception.thermal.remembers_s": "what is forgotten may be found again",
    "policy.name": _KIND,
    "policy.of_makes": _KIND,
    "policy.hysteresis": _KIND,
    "policy.changes.command": _KIND,
    "policy.changes.params": "fewer cells a map, of other peers",
    "policy.commands.command": _KIND,
    "policy.replays.at_s": _KIND,
    "policy.replays.drone": _KIND,
    "policy.replays.view": _KIND,
    "policy.replays.read_by": _KIND,
    **{
        f"events.{name}": _BELIEF for name in ("offset_m", "drift_mps", "offset_deg", "drift_degps", "position_walk_m")
    },
    "fleet.sensor": _BELIEF,
    "fleet.sensor_params": _BELIEF,
    "events.about": _KIND,
    "events.claim": _KIND,
    "events.attack": _KIND,
    "fleet.makes.detector": _KIND,
    **{
        f"perception.{name}": _KIND
        for name in (
            "fusion", "fusion_params", "recording", "recorded_fusion", "precision", "motion_compensation", "join", "unsent_cells",
            "codebook", "match_poses", "maps_bring_boxes",
        )
    },
    **{
        f"perception.scene.{name}": _LIGHT
        for name in (
            "seed", "style", "block_m", "building_density", "building_height_m", "tree_density", "moving_speed_mps", "trucks",
            "sun_azimuth_deg", "sun_elevation_deg", "overcast", "brightness",
        )
    },
}  # fmt: skip
"""By field: why no figure must move in one direction."""
