"""Every documented knob of a scenario acts: changing it changes the record, in the direction that its definition has.

`knobs` has, for every leaf field of the schema, another value and the figure that it must move. The short suite changes
knobs that act on separate figures in one flight; the slow tests change each knob alone.
"""

from __future__ import annotations

import functools
import types
import typing
from dataclasses import replace
from pathlib import Path

import knobs
import pytest
from knob_figures import FIGURES
from pydantic import BaseModel
from recorded import recorded
from recording_examples import record_flight
from sim_examples import example

from sortie.scenarios.schema import KINDS, FlightGroup, Scenario
from sortie.scenarios.schema.fleet import Make
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import SortieRecord

NOT_KNOBS = (
    "name",
    "description",
    "expect",
    "expect_decisions",
    "expect_no_other_changes",
    "record",
    "limits",
    "metrics",
)
"""Words for people, what is asserted or computed from the record, what is kept beside it, and wall-clock time."""

IN_MAKES = {"fleet.makes.name", "fleet.makes.weights", "fleet.makes.codebook"}
"""Networks and codebooks of makes, which the name stands for; test_sim_makes.py."""

RECORDED = ("perception.detector=recorded", "perception.recording=RECORDING")
SEEN: dict[str, knobs.Knob] = {
    "perception.fusion": ("late", knobs.KIND, None),
    "perception.fusion_params": ("{gain: 0}", knobs.KIND, None, f"perception.fusion={knobs.OWN}:largest"),
    "fleet.makes.detector": ("surrogate", knobs.KIND, None, knobs.MADE),
    "fleet.ground.scored": ("true", "fusions", ">", knobs.STATION),
    "perception.recording": ("OTHER", knobs.KIND, None, *RECORDED),
    "perception.recorded_fusion": ("FUSION", knobs.KIND, None, *RECORDED),
    "perception.weights": ("WEIGHTS", "detections", "<"),
    "perception.codebook": ("CODEBOOK", knobs.KIND, None, *knobs.CODED),
    "perception.code_bytes": ("3", "codes' bytes", "<", *knobs.CODED),
    "perception.precision": ("bfloat16", knobs.KIND, None),
    "perception.sample_rate_hz": ("5", "fusions", ">"),
    "perception.egos": ("2", "fusions", "<"),
    "perception.fusion_delay_s": ("0.2", "age at fusion", ">"),
    "perception.max_age_s": ("0.05", "peers fused", "<"),
    "perception.motion_compensation": ("false", knobs.KIND, None, "perception.fusion_delay_s=0.042"),
    "perception.score_threshold": ("0.5", "detections", "<"),
    "perception.match_poses": ("true", knobs.KIND, None, "policy.name=boxes", "policy.params={}"),
    "perception.maps_bring_boxes": (
        "true",
        knobs.KIND,
        None,
        "policy.name=all-4",
        "policy.params={received_budget: 0.05}",
    ),
    "perception.join": ("nms", knobs.KIND, None, "policy.name=boxes", "policy.params={}"),
    "perception.unsent_cells": ("zero", knobs.KIND, None),
    "perception.scene.seed": ("8", knobs.LIGHT, None),
    "perception.scene.style": ("suburb", knobs.LIGHT, None),
    "perception.scene.block_m": ("100", knobs.LIGHT, None),
    "perception.scene.building_density": ("0.1", knobs.LIGHT, None),
    "perception.scene.building_height_m": ("20", knobs.LIGHT, None),
    "perception.scene.tree_density": ("1", knobs.LIGHT, None),
    "perception.scene.parked_density": ("0.9", "truths", ">"),
    "perception.scene.moving_cars_per_km": ("40", "truths", ">"),
    "perception.scene.moving_speed_mps": ("15", knobs.LIGHT, None),
    "perception.scene.trucks": ("0.8", knobs.LIGHT, None),
    "perception.scene.sun_azimuth_deg": ("30", knobs.LIGHT, None),
    "perception.scene.sun_elevation_deg": ("20", knobs.LIGHT, None),
    "perception.scene.overcast": ("1", knobs.LIGHT, None),
    "perception.scene.brightness": ("0.4", knobs.LIGHT, None),
}
"""Knobs that act through the detector: their flights have torch's, shortly."""

LISTS = ("fleet.overrides", "fleet.makes", "fleet.groups", "fleet.ground", "perception.people", "mission.groups")
LISTS += ("mission.more_targets", "events", "policy.changes", "policy.commands", "policy.replays")


def place(field: str, shared: typing.Sequence[object]) -> str:
    """Where `--set` finds the field: lists are addressed by the item that the settings put there."""
    last_phase = 0 if knobs.FIXED in shared else 1
    place = field.replace("mission.groups.phases.", "mission.groups.0.phases.1.")
    place = place.replace("mission.phases.", f"mission.phases.{last_phase}.")
    for name in LISTS:
        if place.startswith(f"{name}.") and not place.startswith(f"{name}.0."):
            place = place.replace(f"{name}.", f"{name}.0.", 1)
    return place


