"""Different drones in one fleet: three drones of two makes, each with its own machine, radio, policy and network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sim_examples import PATIENT

import sortie
from sortie.fleet.coverage import unpack_grid
from sortie.fleet.plane import codebooks
from sortie.perception.errors import InputError
from sortie.perception.files import codebook_digest
from sortie.perception.surrogate.model import SHIPPED, load, save
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Coverage, Descriptor, Directive, FleetView, Representation
from sortie.scenarios.reading.load import ScenarioError, loads
from sortie.scenarios.schema import Scenario
from sortie.scenarios.shipped import NETWORKS, located
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.bag import descriptors
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

BASE = """
name: two_makes
duration_s: 4
fleet: {drones: 3, formation: {shape: line, spacing_m: 20}}
mission: {phases: [{phase: search}]}
perception: {detector: surrogate, sample_rate_hz: 1}
"""
HEAVY = "airframe: {mass_kg: 3}, battery: {capacity_wh: 60, avionics_w: 30}, computer: {cpu_cores: 2}, tx_power_dbm: 10"


def fleet(make: str = "", *more: str) -> Scenario:
    makes = [f"fleet.makes=[{{name: theirs, drones: [2]{make}}}]"] if make else []
    return loads(BASE, overrides=[*makes, *more])


def sent(record: SortieRecord) -> list[tuple[int, int, str, str, str]]:
    rows = record.tables["transmissions"].to_pylist()
    return [(r["drone"], r["peer"], r["representation"], r["status"], r["reason"]) for r in rows]


def fused(record: SortieRecord) -> set[tuple[int, int, str]]:
    rows = record.tables["fusions"].to_pylist()
    return {(r["drone"], p, how) for r in rows for p, how in zip(r["peers"], r["representations"], strict=True)}


def column(record: SortieRecord, table: str, name: str, drone: int) -> list[float]:
    return [r[name] for r in record.tables[table].to_pylist() if r["drone"] == drone]


# --- feature spaces ------------------------------------------------------------------------------

OTHER = ", feature_space: net-b"


def maps_to_all(view: FleetView) -> list[Directive]:
    """A policy that does not know of networks."""
    return [full_sharing(view.ego, p, 1.0, "everyone") for p in view.peers]


def test_maps_of_another_network_take_the_air_and_are_refused() -> None:
    record = run_sortie(fleet(OTHER, *PATIENT), maps_to_all)
    delivered = {(i, j, why) for i, j, what, status, why in sent(record) if (what, status) == ("features", "delivered")}
    own = {(0, 1, ""), (1, 0, "")}
    foreign = {(i, j, "other_feature_space") for i, j in ((0, 2), (1, 2), (2, 0), (2, 1))}
    assert delivered == own | foreign
    assert fused(record) == {(0, 1, "features"), (1, 0, "features")}
    fates = outcome(record)["payload_fates"]
    assert fates["delivered/other_feature_space"] == sum(why != "" for *_, s, why in sent(record) if s == "delivered")
    together = run_sortie(fleet("", *PATIENT), maps_to_all)
    assert (0, 2, "features") in fused(together), "one network: the same fleet fuses them"


def test_a_policy_that_knows_sends_boxes_there_and_they_are_joined() -> None:
    record = run_sortie(fleet(OTHER))
    rungs = {(i, j): {what for a, b, what, *_ in sent(record) if (a, b) == (i, j)} for i in range(3) for j in range(3)}
    assert "features" in rungs[0, 1]
    assert "features" in rungs[1, 0]
    assert all(rungs[pair] == {"detections"} for pair in ((0, 2), (1, 2), (2, 0), (2, 1)))
    assert {(0, 2, "detections"), (2, 0, "detections")} <= fused(record)
    assert not any(why == "other_feature_space" for *_, why in sent(record))


def test_a_make_may_name_a_shipped_codebook_without_its_folder() -> None:
    book = Path("fine.codebook.safetensors")
    named = codebooks(fleet(f", codebook: {book}", "perception.detector=none"))
    assert named == ("", "", codebook_digest(located(book)))


def test_codes_of_another_codebook_are_refused_and_a_policy_that_knows_sends_boxes(tmp_path: Path) -> None:
    book = tmp_path / "theirs.safetensors"
    book.write_bytes(b"another codebook")
    own = f", codebook: {book}"
    traffic_alone = ("perception.detector=none", *PATIENT)

    def to_all(view: FleetView) -> list[Directive]:
        return [d._replace(representation=Representation.CODES) for d in maps_to_all(view)]

    record = run_sortie(fleet(own, *traffic_alone), to_all)
    delivered = {(i, j, why) for i, j, what, status, why in sent(record) if (what, status) == ("codes", "delivered")}
    foreign = {(i, j, "other_feature_space") for i, j in ((0, 2), (1, 2), (2, 0), (2, 1))}
    assert delivered == {(0, 1, ""), (1, 0, "")} | foreign
    sizes = {r["drone"]: r["wire_bytes"] for r in record.tables["descriptors"].to_pylist()}
    assert sizes[2] == sizes[0] + 1 + 3 + 7  # version, type and length, digest
    assert {d.codebook for _, d in descriptors(record) if d.agent_id == 2} == {codebook_digest(book)}
    assert {d.feature_space for _, d in descriptors(record)} == {""}
    knows = run_sortie(fleet(own, *traffic_alone, "policy.name=codes", "policy.params={}"))
    rungs = {(i, j): {what for a, b, what, *_ in sent(knows) if (a, b) == (i, j)} for i in range(3) for j in range(3)}
    assert all("codes" in rungs[pair] for pair in ((0, 1), (1, 0)))
    assert all(rungs[pair] == {"detections"} for pair in ((0, 2), (1, 2), (2, 0), (2, 1)))
    maps = run_sortie(fleet(own, *traffic_alone), maps_to_all)
    assert not any(why for *_, why in sent(maps) if why == "other_feature_space"), "features need no codebook"
    book.unlink()
    with pytest.raises(InputError, match="cannot be read as a codebook"):
        run_sortie(fleet(own, *traffic_alone), to_all)


def test_descriptors_say_it_and_views_compare_it() -> None:
    views: dict[int, FleetView] = {}

    def policy(view: FleetView) -> list:  # type: ignore[type-arg]
        views[view.ego] = view
        return worked(view)

    record = run_sortie(fleet(OTHER), policy)
    assert {i: views[0].shares_features_with(i) for i in (1, 2)} == {1: True, 2: False}
    assert views[2].me is not None
    assert views[2].me.feature_space == "net-b"
    sizes = {r["drone"]: r["wire_bytes"] for r in record.tables["descriptors"].to_pylist()}
    assert sizes[2] == sizes[0] + 1 + 3 + len("net-b")
    assert {d.feature_space for _, d in descriptors(record) if d.agent_id == 2} == {"net-b"}


def test_a_fleet_of_old_and_new_drones_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    """One drone publishes the paper's bytes alone, another fields that nobody knows.

    With longer descriptors others collide, so neither the links' health nor the policy may go by which were heard.
    """
    import sortie.fleet.agent as agent

    encode = agent.encode_descriptor

    def versions(d: Descriptor) -> bytes:
        return encode(d) + (b"" if d.agent_id else b"\x09\xf0\x02\x00hi")

    plain = run_sortie(fleet("", *PATIENT), maps_to_all)
    monkeypatch.setattr(agent, "encode_descriptor", versions)
    mixed = run_sortie(fleet("", *PATIENT), maps_to_all)
    assert mixed.tables["drops"].num_rows == 0
    assert mixed.tables["directives"].num_rows == plain.tables["directives"].num_rows > 0


# --- networks ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weaker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another network: one that places all boxes worse and has other false positives."""
    shipped = load(SHIPPED)
    path = tmp_path_factory.mktemp("weights") / "weaker.safetensors"
    save(
        path,
        replace(
            shipped,
            card={**shipped.card, "id": "weaker"},
            residuals=shipped.residuals * np.float32(3.0),
            alarm_pool=shipped.alarm_pool[:, :, ::-1],
        ),
    )
    return path


