"""Different drones in one fleet: three drones of two makes, each with its own machine, radio, policy and network."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import recorded
from sim_examples import PATIENT

from sortie.fleet.coverage import unpack_grid
from sortie.fleet.plane import codebooks
from sortie.perception.errors import InputError
from sortie.perception.files import codebook_digest
from sortie.perception.surrogate.model import SHIPPED, load, save
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Coverage, Descriptor, Directive, FleetView, Representation
from sortie.scenarios.reading.load import ScenarioError, loads
from sortie.scenarios.schema import Scenario
from sortie.scenarios.shipped import located
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.bag import descriptors
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

BASE = """
name: two_makes
duration_s: 2
fleet: {drones: 3, formation: {shape: line, spacing_m: 20}}
mission: {phases: [{phase: search}]}
perception: {detector: surrogate, sample_rate_hz: 1}
"""
TRAFFIC = "perception.detector=none"
WITHIN, BETWEEN = ((0, 1), (1, 0)), ((0, 2), (1, 2), (2, 0), (2, 1))
"""Links within the make of drones 0 and 1, and between it and drone 2's."""


def fleet(make: str = "", *more: str) -> Scenario:
    """Drone 2 is of another make, if one is given. No recorded flight differs in one field of a make alone."""
    makes = [f"fleet.makes=[{{name: theirs, drones: [2], {make}}}]"] if make else []
    return loads(BASE, overrides=[*makes, *more])


@functools.cache
def silent(make: str = "", *more: str) -> SortieRecord:
    return run_sortie(fleet(make, *more), "silence")


def kinds(record: SortieRecord) -> dict[tuple[int, int], set[str]]:
    """By link, what was sent on it."""
    found: dict[tuple[int, int], set[str]] = {}
    for r in record.tables["transmissions"].to_pylist():
        found.setdefault((r["drone"], r["peer"]), set()).add(r["representation"])
    return found


def delivered(record: SortieRecord, what: str) -> set[tuple[int, int, str]]:
    rows = record.tables["transmissions"].to_pylist()
    came = [r for r in rows if r["representation"] == what and r["status"] == "delivered"]
    return {(r["drone"], r["peer"], r["reason"]) for r in came}


def fused(record: SortieRecord) -> set[tuple[int, int, str]]:
    rows = record.tables["fusions"].to_pylist()
    return {(r["drone"], p, how) for r in rows for p, how in zip(r["peers"], r["representations"], strict=True)}


def column(record: SortieRecord, table: str, name: str, drone: int) -> list[Any]:
    return [r[name] for r in record.tables[table].to_pylist() if r["drone"] == drone]


def boxes(record: SortieRecord, drone: int) -> list[tuple[float, ...]]:
    rows = record.tables["detections"].to_pylist()
    return [tuple(r[c] for c in ("t_s", "x_m", "y_m", "score")) for r in rows if r["drone"] == drone]


def maps_to_all(view: FleetView) -> list[Directive]:
    """A policy that does not know of networks."""
    return [full_sharing(view.ego, p, 0.2, "everyone") for p in view.peers]


# --- feature spaces ------------------------------------------------------------------------------


def test_maps_of_another_network_take_the_air_and_are_refused() -> None:
    record = run_sortie(fleet("feature_space: net-b", *PATIENT), maps_to_all)
    refused = {(i, j, "other_feature_space") for i, j in BETWEEN}
    assert delivered(record, "features") == {(*link, "") for link in WITHIN} | refused
    assert fused(record) == {(*link, "features") for link in WITHIN}
    fates = outcome(record)["payload_fates"]
    assert fates["delivered/other_feature_space"] > 2 * len(BETWEEN)


def test_a_policy_that_knows_sends_boxes_between_networks_and_they_are_joined() -> None:
    """In the library's scenario of two makes: drones 3 and 4 have another network, by the name that they publish."""
    record = recorded("makes")
    others = {3, 4}
    for (sender, receiver), sent in kinds(record).items():
        if (sender in others) == (receiver in others):
            assert "features" in sent
        else:
            assert sent == {"detections"}
    assert {how for i, j, how in fused(record) if (i in others) != (j in others)} == {"detections"}
    assert "delivered/other_feature_space" not in outcome(record)["payload_fates"]
    assert {d.feature_space for _, d in descriptors(record) if d.agent_id in others} == {"scout"}
    sizes = {r["drone"]: r["wire_bytes"] for r in record.tables["descriptors"].to_pylist()}
    assert sizes[3] == sizes[0] + 1 + 3 + len("scout")