def wrong_way(field: str, knob: knobs.Knob, before: SortieRecord, after: SortieRecord) -> str:
    """What is wrong with how the knob's figure moved; nothing if it moved as it must."""
    _, name, way, *_ = knob
    if way is None:
        return ""
    a, b = (FIGURES[str(name)](record) for record in (before, after))
    factor = 0.0 if isinstance(way, str) else float(str(way))
    moved = {"<": b < a, ">": b > a}[way] if isinstance(way, str) else b == pytest.approx(factor * a, rel=0.02)
    return "" if moved else f"{field}: {name}: {a:.6g} before, {b:.6g} after, must be {way}"


# --- knobs together ------------------------------------------------------------------------------

TOGETHER: dict[str, tuple[tuple[str, ...], str]] = {
    "a first set": (
        (),
        "fleet.formation.altitude_m fleet.route.speed_mps fleet.route.waypoints_m fleet.airframe.mass_kg"
        " fleet.battery.avionics_w fleet.battery.radio_idle_w fleet.battery.compute_idle_w fleet.battery.cells"
        " fleet.battery.cell_resistance_mohm fleet.battery.capacity_wh fleet.computer.cpu_cores"
        " fleet.computer.fusion_s fleet.camera.width_px fleet.motion.gust_sigma_mps fleet.motion.pose_jitter_m"
        " radio.tx_power_dbm radio.fragment_bytes context.form.number_bits context.publish_every"
        " mission.phases.at_s mission.phases.region.radius_m mission.target.waypoints_m mission.target.speed_mps"
        " policy.params policy.dwell_s policy.invariants perception.compute_delay_s",
    ),
    "a second set": (
        (),
        "fleet.formation.spacing_m fleet.battery.drivetrain_efficiency fleet.battery.compute_active_w"
        " fleet.battery.radio_tx_w fleet.battery.polarisation.resistance_mohm fleet.battery.initial_soc"
        " fleet.computer.payload_mbps fleet.camera.field_of_view_deg fleet.clock.offset_s radio.noise_figure_db"
        " radio.shadowing_sigma_db radio.max_ampdu_frames radio.framing context.form.grid_cells mission.phases.phase",
    ),
    "a third set": (
        (),
        "fleet.formation.shape fleet.airframe.figure_of_merit fleet.battery.ambient_c fleet.computer.driving_cores"
        " radio.path_loss_exponent radio.rician_k_db context.form.grid_bits"
        " fleet.motion.pose_jitter_time_s fleet.drones",
    ),
    "another make": (
        (knobs.MADE,),
        "fleet.makes.battery fleet.makes.computer fleet.makes.camera fleet.makes.altitude_offset_m"
        " fleet.makes.tx_power_dbm fleet.makes.compute_delay_s",
    ),
    "an older drone": (
        (knobs.TIRED,),
        "fleet.overrides.initial_soc fleet.overrides.cell_resistance_mohm fleet.overrides.payload_kg",
    ),
    "a station": ((knobs.STATION,), "fleet.ground.position_m fleet.ground.mains fleet.ground.camera"),
    "a group": (
        (knobs.OTHER, knobs.GROUP),
        "mission.more_targets.waypoints_m mission.more_targets.speed_mps mission.groups.phases.at_s"
        " mission.groups.reserve",
    ),
    "people": (
        (knobs.CROSSES, knobs.WARM),
        "perception.people.waypoints_m perception.people.speed_mps perception.thermal.near_probability"
        " perception.thermal.false_alarms_per_min perception.thermal.position_error_m",
    ),
    "far drones": (
        (knobs.FAR,),
        "radio.rate_control radio.retry_limit",
    ),
    "a lost drone": (
        (knobs.LOST, *knobs.SMALL_MAPS),
        "context.degraded_after_periods context.detached_after_periods context.rate_hz",
    ),
}
"""What both flights have, and knobs that act on separate figures."""


@pytest.mark.parametrize("name", TOGETHER)
def test_knobs_that_act_on_separate_figures_each_move_their_own(name: str) -> None:
    shared, fields = TOGETHER[name]
    chosen = {field: knobs.TRAFFIC[field] for field in fields.split()}
    figures = [knob[1] for knob in chosen.values()]
    assert len(set(figures)) == len(figures), "one knob a figure"
    before = run_sortie(example(*shared)) if shared else recorded("base")
    after = run_sortie(example(*shared, *(f"{place(field, shared)}={knob[0]}" for field, knob in chosen.items())))
    assert [fault for field, knob in chosen.items() if (fault := wrong_way(field, knob, before, after))] == []


# --- the schema ----------------------------------------------------------------------------------


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