def boxes(record: SortieRecord, drone: int) -> list[tuple[float, ...]]:
    rows = record.tables["detections"].to_pylist()
    return [tuple(r[c] for c in ("t_s", "x_m", "y_m", "score")) for r in rows if r["drone"] == drone]


def test_each_drone_detects_with_its_own_network(weaker: Path) -> None:
    ours = run_sortie(fleet(), "silence")
    theirs = run_sortie(fleet("", f"perception.weights={weaker}"), "silence")
    both = run_sortie(fleet(f", weights: {weaker}"), "silence")
    assert boxes(ours, 2) != boxes(theirs, 2)
    assert [boxes(both, i) for i in (0, 1)] == [boxes(ours, i) for i in (0, 1)]
    assert boxes(both, 2) == boxes(theirs, 2)
    assert both.calibration == f"{ours.calibration} + weaker"


def test_boxes_of_another_network_are_what_that_network_found(weaker: Path) -> None:
    """What a drone has of a peer's detections depends on the peer's network, its own boxes do not."""
    ours = run_sortie(fleet(OTHER))
    both = run_sortie(fleet(f", weights: {weaker}"))
    assert (0, 2, "detections") in fused(both)
    assert (0, 2, "features") not in fused(both)
    assert boxes(both, 0) != boxes(ours, 0)