def test_codes_of_another_codebook_are_refused_and_a_policy_that_knows_sends_boxes(tmp_path: Path) -> None:
    shipped = Path("fine.codebook.safetensors")  # named without its folder
    assert codebooks(fleet(f"codebook: {shipped}", TRAFFIC)) == ("", "", codebook_digest(located(shipped)))
    book = tmp_path / "theirs.safetensors"
    book.write_bytes(b"another codebook")
    other = fleet(f"codebook: {book}", TRAFFIC, *PATIENT)

    def to_all(view: FleetView) -> list[Directive]:
        """Codes, and from drone 1 maps, which need no codebook."""
        rung = Representation.FEATURES if view.ego == 1 else Representation.CODES
        return [d._replace(representation=rung) for d in maps_to_all(view)]

    record = run_sortie(other, to_all)
    refused = {(i, j, "other_feature_space") for i, j in BETWEEN if i != 1}
    assert delivered(record, "codes") == {(0, 1, "")} | refused
    assert delivered(record, "features") == {(1, 0, ""), (1, 2, "")}
    sizes = {r["drone"]: r["wire_bytes"] for r in record.tables["descriptors"].to_pylist()}
    assert sizes[2] == sizes[0] + 1 + 3 + 7  # version, type and length, digest
    assert {d.codebook for _, d in descriptors(record) if d.agent_id == 2} == {codebook_digest(book)}
    knows = kinds(run_sortie(fleet(f"codebook: {book}", TRAFFIC, *PATIENT, "policy={name: codes}")))
    assert all("codes" in knows[link] for link in WITHIN)
    assert all(knows[link] == {"detections"} for link in BETWEEN)
    book.unlink()
    with pytest.raises(InputError, match="cannot be read as a codebook"):
        run_sortie(other, to_all)


def test_a_fleet_of_old_and_new_drones_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    """One drone publishes the paper's bytes alone, another fields that nobody knows.

    With longer descriptors others collide, so neither the links' health nor the policy may go by which were heard.
    """
    import sortie.fleet.agent as agent

    encode = agent.encode_descriptor

    def versions(d: Descriptor) -> bytes:
        return encode(d) + (b"" if d.agent_id else b"\x09\xf0\x02\x00hi")

    plain = run_sortie(fleet("", TRAFFIC, *PATIENT), maps_to_all)
    monkeypatch.setattr(agent, "encode_descriptor", versions)
    mixed = run_sortie(fleet("", TRAFFIC, *PATIENT), maps_to_all)
    assert mixed.tables["drops"].num_rows == 0
    assert mixed.tables["directives"].num_rows == plain.tables["directives"].num_rows > 0


# --- networks ------------------------------------------------------------------------------------


def test_each_drone_detects_with_its_own_network_and_its_boxes_are_what_that_network_found(tmp_path: Path) -> None:
    """The other network places all boxes worse and has other false positives."""
    shipped, weaker = load(SHIPPED), tmp_path / "weaker.safetensors"
    worse = {"residuals": shipped.residuals * np.float32(3.0), "alarm_pool": shipped.alarm_pool[:, :, ::-1]}
    save(weaker, replace(shipped, card={**shipped.card, "id": "weaker"}, **worse))
    ours, theirs, both = silent(), silent("", f"perception.weights={weaker}"), silent(f"weights: {weaker}")
    assert boxes(ours, 2) != boxes(theirs, 2)
    assert [boxes(both, i) for i in (0, 1)] == [boxes(ours, i) for i in (0, 1)]
    assert boxes(both, 2) == boxes(theirs, 2)
    assert both.calibration == f"{ours.calibration} + weaker"
    one, other = (run_sortie(fleet(make)) for make in ("feature_space: net-b", f"weights: {weaker}"))
    assert (0, 2, "detections") in fused(other)
    assert (0, 2, "features") not in fused(other)
    assert boxes(other, 0) != boxes(one, 0)