def test_the_table_names_every_field_of_the_schema_with_its_figure_or_a_reason() -> None:
    fields = {f for f in leaves(Scenario) if f.split(".")[0] not in NOT_KNOBS} - IN_MAKES
    table = knobs.TRAFFIC | SEEN
    assert fields == table.keys() | {"events.kind"}  # the kind is what makes it an event
    assert [field for field, (_, name, way, *_) in table.items() if (way is None) == (name in FIGURES)] == []


# --- each knob alone -----------------------------------------------------------------------------


@functools.cache
def flown(*settings: str) -> SortieRecord:
    """Many knobs are changed from one and the same sortie."""
    return run_sortie(example(*settings))


@pytest.mark.slow
def test_each_knob_alone_changes_the_record(tmp_path: Path) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text("t_s,drone,soc\n0,1,0.7\n6,1,0.5\n")
    wrong = []
    for field, knob in knobs.TRAFFIC.items():
        value, _, _, *shared = knob
        change = [f"{place(field, shared)}={trace if value == 'TRACE' else value}"]
        if field == "policy.replays.drone":
            change.append(f"policy.replays.0.view={knobs.TIRED_VIEW[1]}")  # a view is its drone's own
        before, after = flown(*map(str, shared)), run_sortie(example(*map(str, shared), *change))
        if before.fingerprint == after.fingerprint:
            wrong.append(f"{field}: the same record")
        elif fault := wrong_way(field, knob, before, after):
            wrong.append(fault)
    assert wrong == []


@pytest.mark.slow
def test_every_kind_of_event_changes_the_record() -> None:
    prints = {event: flown(event).fingerprint for event in knobs.EVENTS}
    assert len({flown().fingerprint, *prints.values()}) == len(knobs.EVENTS) + 1
    kinds = {kind for kind in KINDS if any(f"kind: {kind}" in event for event in knobs.EVENTS)}
    assert kinds == set(KINDS) - {"own"}, "tests/helpers/knobs.py: EVENTS has one of each"


SHORT = (
    "perception.detector=torch",
    "duration_s=2.5",
    "mission.phases=[{at_s: 0, phase: search}]",
    "policy.params={rho: 0.05}",
)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_each_knob_of_perception_alone_changes_the_record(part: int, tmp_path: Path) -> None:
    wrong = []
    for field, knob in list(SEEN.items())[part::4]:
        folder = tmp_path / field
        folder.mkdir()
        value, _, _, *shared = knob
        value, *shared = with_files(folder, str(value), *map(str, shared))
        before, after = flown(*SHORT, *shared), run_sortie(example(*SHORT, *shared, f"{place(field, shared)}={value}"))
        if before.fingerprint == after.fingerprint:
            wrong.append(f"{field}: the same record")
        elif fault := wrong_way(field, knob, before, after):
            wrong.append(fault)
    assert wrong == []


def with_files(folder: Path, *texts: str) -> list[str]:
    """The texts with the names of the files that they need, which are made."""
    files = {name: folder / name.lower() for name in ("RECORDING", "OTHER", "FUSION")}
    if any(name in text for text in texts for name in files):
        flight = example(*SHORT)
        record_flight(flight, files["RECORDING"].with_suffix(".npz"))
        record_flight(flight, files["OTHER"].with_suffix(".npz"), lower=0.3)
        code = "import numpy as np\n\ndef deaf(agents, takes_part, weight):\n    return np.zeros((0, 6))\n"
        files["FUSION"].with_suffix(".py").write_text(code)
    for name, suffix in (("RECORDING", ".npz"), ("OTHER", ".npz"), ("FUSION", ".py:deaf")):
        texts = tuple(text.replace(name, f"{files[name]}{suffix}") for text in texts)
    for name, make in (("WEIGHTS", other_weights), ("CODEBOOK", other_codebook)):
        if texts[0] == name:
            texts = (str(make(folder / f"{name.lower()}.safetensors")), *texts[1:])
    return list(texts)


def other_codebook(path: Path) -> Path:
    """The shipped codebook with its entries in another order, so that a code's bytes mean coarser cells."""
    from sortie.perception.network.checkpoint import load_weights
    from sortie.perception.network.codebook import load_codebook, save_codebook
    from sortie.perception.network.detector import SHIPPED_WEIGHTS
    from sortie.scenarios.shipped import CODEBOOK, beside

    codebook = load_codebook(beside(SHIPPED_WEIGHTS, CODEBOOK), load_weights(SHIPPED_WEIGHTS))
    save_codebook(replace(codebook, stages=codebook.stages.flip(0)), path, {})
    return path


def other_weights(path: Path) -> Path:
    """The shipped weights with a more hesitant head."""
    import torch

    from sortie.perception.network.checkpoint import load_weights, save_weights
    from sortie.perception.network.detector import SHIPPED_WEIGHTS

    net = load_weights(SHIPPED_WEIGHTS)
    with torch.no_grad():
        net.head.out.bias[0] -= 1.0
    save_weights(net, path, {})
    return path