# --- detectors -----------------------------------------------------------------------------------

TORCH = ("perception.detector=torch", "duration_s=1.5", "perception.scene.moving_cars_per_km=30")


@pytest.mark.slow
def test_two_torch_networks_in_one_flight() -> None:
    """Each drone's boxes are its own network's; maps stay within a network, and boxes of the other one are joined."""
    net = NETWORKS / "disconet.safetensors"
    ours, theirs = (
        run_sortie(fleet("", *TORCH), "silence"),
        run_sortie(fleet("", *TORCH, f"perception.weights={net}"), "silence"),
    )
    alone = run_sortie(fleet(f", weights: {net}", *TORCH), "silence")
    assert boxes(ours, 2) != boxes(theirs, 2)
    assert [boxes(alone, i) for i in (0, 1)] == [boxes(ours, i) for i in (0, 1)]
    assert boxes(alone, 2) == boxes(theirs, 2)
    assert alone.detector == "torch"

    shared = run_sortie(fleet(f", weights: {net}", *TORCH), "all-4")
    assert {(0, 1, "features"), (1, 0, "features"), (0, 2, "detections"), (2, 0, "detections")} <= fused(shared)
    assert not {(0, 2, "features"), (2, 0, "features"), (1, 2, "features"), (2, 1, "features")} & fused(shared)
    last_s = max(t_s for t_s, *_ in boxes(shared, 2))
    got, had = ({b for b in boxes(record, 2) if b[0] == last_s} for record in (shared, alone))
    added = [b for b in got - had if not any(np.hypot(b[1] - o[1], b[2] - o[2]) < 0.01 for o in had)]
    sent_to_2 = [b for i in (0, 1) for b in boxes(alone, i)]
    assert added, "it joins what the others found"
    near = [min(np.hypot(b[1] - o[1], b[2] - o[2]) for o in sent_to_2) for b in added]
    assert np.median(near) < 1.0, "which is where their own network put it"


@pytest.mark.slow
def test_a_torch_drone_and_a_surrogate_one_exchange_boxes() -> None:
    record = run_sortie(fleet(", detector: surrogate", *TORCH), "all-4")
    assert record.detector == "torch + surrogate"
    assert {(0, 1, "features"), (0, 2, "detections"), (2, 0, "detections")} <= fused(record)
    assert {p for a, p, how in fused(record) if how == "features"} == {0, 1}
    ours, theirs = (
        run_sortie(fleet("", *TORCH, *more), "silence") for more in ((), ("perception.detector=surrogate",))
    )
    alone = run_sortie(fleet(", detector: surrogate", *TORCH), "silence")
    assert boxes(alone, 0) == boxes(ours, 0)
    assert boxes(alone, 2) == boxes(theirs, 2)