def test_a_drone_without_a_detector_sends_context_alone_and_uses_boxes() -> None:
    """Maps and raw images are of no use to it, from a policy that does not know; one that knows sends boxes."""
    record = run_sortie(fleet("detector: none"), "all-4")
    assert {i for i, _ in kinds(record)} == {0, 1}
    assert {what for (_, j), sent in kinds(record).items() if j == 2 for what in sent} == {"detections"}
    assert {how for i, _, how in fused(record) if i == 2} == {"detections"}
    assert boxes(record, 2), "it has the boxes that it was sent"
    assert not boxes(silent("detector: none"), 2), "and finds nothing itself"
    assert column(record, "states", "looks", 2)[-1] == 0
    assert set(column(record, "descriptors", "gpu_headroom", 2)) == {1.0}
    assert column(record, "states", "spent_j", 2)[-1] < column(record, "states", "spent_j", 0)[-1]
    assert all(not any(grid) for grid in column(record, "descriptors", "coverage_grid", 2))
    assert record.tables["trust"].num_rows == 0

    def all_kinds(view: FleetView) -> list[Directive]:
        rung = {0: Representation.FEATURES, 1: Representation.RAW}.get(view.ego, Representation.NONE)
        sparse = full_sharing(view.ego, 2, 0.05, "")._replace(representation=rung, rate_hz=2.0, deadline_s=5.0)
        return [sparse] if 2 in view.peers else []

    given = run_sortie(fleet("detector: none", "duration_s=3"), all_kinds)
    assert {(0, 2), (1, 2)} <= {(i, j) for what in ("features", "raw") for i, j, _ in delivered(given, what)}
    assert not [1 for i, *_ in fused(given) if i == 2]


# --- machines ------------------------------------------------------------------------------------

HEAVY = "airframe: {mass_kg: 3}, battery: {capacity_wh: 60, avionics_w: 30}, computer: {cpu_cores: 2}, tx_power_dbm: 10"
OWN = "camera: {field_of_view_deg: 90, pitch_deg: 40}, altitude_offset_m: 12, antenna: dipole, compute_delay_s: 0.06"
FLEET_WIDE = {
    HEAVY: (
        "fleet.airframe={mass_kg: 3}",
        "fleet.battery={capacity_wh: 60, avionics_w: 30}",
        "fleet.computer={cpu_cores: 2}",
        "radio.tx_power_dbm=10",
    ),
    OWN: (
        "fleet.camera={field_of_view_deg: 90, pitch_deg: 40}",
        "fleet.formation.altitude_m=72",
        "radio.antenna=dipole",
        "perception.compute_delay_s=0.06",
    ),
    "detector: surrogate": (),
}
"""A make, and the fields of a fleet that is of it."""


@pytest.mark.parametrize("own", FLEET_WIDE)
def test_a_make_is_the_fleet_when_all_drones_are_of_it(own: str) -> None:
    one = f"fleet.makes=[{{name: all, drones: [0, 1, 2], {own}}}]"
    two = f"fleet.makes=[{{name: a, drones: [0, 2], {own}}}, {{name: b, drones: [1], {own}}}]"
    prints = [
        run_sortie(loads(BASE, overrides=["duration_s=1", *sets])).fingerprint
        for sets in (FLEET_WIDE[own], (one,), (two,))
    ]
    assert prints[0] == prints[1] == prints[2]


def test_a_make_changes_its_own_drones_alone() -> None:
    plain, heavy = silent("", TRAFFIC), silent(HEAVY, TRAFFIC)
    for drone in (0, 1):
        for table, name in (("states", "soc"), ("states", "spent_j"), ("descriptors", "cpu_headroom")):
            assert column(heavy, table, name, drone) == column(plain, table, name, drone)
    assert column(heavy, "states", "spent_j", 2)[-1] > 1.2 * column(plain, "states", "spent_j", 2)[-1]
    for table, name in (("states", "soc"), ("descriptors", "cpu_headroom")):
        assert column(heavy, table, name, 2)[-1] < column(plain, table, name, 2)[-1]


def seen(record: SortieRecord, drone: int, least: Coverage) -> float:
    grids = column(record, "descriptors", "coverage_grid", drone)
    return float(np.mean([(unpack_grid(grid) >= least).sum() for grid in grids]))


