"""Prior methods: each decides as its description says, and its handshake and fusion are the paper's."""

from __future__ import annotations

import math
from itertools import product

import pytest
from policies_examples import SEES_ALL, by_peer, changed, fleet_of

from sortie.policies.catalogue.coverage_cells import centre_cell, disc_around, seen_well
from sortie.policies.catalogue.prior import METHODS
from sortie.policies.catalogue.prior.hydracollab import hydracollab
from sortie.policies.catalogue.prior.syncnet import STEPS, syncnet
from sortie.policies.catalogue.prior.when2com import when2com
from sortie.policies.catalogue.prior.where2comm import REQUEST_MAP_BYTES, where2comm
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

FEATURES, DETECTIONS, NONE = Representation.FEATURES, Representation.DETECTIONS, Representation.NONE


def grid(*cells: tuple[int, int], state: Coverage = Coverage.WELL) -> bytes:
    """A coverage grid with these (row, column) in one state and all else unseen."""
    packed = bytearray(64)
    for row, column in cells:
        cell = 16 * row + column
        packed[cell // 4] |= state << (2 * (cell % 4))
    return bytes(packed)


def sees(n: int, **cells: list[tuple[int, int]]) -> FleetView:
    """n drones in one place, each with the cells named `d0`, `d1` …"""
    view = changed(fleet_of(n), position_m=(0.0, 0.0, 60.0))
    for i in range(n):
        view = changed(view, i, coverage_grid=grid(*cells.get(f"d{i}", [])))
    return view


def served(directives: list[Directive]) -> set[int]:
    return {d.destination for d in directives if d.representation != NONE}


# --- the table of methods -------------------------------------------------------------------------


def test_a_stand_in_says_so_by_its_name_and_what_it_lacks() -> None:
    assert {POLICIES[name] for name in METHODS} == {m.policy for m in METHODS.values()}
    assert {name for name in METHODS if not missing_parts(name)} == {"fixed-compression"}
    assert all(name.endswith("-style") == bool(missing_parts(name)) for name in POLICIES)
    with pytest.raises(PolicyError) as error:
        resolve("syncnet")
    assert str(error.value) == (
        "policy 'syncnet' is here as a stand-in alone, name it syncnet-style; it lacks the recurrent prediction of a "
        "late peer's features; they are moved by ego motion and weighted by delay"
    )


def test_handshakes_and_fusions_are_those_of_the_methods() -> None:
    asked = {name: handshake_bytes(name) for name in POLICIES}
    assert {n: b for n, b in asked.items() if b} == {"when2com-style": 132, "who2com-style": 132}
    sizes = [handshake_bytes("where2comm-style", {"rounds": r}) for r in (1, 2, 4)]
    assert sizes == [0, REQUEST_MAP_BYTES, 3 * REQUEST_MAP_BYTES] == [0, 8192, 24576]
    assert handshake_bytes("when2com-style", {"rho": 0.1}) == 132
    own = {name: own_fusion(name) for name in POLICIES if own_fusion(name)}
    published = {f"{fusion}-style": fusion for fusion in ("where2comm", "when2com", "v2vnet", "disconet")}
    assert own == published | {"who2com-style": "when2com"}


# --- grids ----------------------------------------------------------------------------------------


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


# --- each method ----------------------------------------------------------------------------------


def test_methods_of_one_fidelity_send_it_whatever_the_context() -> None:
    poor = fleet_of(4, soc=0.01, goodput=0.0)
    for name in ("v2vnet-style", "disconet-style"):
        for d in METHODS[name].policy(poor):
            assert (d.representation, d.rho, d.roi, d.rate_hz, d.fusion_weight) == (FEATURES, 1.0, None, 10.0, 1.0)
    usual = {"disconet-style": 1.0, "v2vnet-style": 1.0, "where2comm-style": 1.0, "fixed-compression": 0.05}
    for name, rho in usual.items():
        assert {d.rho for d in resolve(name)(poor)} == {rho}
        assert {d.rho for d in resolve(name, {"rho": 0.125})(poor)} == {0.125}


def test_where2comm_sends_its_confident_region_and_then_what_is_asked_for() -> None:
    view = sees(3, d0=[(8, 8), (8, 9), (8, 10), (8, 11)], d1=[(8, 8), (8, 9)])
    own = disc_around(frozenset({(0, 0), (0, 1), (0, 2), (0, 3)}))
    assert [d.roi for d in where2comm(view)] == [own, own]
    assert [d.roi for d in where2comm(view, rounds=2)] == [disc_around(frozenset({(0, 2), (0, 3)})), own]
    (d,) = where2comm(sees(2, d0=[(8, 8)], d1=[(8, 8)]), rounds=2)
    assert (d.representation, d.roi) == (FEATURES, disc_around(frozenset({(0, 0)}))), "where nothing is asked for"
    corner = changed(sees(4), coverage_grid=grid((0, 0)))  # all see the south-west cell alone
    assert {d.roi for d in where2comm(corner, rounds=2)} == {disc_around(centre_cell(corner.descriptors[0]))}
    assert {d.roi for d in where2comm(corner, rounds=1)} == {disc_around(frozenset({(-8, -8)}))}
    (d,) = where2comm(sees(2))
    assert d.roi == disc_around(frozenset({(0, 0)})), "of who sees nothing well, the cell below it"


def test_who2com_appoints_exactly_one_for_each() -> None:
    for view in map(just_heard, draw_views(0, 60)):
        if len(view.descriptors) > 1:
            ids = sorted(view.descriptors)
            serves = {s: served(who2com(view._replace(ego=s))) for s in ids}
            assert [sum(r in to for to in serves.values()) for r in ids] == [1] * len(ids)


def test_who2com_and_when2com_choose_who_sees_what_the_receiver_does_not() -> None:
    """1 sees what 0 does and nothing else; 2 sees other cells: 2 serves 0, and 1 does not."""
    view = sees(3, d0=[(8, 8)], d1=[(8, 8)], d2=[(1, 1), (1, 2)])
    assert 0 in served(who2com(view._replace(ego=2)))
    assert 0 not in served(who2com(view._replace(ego=1)))
    assert 0 in served(when2com(view._replace(ego=2), threshold=0.5))
    assert 0 not in served(when2com(view._replace(ego=1), threshold=0.5))


def test_when2com_s_attention_counts_the_receiver_itself() -> None:
    """Two senders that add all the receiver lacks: each has e^s / (1 + 2 e^s). Who adds nothing has a third."""
    view = changed(sees(3), 0, 1, coverage_grid=SEES_ALL)
    share = math.exp(1.0) / (1 + 2 * math.exp(1.0))
    for peer, attention in ((2, share), (1, 1 / 3)):
        for threshold, rung in ((attention - 1e-3, FEATURES), (attention + 1e-3, NONE)):
            assert by_peer(when2com(view, threshold=threshold, sharpness=1.0))[peer].representation == rung
    same = changed(sees(5), coverage_grid=grid((8, 8)))
    assert served(when2com(same)) == set(), "attention is 1/N for all, at N = 5 no more than 0.2"


def test_syncnet_weighs_by_the_delay_that_goodput_and_share_let_expect() -> None:
    def weight(goodput_mbps: float) -> float:
        return syncnet(fleet_of(2, goodput=goodput_mbps))[0].fusion_weight

    assert weight(1e6) == 1.0
    assert weight(FEATURE_MAP_MEGABITS / (0.5 * math.log(2))) == 0.5  # exp(−t/0.5 s) is a half there
    assert weight(0.0) == weight(SILENT_MBPS) == 0.25
    assert weight(0.5) == 1 / STEPS, "a map that comes far too late"
    assert syncnet(fleet_of(2, goodput=0.0))[0].reason == "goodput not measured yet"
    for rho, trusted_for_s in product((1.0, 0.25, 0.02), (0.5, 0.1)):
        (d,) = syncnet(fleet_of(2, goodput=40.0), rho=rho, trusted_for_s=trusted_for_s)
        delay_s = rho * FEATURE_MAP_MEGABITS / 40.0
        assert d.fusion_weight == max(1, round(STEPS * math.exp(-delay_s / trusted_for_s))) / STEPS
        assert d.rho == rho


def test_hydracollab_shares_features_where_both_are_confident() -> None:
    agree = sees(2, d0=[(8, 8), (8, 9)], d1=[(8, 8), (8, 9)])
    (d,) = hydracollab(agree, rho=0.5)
    assert (d.representation, d.rho, d.roi) == (FEATURES, 0.5, disc_around(frozenset({(0, 0), (0, 1)})))
    apart = sees(2, d0=[(8, 8), (8, 9)], d1=[(1, 1)])
    (d,) = hydracollab(apart)
    assert (d.representation, d.rho, d.roi) == (DETECTIONS, 0.0, disc_around(frozenset({(0, 0), (0, 1)})))
    assert hydracollab(apart, threshold=0.0)[0].representation == DETECTIONS  # nothing is shared
    half = sees(2, d0=[(8, 8), (8, 9), (8, 10)], d1=[(8, 9), (8, 10), (8, 11)])  # two cells in common of four
    for threshold, rung in ((0.5, FEATURES), (0.51, DETECTIONS)):
        assert hydracollab(half, threshold=threshold)[0].representation == rung
    west, east = hydracollab(half, threshold=0.51)[0].roi, hydracollab(half._replace(ego=1), threshold=0.51)[0].roi
    assert (west, east) == (disc_around(frozenset({(0, 0)})), disc_around(frozenset({(0, 3)}))), "what the other lacks"