def test_a_drone_without_a_detector_sends_context_alone_and_uses_boxes() -> None:
    record = run_sortie(fleet(", detector: none"), "all-4")
    assert {i for i, *_ in sent(record)} == {0, 1}
    assert {what for i, j, what, *_ in sent(record) if j == 2} == {"detections"}
    assert {how for i, _, how in fused(record) if i == 2} == {"detections"}
    assert boxes(record, 2), "it has the boxes that it was sent"
    assert not boxes(run_sortie(fleet(", detector: none"), "silence"), 2), "and finds nothing itself"
    assert column(record, "states", "looks", 2)[-1] == 0
    assert set(column(record, "descriptors", "gpu_headroom", 2)) == {1.0}
    assert column(record, "states", "spent_j", 2)[-1] < column(record, "states", "spent_j", 0)[-1]
    assert all(not any(grid) for grid in column(record, "descriptors", "coverage_grid", 2))
    assert record.tables["trust"].num_rows == 0


def test_a_ground_station_without_a_camera_is_sent_boxes_and_no_maps() -> None:
    station = ("fleet.ground=[{drone: 2}]", "perception.detector=none", "duration_s=2")
    record = run_sortie(fleet("", *station, "policy={name: all-4, params: {received_budget: 0.05}}"))
    kinds = {(j, what) for _, j, what, *_ in sent(record)}
    assert {(0, "features"), (2, "detections")} <= kinds
    assert (2, "features") not in kinds


def test_maps_and_raw_images_are_of_no_use_to_it() -> None:
    def all_kinds(view: FleetView) -> list[Directive]:
        rung = {0: Representation.FEATURES, 1: Representation.RAW}.get(view.ego, Representation.NONE)
        sparse = full_sharing(view.ego, 2, 0.05, "")._replace(representation=rung, rate_hz=2.0, deadline_s=5.0)
        return [sparse] if 2 in view.peers else []

    record = run_sortie(fleet(", detector: none"), all_kinds)
    assert {(0, 2, "features"), (1, 2, "raw")} <= {
        (i, j, what) for i, j, what, status, _ in sent(record) if status == "delivered"
    }
    assert not [1 for i, *_ in fused(record) if i == 2]


# --- machines ------------------------------------------------------------------------------------


def test_a_make_changes_its_own_drones_alone() -> None:
    plain, heavy = run_sortie(fleet(), "silence"), run_sortie(fleet(f", {HEAVY}"), "silence")
    for drone in (0, 1):
        assert column(heavy, "states", "soc", drone) == column(plain, "states", "soc", drone)
        assert column(heavy, "states", "spent_j", drone) == column(plain, "states", "spent_j", drone)
    assert column(heavy, "states", "spent_j", 2)[-1] > 1.2 * column(plain, "states", "spent_j", 2)[-1]
    assert column(heavy, "states", "soc", 2)[-1] < column(plain, "states", "soc", 2)[-1]
    assert column(heavy, "descriptors", "cpu_headroom", 2)[-1] < column(plain, "descriptors", "cpu_headroom", 2)[-1]
    assert column(heavy, "descriptors", "cpu_headroom", 0)[-1] == column(plain, "descriptors", "cpu_headroom", 0)[-1]


OWN = "camera: {field_of_view_deg: 90, pitch_deg: 40}, altitude_offset_m: 12, antenna: dipole, compute_delay_s: 0.06"


@pytest.mark.parametrize(
    ("own", "fleets"),
    [
        (
            HEAVY,
            (
                "fleet.airframe={mass_kg: 3}", "fleet.battery={capacity_wh: 60, avionics_w: 30}",
                "fleet.computer={cpu_cores: 2}", "radio.tx_power_dbm=10",
            ),
        ),
        (
            OWN,
            (
                "fleet.camera={field_of_view_deg: 90, pitch_deg: 40}", "fleet.formation.altitude_m=72",
                "radio.antenna=dipole", "perception.compute_delay_s=0.06",
            ),
        ),
        ("detector: surrogate", ()),
    ],
)  # fmt: skip
def test_a_make_is_the_fleet_when_all_drones_are_of_it(own: str, fleets: tuple[str, ...]) -> None:
    one = loads(BASE, overrides=[f"fleet.makes=[{{name: all, drones: [0, 1, 2], {own}}}]"])
    two = loads(BASE, overrides=[f"fleet.makes=[{{name: a, drones: [0, 2], {own}}}, {{name: b, drones: [1], {own}}}]"])
    fleet_wide = run_sortie(loads(BASE, overrides=fleets)).fingerprint
    assert run_sortie(one).fingerprint == fleet_wide
    assert run_sortie(two).fingerprint == fleet_wide