def test_an_own_camera_changes_the_footprint_the_coverage_and_what_is_found() -> None:
    narrow, wide, plain = (silent(f"camera: {{field_of_view_deg: {fov}}}" if fov else "") for fov in (40, 100, 0))
    for drone in (0, 1):
        assert boxes(narrow, drone) == boxes(wide, drone) == boxes(plain, drone)
    covered = [seen(k, 2, Coverage.POOR) for k in (narrow, plain, wide)]
    assert covered[0] < 0.7 * covered[1] < 0.7 * covered[2]
    assert len(boxes(narrow, 2)) < 0.9 * len(boxes(plain, 2)), "less of the ground, fewer cars"
    radii = [next(d.footprint_radius_m for _, d in descriptors(k) if d.agent_id == 2) for k in (narrow, plain, wide)]
    assert radii == pytest.approx([60 * np.tan(np.radians(a)) for a in (20, 35, 50)], rel=0.02)
    steep, coarse = silent("camera: {pitch_deg: 65}"), silent("camera: {width_px: 96}", TRAFFIC)
    assert seen(steep, 2, Coverage.POOR) < covered[1]
    assert seen(coarse, 2, Coverage.POOR) == pytest.approx(covered[1], rel=0.02)
    assert seen(coarse, 2, Coverage.WELL) < 0.5 * seen(plain, 2, Coverage.WELL)
    assert seen(coarse, 0, Coverage.WELL) == seen(plain, 0, Coverage.WELL)
    assert all(k.tables["trust"].num_rows == 0 for k in (narrow, wide, steep)), "peers know each other's cameras"


def test_drones_of_one_formation_fly_at_several_heights() -> None:
    plain, mixed = silent(), silent("altitude_offset_m: 25")
    for drone, offset_m in ((0, 0.0), (1, 0.0), (2, 25.0)):
        heights_m = np.add(column(plain, "states", "z_m", drone), offset_m)
        np.testing.assert_allclose(column(mixed, "states", "z_m", drone), heights_m, rtol=1e-12)
        for axis in ("x_m", "y_m"):
            assert column(mixed, "states", axis, drone) == column(plain, "states", axis, drone)
    assert boxes(mixed, 0) == boxes(plain, 0)
    assert boxes(mixed, 2) != boxes(plain, 2)


def snr_db(make: str, *more: str) -> dict[tuple[int, int], float]:
    """By link, the median."""
    record = run_sortie(fleet(make, TRAFFIC, "radio.shadowing_sigma_db=0", *more), "boxes")
    each: dict[tuple[int, int], list[float]] = {}
    for r in record.tables["transmissions"].to_pylist():
        each.setdefault((r["drone"], r["peer"]), []).append(r["snr_db"])
    return {link: float(np.median(db)) for link, db in each.items()}


def test_an_own_antenna_hears_and_is_heard_less_from_above_and_a_weak_sender_is_heard_worse() -> None:
    high = "altitude_offset_m: 40"
    around, dipole = (snr_db(f"{high}, antenna: {antenna}") for antenna in ("isotropic", "dipole"))
    lost_db = {link: around[link] - dipole[link] for link in around}
    assert lost_db[0, 1] == pytest.approx(0.0, abs=0.5)
    assert all(lost_db[link] > 3.0 for link in BETWEEN)
    weak = snr_db(f"{high}, antenna: isotropic, tx_power_dbm: 10")
    lost_db = {link: around[link] - weak[link] for link in around.keys() & weak.keys()}
    assert all(lost_db[2, i] == pytest.approx(10.0, abs=1.0) for i in (0, 1))
    assert all(lost_db[link] == pytest.approx(0.0, abs=1.0) for link in ((0, 1), (0, 2), (1, 2)))
    loud = run_sortie(fleet("tx_power_dbm: 30", TRAFFIC))
    down = "fleet.makes=[{name: a, drones: [0, 1], tx_power_dbm: 20}]"
    same = run_sortie(loads(BASE, overrides=[TRAFFIC, "radio.tx_power_dbm=30", down]))
    assert same.fingerprint == loud.fingerprint, "a stronger sender is the same fleet with weaker others"


