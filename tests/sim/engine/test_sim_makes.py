"""Different drones in one fleet: three drones of two makes, each with its own machine, radio, policy and network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sortie
from sortie.perception.surrogate.model import SHIPPED, load, save
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Descriptor, Directive, FleetView
from sortie.scenarios.reading.load import ScenarioError, loads
from sortie.scenarios.schema import Scenario
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
    record = run_sortie(fleet(OTHER), maps_to_all)
    delivered = {(i, j, why) for i, j, what, status, why in sent(record) if (what, status) == ("features", "delivered")}
    own = {(0, 1, ""), (1, 0, "")}
    foreign = {(i, j, "other_feature_space") for i, j in ((0, 2), (1, 2), (2, 0), (2, 1))}
    assert delivered == own | foreign
    assert fused(record) == {(0, 1, "features"), (1, 0, "features")}
    fates = outcome(record)["payload_fates"]
    assert fates["delivered/other_feature_space"] == sum(why != "" for *_, s, why in sent(record) if s == "delivered")
    together = run_sortie(fleet(), maps_to_all)
    assert (0, 2, "features") in fused(together), "one network: the same fleet fuses them"


def test_a_policy_that_knows_sends_boxes_there_and_they_are_joined() -> None:
    record = run_sortie(fleet(OTHER))
    rungs = {(i, j): {what for a, b, what, *_ in sent(record) if (a, b) == (i, j)} for i in range(3) for j in range(3)}
    assert "features" in rungs[0, 1]
    assert "features" in rungs[1, 0]
    assert all(rungs[pair] == {"detections"} for pair in ((0, 2), (1, 2), (2, 0), (2, 1)))
    assert {(0, 2, "detections"), (2, 0, "detections")} <= fused(record)
    assert not any(why == "other_feature_space" for *_, why in sent(record))


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
    """One drone publishes the paper's bytes alone, another fields that nobody knows."""
    import sortie.fleet.agent as agent

    encode = agent.encode_descriptor

    def versions(d: Descriptor) -> bytes:
        return encode(d) + (b"" if d.agent_id else b"\x09\xf0\x02\x00hi")

    plain = run_sortie(fleet())
    monkeypatch.setattr(agent, "encode_descriptor", versions)
    mixed = run_sortie(fleet())
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


def test_a_make_is_the_fleet_when_all_drones_are_of_it() -> None:
    one = loads(BASE, overrides=[f"fleet.makes=[{{name: all, drones: [0, 1, 2], {HEAVY}}}]"])
    fleet_wide = loads(
        BASE,
        overrides=[
            "fleet.airframe={mass_kg: 3}", "fleet.battery={capacity_wh: 60, avionics_w: 30}",
            "fleet.computer={cpu_cores: 2}", "radio.tx_power_dbm=10",
        ],
    )  # fmt: skip
    assert run_sortie(one).fingerprint == run_sortie(fleet_wide).fingerprint


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