def seen(record: SortieRecord, drone: int, least: Coverage) -> float:
    grids = column(record, "descriptors", "coverage_grid", drone)
    return float(np.mean([(unpack_grid(grid) >= least).sum() for grid in grids]))


def test_a_camera_of_one_s_own_changes_the_footprint_the_coverage_and_what_is_found() -> None:
    kinds = [run_sortie(fleet(f", camera: {{field_of_view_deg: {fov}}}"), "silence") for fov in (40, 70, 100)]
    plain = run_sortie(fleet(), "silence")
    for drone in (0, 1):
        assert {str(boxes(k, drone)) for k in kinds} == {str(boxes(plain, drone))}
    assert boxes(kinds[1], 2) == boxes(plain, 2)
    covered = [seen(k, 2, Coverage.POOR) for k in kinds]
    assert covered[0] < 0.7 * covered[1] < 0.7 * covered[2]
    assert len(boxes(kinds[0], 2)) < 0.9 * len(boxes(kinds[1], 2)), "less of the ground, fewer cars"
    radii = [next(d.footprint_radius_m for _, d in descriptors(k) if d.agent_id == 2) for k in kinds]
    assert radii == pytest.approx([60 * np.tan(np.radians(a)) for a in (20, 35, 50)], rel=0.02)
    steep = run_sortie(fleet(", camera: {pitch_deg: 65}"), "silence")
    assert seen(steep, 2, Coverage.POOR) < covered[1]
    assert all(k.tables["trust"].num_rows == 0 for k in (*kinds, steep)), "peers know each other's cameras"


def test_coarser_pictures_show_less_ground_well_and_the_rest_as_before() -> None:
    fine, coarse = (
        run_sortie(fleet(more, "perception.detector=none"), "silence") for more in ("", ", camera: {width_px: 96}")
    )
    assert seen(coarse, 2, Coverage.POOR) == pytest.approx(seen(fine, 2, Coverage.POOR), rel=0.02)
    assert seen(coarse, 2, Coverage.WELL) < 0.5 * seen(fine, 2, Coverage.WELL)
    assert seen(coarse, 0, Coverage.WELL) == seen(fine, 0, Coverage.WELL)


@pytest.mark.slow
def test_a_torch_drone_finds_less_in_coarser_pictures_and_in_narrower_ones() -> None:
    def found(more: str) -> tuple[int, list[tuple[float, ...]]]:
        record = run_sortie(fleet(more, *TORCH, "perception.score_threshold=0.6"), "silence")
        return len(boxes(record, 2)), boxes(record, 0)

    usual, coarse, narrow = (found(m) for m in ("", ", camera: {width_px: 64}", ", camera: {field_of_view_deg: 40}"))
    assert coarse[0] < 0.7 * usual[0]
    assert narrow[0] < 0.9 * usual[0]
    assert coarse[1] == narrow[1] == usual[1]


def test_drones_of_one_formation_fly_at_several_heights() -> None:
    plain, mixed = run_sortie(fleet(), "silence"), run_sortie(fleet(", altitude_offset_m: 25"), "silence")
    for drone, offset_m in ((0, 0.0), (1, 0.0), (2, 25.0)):
        np.testing.assert_allclose(
            column(mixed, "states", "z_m", drone), np.add(column(plain, "states", "z_m", drone), offset_m), rtol=1e-12
        )
        for axis in ("x_m", "y_m"):
            assert column(mixed, "states", axis, drone) == column(plain, "states", axis, drone)
    assert boxes(mixed, 0) == boxes(plain, 0)
    assert boxes(mixed, 2) != boxes(plain, 2)