def test_a_slower_computer_sends_later_and_is_busier() -> None:
    plain, slow = (run_sortie(fleet(make, TRAFFIC)) for make in ("", "compute_delay_s: 0.08"))

    def in_frame_s(record: SortieRecord, drone: int) -> float:
        return float(np.median([t_s % 0.1 for t_s in column(record, "transmissions", "t_sent_s", drone)]))

    assert in_frame_s(slow, 2) - in_frame_s(plain, 2) == pytest.approx(0.05, abs=1e-6)
    assert in_frame_s(slow, 0) == pytest.approx(in_frame_s(plain, 0), abs=1e-6)
    assert column(slow, "descriptors", "gpu_headroom", 2)[-1] < column(plain, "descriptors", "gpu_headroom", 2)[-1]
    compute_j = [
        {r["drone"]: r["energy_j"] for r in record.tables["energy"].to_pylist() if r["cause"] == "compute"}
        for record in (plain, slow)
    ]
    assert compute_j[1][2] > compute_j[0][2]
    assert compute_j[1][1] == compute_j[0][1]
    assert slow.tables["trust"].num_rows == 0, "its peers know that it takes longer"


def test_a_make_has_a_policy_of_its_own_until_another_is_asked_for() -> None:
    """As `sortie fly --policy`, `sortie compare` and campaigns ask for it."""
    scenario = fleet("policy: all-4, policy_params: {received_budget: 0.1}", TRAFFIC)
    own, asked = (run_sortie(scenario, policy) for policy in (None, "best-2"))
    assert {*column(own, "directives", "policy", 2)} == {"all-4(received_budget=0.1)"}
    assert {*column(own, "directives", "policy", 0)} == {"worked"}
    assert {*asked.tables["directives"]["policy"].to_pylist()} == {"best-2"}


# --- errors --------------------------------------------------------------------------------------

NO_TRACE = "must be left out where radio.trace says what links are worth"
OTHER_NAME = "must be another name than that of drone"
WRONG: list[tuple[str, str, str]] = [
    ("{name: a, drones: [3]}", "", "drones.0: 3, must be below fleet.drones = 3"),
    ("{name: a, drones: [1, 1]}", "", "drones.1: 1, must be of one make, it is of 'a' already"),
    ("{name: a, drones: [1]}, {name: a, drones: [2]}", "", "name: 'a', must be given once, it is a make above"),
    (
        "{name: a, drones: [1], policy_params: {k: 1}}",
        "",
        "policy_params: {'k': 1}, must be left out where there is no",
    ),
    ("{name: a, drones: [1], weights: x}", TRAFFIC, "weights: 'x', must be left out for none"),
    ("{name: a, drones: [1], tx_power_dbm: 3}", "radio.trace=links.csv", f"tx_power_dbm: 3, {NO_TRACE}"),
    ("{name: a, drones: [1], antenna: dipole}", "radio.trace=links.csv", f"antenna: 'dipole', {NO_TRACE}"),
    (
        "{name: a, drones: [1], altitude_offset_m: -55}",
        "",
        "altitude_offset_m: -55, must be such that its drones fly at",
    ),
    ("{name: a, drones: [1], camera: {width_px: 100}}", "", "camera.width_px: 100, must be a multiple of 16"),
    ("{name: a, drones: [1], camera: {width_px: 320}}", "", "camera.width_px: 320, must be 160 for the surrogate"),
    ("{name: a, drones: [1], camera: {field_of_view_deg: 130}}", "", "camera.field_of_view_deg: 130"),
    (
        "{name: a, drones: [1], detector: surrogate}",
        TRAFFIC,
        "detector: 'surrogate', must be left out where perception",
    ),
    ("{name: a, drones: [1], detector: torch, feature_space: ''}", "", f"feature_space: '', {OTHER_NAME} 0"),
    (
        "{name: a, drones: [1], weights: x, feature_space: s}, {name: b, drones: [2], feature_space: s}",
        "",
        f"feature_space: 's', {OTHER_NAME} 1",
    ),
    (
        "{name: a, drones: [1], battery: {life_cycles: 10}}",
        "fleet.overrides=[{drone: 1, cycles: 30}]",
        "cycles: 30, must be at most twice the drone's battery.life_cycles = 10",
    ),
]
"""Makes, what else is set, and the error after the path of the section."""


def test_makes_that_do_not_fit_are_refused() -> None:
    wrong = {}
    for makes, more, words in WRONG:
        try:
            loads(BASE, overrides=[f"fleet.makes=[{makes}]", *([more] if more else [])])
        except ScenarioError as error:
            if f".{words}" in str(error):
                continue
            wrong[makes] = str(error)
        else:
            wrong[makes] = "accepted"
    assert wrong == {}
