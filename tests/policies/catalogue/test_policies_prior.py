"""Prior methods: what they read and decide is the paper's table, and each decides as its description says."""

from __future__ import annotations

import math

import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue.coverage_cells import centre_cell, disc_around, seen_well
from sortie.policies.catalogue.deputies import deputies
from sortie.policies.catalogue.freshness import freshness
from sortie.policies.catalogue.prior import METHODS
from sortie.policies.catalogue.prior.hydracollab import hydracollab
from sortie.policies.catalogue.prior.syncnet import syncnet
from sortie.policies.catalogue.prior.when2com import when2com
from sortie.policies.catalogue.prior.where2comm import where2comm
from sortie.policies.catalogue.prior.who2com import who2com
from sortie.policies.contract import (
    COVERAGE_CELL_M,
    FEATURE_MAP_MEGABITS,
    Coverage,
    Directive,
    FleetView,
    PolicyError,
    Representation,
)
from sortie.policies.registry import POLICIES, handshake_bytes, missing_parts, own_fusion, resolve
from sortie.policies.verification.invariants.language import just_heard
from sortie.policies.verification.kit.views import draw_views
from sortie.scenarios.link_state import SILENT_MBPS

VIEWS = list(draw_views(0, 200))


def grid(*cells: tuple[int, int], state: Coverage = Coverage.WELL) -> bytes:
    """A coverage grid with these (row, column) in one state and all else unseen."""
    packed = bytearray(64)
    for row, column in cells:
        cell = 16 * row + column
        packed[cell // 4] |= state << (2 * (cell % 4))
    return bytes(packed)


def sees(view: FleetView, **cells: list[tuple[int, int]]) -> FleetView:
    """All drones in one place, each with the cells named `d0`, `d1` …"""
    at = {
        i: d._replace(position_m=(0.0, 0.0, 60.0), coverage_grid=grid(*cells.get(f"d{i}", [])))
        for i, d in view.descriptors.items()
    }
    return view._replace(descriptors=at)


def served(directives: list[Directive]) -> set[int]:
    return {d.destination for d in directives if d.representation != Representation.NONE}


# --- the table -----------------------------------------------------------------------------------


def test_every_method_is_registered() -> None:
    assert {POLICIES[name] for name in METHODS} == {m.policy for m in METHODS.values()}


def test_a_stand_in_says_so_by_its_name_and_what_it_lacks() -> None:
    assert {name for name in METHODS if not missing_parts(name)} == {"fixed-compression"}
    assert all(name.endswith("-style") == bool(missing_parts(name)) for name in POLICIES)
    assert POLICIES["when2com-style"] is when2com


def test_the_name_of_the_published_method_names_its_stand_in() -> None:
    with pytest.raises(PolicyError) as error:
        resolve("syncnet")
    assert str(error.value) == (
        "policy 'syncnet' is here as a stand-in alone, name it syncnet-style; it lacks the recurrent prediction of a late "
        "peer's features; they are moved by ego motion and weighted by delay"
    )


# --- grids ---------------------------------------------------------------------------------------


def test_cells_lie_where_the_drone_is() -> None:
    d = fleet_of(1).descriptors[0]._replace(coverage_grid=grid((0, 0), (15, 3), state=Coverage.NOVEL))
    at = d._replace(position_m=(5 * COVERAGE_CELL_M + 1, -2 * COVERAGE_CELL_M - 1, 60.0))
    assert seen_well(at) == {(-3 - 8, 5 - 8), (-3 - 8 + 15, 5 - 8 + 3)}
    assert centre_cell(at) == {(-3, 5)}
    assert seen_well(d._replace(coverage_grid=grid((4, 4), state=Coverage.POOR))) == set()


def test_the_disc_holds_its_cells() -> None:
    cells = frozenset({(0, 0), (0, 3), (2, 1)})
    x_m, y_m, radius_m = disc_around(cells)
    corners = [(c + i, r + j) for r, c in cells for i in (0, 1) for j in (0, 1)]
    assert all(math.hypot(c * COVERAGE_CELL_M - x_m, r * COVERAGE_CELL_M - y_m) <= radius_m + 1e-9 for c, r in corners)
    with pytest.raises(ValueError, match="cells is empty, must have at least one"):
        disc_around(frozenset())


# --- each method ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["v2vnet-style", "disconet-style"])
def test_all_to_all_is_full_sharing_whatever_the_context(name: str) -> None:
    poor = fleet_of(4, soc=0.01, goodput=0.0)
    for d in METHODS[name].policy(poor):
        assert (d.representation, d.rho, d.roi, d.rate_hz, d.fusion_weight) == (3, 1.0, None, 10.0, 1.0)


def test_fixed_compression_is_one_fidelity() -> None:
    assert {d.rho for d in POLICIES["fixed-compression"](fleet_of(4))} == {0.05}
    assert {d.rho for d in POLICIES["fixed-compression"](fleet_of(4), rho=0.5)} == {0.5}


def test_where2comm_sends_its_confident_region_and_then_what_is_asked_for() -> None:
    view = sees(fleet_of(3), d0=[(8, 8), (8, 9), (8, 10), (8, 11)], d1=[(8, 8), (8, 9)])
    own = disc_around(frozenset({(0, 0), (0, 1), (0, 2), (0, 3)}))
    assert [d.roi for d in where2comm(view)] == [own, own]
    asked = where2comm(view, rounds=2)
    assert [d.roi for d in asked] == [disc_around(frozenset({(0, 2), (0, 3)})), own]


def test_where2comm_keeps_a_link_on_which_nothing_is_asked_for() -> None:
    view = sees(fleet_of(2), d0=[(8, 8)], d1=[(8, 8)])
    (d,) = where2comm(view, rounds=2)
    assert d.representation == Representation.FEATURES
    assert d.roi == disc_around(frozenset({(0, 0)}))


def test_who2com_appoints_exactly_one_for_each() -> None:
    for view in map(just_heard, VIEWS):
        if len(view.descriptors) < 2:
            continue
        ids = sorted(view.descriptors)
        suppliers = {
            r: [s for s in ids if s != r and r in served(who2com(view._replace(ego=s)))] for r in ids
        }  # fmt: skip
        assert all(len(s) == 1 for s in suppliers.values())


def test_who2com_and_when2com_choose_who_sees_what_the_receiver_does_not() -> None:
    """1 sees what 0 does and nothing else; 2 sees other cells: 2 serves 0, and 1 does not."""
    view = sees(fleet_of(3), d0=[(8, 8)], d1=[(8, 8)], d2=[(1, 1), (1, 2)])
    assert 0 in served(who2com(view._replace(ego=2)))
    assert 0 not in served(who2com(view._replace(ego=1)))
    assert 0 in served(when2com(view._replace(ego=2), threshold=0.5))
    assert 0 not in served(when2com(view._replace(ego=1), threshold=0.5))


def test_when2com_stays_silent_where_nobody_has_anything_new() -> None:
    """All see the same: each score is 0 like the drone's own, attention is 1/N for all, at N = 5 no more than 0.2."""
    same = sees(fleet_of(5), **{f"d{i}": [(8, 8)] for i in range(5)})
    assert served(when2com(same)) == set()


def test_syncnet_weighs_by_the_delay_that_goodput_lets_expect() -> None:
    def weight(goodput_mbps: float) -> float:
        return syncnet(fleet_of(2, goodput=goodput_mbps))[0].fusion_weight

    assert weight(1e6) == 1.0
    half = FEATURE_MAP_MEGABITS / (0.5 * math.log(2))  # exp(−t/0.5 s) is a half there
    assert weight(half) == 0.5
    assert weight(0.0) == weight(SILENT_MBPS) == 0.25
    assert syncnet(fleet_of(2, goodput=0.0))[0].reason == "goodput not measured yet"
    assert [weight(g) for g in (1, 5, 10, 20, 50, 100)] == sorted(weight(g) for g in (1, 5, 10, 20, 50, 100))


def test_hydracollab_shares_features_where_both_are_confident() -> None:
    agree = sees(fleet_of(2), d0=[(8, 8), (8, 9)], d1=[(8, 8), (8, 9)])
    (d,) = hydracollab(agree)
    assert (d.representation, d.roi) == (Representation.FEATURES, disc_around(frozenset({(0, 0), (0, 1)})))
    apart = sees(fleet_of(2), d0=[(8, 8), (8, 9)], d1=[(1, 1)])
    (d,) = hydracollab(apart)
    assert (d.representation, d.roi) == (Representation.DETECTIONS, disc_around(frozenset({(0, 0), (0, 1)})))
    assert hydracollab(apart, threshold=0.0)[0].representation == Representation.DETECTIONS  # nothing is shared


# --- what methods ask for first, and the fusion they bring ---------------------------------------


def test_handshakes_are_those_of_the_methods() -> None:
    asked = {name: handshake_bytes(name) for name in POLICIES}
    assert {n: b for n, b in asked.items() if b} == {"when2com-style": 132, "who2com-style": 132}
    assert [handshake_bytes("where2comm-style", {"rounds": r}) for r in (1, 2, 3)] == [0, 8192, 16384]


def test_own_fusions() -> None:
    own = {name: own_fusion(name) for name in POLICIES if own_fusion(name)}
    assert own == {f"{fusion}-style": fusion for fusion in ("where2comm", "when2com", "v2vnet", "disconet")} | {
        "who2com-style": "when2com"
    }


# --- the policy that reads and decides all -------------------------------------------------------


def test_deputies_are_who_adds_most() -> None:
    view = sees(fleet_of(4), d0=[(8, 8)], d1=[(8, 8)], d2=[(1, 1), (1, 2)], d3=[(2, 1)])
    assert [i for i in (1, 2, 3) if 0 in served(deputies(view._replace(ego=i), k=1))] == [2]
    assert [i for i in (1, 2, 3) if 0 in served(deputies(view._replace(ego=i), k=2))] == [2, 3]


def test_freshness_falls_with_age() -> None:
    ages = [0.0, 0.3, 0.31, 1.0]
    assert [freshness(a, 0.1) for a in ages] == [1.0, 1.0, 0.5, 0.5]


def test_deputies_give_weight_to_every_peer_that_is_attached() -> None:
    """The scenario may say after how many periods a peer is detached."""
    view = fleet_of(3)._replace(detached_after_periods=30.0, age_s={0: 0.0, 1: 2.0, 2: 3.0 + 1e-9})
    assert [d.fusion_weight for d in deputies(view)] == [0.5, 0.5]