def test_an_antenna_of_its_own_hears_and_is_heard_less_from_above() -> None:
    def snr_db(antenna: str) -> dict[tuple[int, int], float]:
        record = run_sortie(
            fleet(f", altitude_offset_m: 40, antenna: {antenna}", "radio.shadowing_sigma_db=0"), "boxes"
        )
        rows = record.tables["transmissions"].to_pylist()
        each: dict[tuple[int, int], list[float]] = {}
        for r in rows:
            each.setdefault((r["drone"], r["peer"]), []).append(r["snr_db"])
        return {pair: float(np.median(db)) for pair, db in each.items()}

    all_round, dipole = snr_db("isotropic"), snr_db("dipole")
    drop_db = {pair: all_round[pair] - dipole[pair] for pair in all_round}
    assert drop_db[0, 1] == pytest.approx(0.0, abs=0.5)
    assert all(drop_db[pair] > 3.0 for pair in ((0, 2), (2, 0), (1, 2), (2, 1)))


def test_a_slower_computer_sends_later_and_is_busier() -> None:
    plain, slow = run_sortie(fleet()), run_sortie(fleet(", compute_delay_s: 0.08"))

    def in_frame_s(record: SortieRecord, drone: int) -> float:
        rows = record.tables["transmissions"].to_pylist()
        return float(np.median([r["t_sent_s"] % 0.1 for r in rows if r["drone"] == drone]))

    assert in_frame_s(slow, 2) - in_frame_s(plain, 2) == pytest.approx(0.05, abs=1e-6)
    assert in_frame_s(slow, 0) == pytest.approx(in_frame_s(plain, 0), abs=1e-6)
    assert column(slow, "descriptors", "gpu_headroom", 2)[-1] < column(plain, "descriptors", "gpu_headroom", 2)[-1]
    assert column(slow, "states", "spent_j", 2)[-1] > column(plain, "states", "spent_j", 2)[-1]
    computed_j = [
        {r["drone"]: r["energy_j"] for r in record.tables["energy"].to_pylist() if r["cause"] == "compute"}
        for record in (plain, slow)
    ]
    assert computed_j[1][1] == computed_j[0][1]
    assert slow.tables["trust"].num_rows == 0, "its peers know that it takes longer"


def test_a_weaker_sender_is_heard_worse_and_hears_as_before() -> None:
    def snr_db(record: SortieRecord) -> dict[tuple[int, int], float]:
        rows = record.tables["transmissions"].to_pylist()
        return {(r["drone"], r["peer"]): r["snr_db"] for r in rows if r["t_sent_s"] > 3}

    plain, weak = snr_db(run_sortie(fleet(), "all-4")), snr_db(run_sortie(fleet(", tx_power_dbm: 10"), "all-4"))
    drop_db = {pair: plain[pair] - weak[pair] for pair in plain.keys() & weak.keys()}
    assert all(drop_db[2, i] > 6.0 for i in (0, 1))
    assert abs(drop_db[0, 1]) < 4.0


def test_a_stronger_sender_is_the_same_fleet_with_weaker_others() -> None:
    up = run_sortie(fleet(", tx_power_dbm: 30"))
    down = loads(BASE, overrides=["radio.tx_power_dbm=30", "fleet.makes=[{name: a, drones: [0, 1], tx_power_dbm: 20}]"])
    assert run_sortie(down).fingerprint == up.fingerprint


def test_a_make_has_a_policy_of_its_own_until_another_is_asked_for() -> None:
    scenario = fleet(", policy: all-4, policy_params: {received_budget: 0.1}")
    deciding = {i: set(column(run_sortie(scenario), "directives", "policy", i)) for i in range(3)}
    assert deciding == {0: {"worked"}, 1: {"worked"}, 2: {"all-4(received_budget=0.1)"}}
    replaced = run_sortie(scenario, "best-2")
    assert {p for i in range(3) for p in column(replaced, "directives", "policy", i)} == {"best-2"}


# --- errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("makes", "more", "message"),
    [
        ("{name: a, drones: [3]}", (), "fleet.makes.0.drones.0: 3, must be below fleet.drones = 3"),
        ("{name: a, drones: [1, 1]}", (), "fleet.makes.0.drones.1: 1, must be of one make, it is of 'a' already"),
        (
            "{name: a, drones: [1]}, {name: b, drones: [1]}",
            (),
            "fleet.makes.1.drones.0: 1, must be of one make, it is of 'a' already",
        ),
        (
            "{name: a, drones: [1]}, {name: a, drones: [2]}",
            (),
            "fleet.makes.1.name: 'a', must be given once, it is a make above",
        ),
        (
            "{name: a, drones: [1], policy_params: {k: 1}}",
            (),
            "fleet.makes.0.policy_params: {'k': 1}, must be left out where there is no policy",
        ),
        (
            "{name: a, drones: [1], weights: x}",
            ("perception.detector=none",),
            "fleet.makes.0.weights: 'x', must be left out for none",
        ),
        (
            "{name: a, drones: [1], tx_power_dbm: 3}",
            ("radio.trace=links.csv",),
            "fleet.makes.0.tx_power_dbm: 3, must be left out where radio.trace says what links are worth",
        ),
        (
            "{name: a, drones: [1], antenna: dipole}",
            ("radio.trace=links.csv",),
            "fleet.makes.0.antenna: 'dipole', must be left out where radio.trace says what links are worth",
        ),
        (
            "{name: a, drones: [1], altitude_offset_m: -55}",
            (),
            "fleet.makes.0.altitude_offset_m: -55, must be such that its drones fly at 10 to 400 m, "
            "formation.altitude_m is 60",
        ),
        (
            "{name: a, drones: [1], camera: {width_px: 100}}",
            (),
            "fleet.makes.0.camera.width_px: 100, must be a multiple of 16, as pictures are 16:9",
        ),
        (
            "{name: a, drones: [1], camera: {width_px: 320}}",
            (),
            "fleet.makes.0.camera.width_px: 320, must be 160 for the surrogate, which was fitted to such pictures",
        ),
        (
            "{name: a, drones: [1], camera: {field_of_view_deg: 130}}",
            (),
            "fleet.makes.0.camera.field_of_view_deg: 130",
        ),
        (
            "{name: a, drones: [1], detector: surrogate}",
            ("perception.detector=none",),
            "fleet.makes.0.detector: 'surrogate', must be left out where perception.detector is none",
        ),
        (
            "{name: a, drones: [1], detector: none, weights: x}",
            (),
            "fleet.makes.0.weights: 'x', must be left out for none",
        ),
        (
            "{name: a, drones: [1], detector: torch, feature_space: ''}",
            (),
            "fleet.makes.0.feature_space: '', must be another name than that of drone 0, which has another network",
        ),
        (
            "{name: a, drones: [1], weights: x, feature_space: s}, {name: b, drones: [2], feature_space: s}",
            (),
            "fleet.makes.1.feature_space: 's', must be another name than that of drone 1, which has another network",
        ),
        (
            "{name: a, drones: [1], battery: {life_cycles: 10}}",
            ("fleet.overrides=[{drone: 1, cycles: 30}]",),
            "fleet.overrides.0.cycles: 30, must be at most twice the drone's battery.life_cycles = 10",
        ),
    ],
)
def test_makes_that_do_not_fit(makes: str, more: tuple[str, ...], message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        loads(BASE, overrides=[f"fleet.makes=[{makes}]", *more])
    assert message in str(caught.value)


def test_a_policy_that_is_asked_for_by_name_decides_for_makes_with_their_own_too() -> None:
    """As `sortie fly --policy`, `sortie compare` and campaigns ask for it."""
    make = {"name": "a", "drones": [1], "policy": "all-4", "policy_params": {"received_budget": 0.1}}
    own = {"duration_s": 2, "perception.detector": "none", "fleet.makes": [make]}
    for policy, of_make in ((None, "all-4(received_budget=0.1)"), ("best-2", "best-2")):
        run = sortie.fly("track_target", own, policy=policy)
        assert set(column(run.record, "directives", "policy", 1)) == {of_make}
