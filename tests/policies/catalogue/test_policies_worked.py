"""The worked policy against the paper's decision table, and the deputies, who read and decide all that there is."""

from __future__ import annotations

from itertools import product

import pytest
from policies_examples import SEES_ALL, aged, by_peer, changed, fleet_of

from sortie.policies.catalogue.coverage_cells import sees
from sortie.policies.catalogue.deputies import RESTING_DUTY_PERCENT, deputies
from sortie.policies.catalogue.freshness import AGEING, freshness
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import (
    COVERAGE_CELL_M,
    Directive,
    Disc,
    FleetView,
    LinkState,
    Policy,
    Representation,
    TaskPhase,
)
from sortie.scenarios.link_state import SILENT_MBPS

FEATURES, DETECTIONS, NONE = Representation.FEATURES, Representation.DETECTIONS, Representation.NONE
REGION = Disc(3.0, 4.0, 32.0)


def matrix(view: FleetView, mbps: dict[tuple[int, int], float], otherwise: float) -> FleetView:
    """The view with these goodputs, sender by receiver."""
    for i in view.descriptors:
        row = tuple(mbps.get((i, j), otherwise) for j in view.descriptors if j != i)
        view = changed(view, i, peer_goodput_mbps=row)
    return view


# --- the table ------------------------------------------------------------------------------------


def test_the_worked_table_for_every_combination() -> None:
    """Battery picks representation and rate, a weak link lowers both, the phase confines, whatever the others say."""
    charges, links = (1.0, 0.6, 0.599, 0.3, 0.299, 0.0), (5.0, 4.99, 0.0)
    for soc, mbps, phase in product(charges, links, (TaskPhase.SEARCH, TaskPhase.TRACK)):
        own = {"battery_soc": soc, "peer_goodput_mbps": (mbps,) * 2, "task_phase": phase, "region": REGION}
        rung, rate_hz = (FEATURES, 10.0) if soc >= 0.6 else (FEATURES, 5.0) if soc >= 0.3 else (DETECTIONS, 2.0)
        rho = 0.25 if rung == FEATURES else 0.0
        if mbps < 5.0:
            rung, rate_hz, rho = DETECTIONS, min(rate_hz, 2.0), 0.0
        roi = REGION if phase == TaskPhase.TRACK else None
        for d in worked(changed(fleet_of(3), **own), rho=0.25):
            assert d == Directive(0, d.destination, rung, rho, roi, rate_hz)
            assert ("battery" in d.reason) == (mbps >= 5.0)


@pytest.mark.parametrize(
    ("goodput", "state", "reason"),
    [
        (0.0, LinkState.UNKNOWN, "goodput not measured yet"),
        (SILENT_MBPS, LinkState.SILENT, "goodput: link silent, nothing got through"),
        (3.14, LinkState.MEASURED, "goodput 3.1 < 5 Mb/s"),
    ],
)
def test_a_reason_says_what_is_known_of_the_link(goodput: float, state: LinkState, reason: str) -> None:
    view = fleet_of(5, goodput=goodput)
    assert view.descriptors[0].link_state(1) == state
    for policy in (worked, deputies):
        d = by_peer(policy(view))[1]
        assert d.reason.endswith(reason)
        assert (d.representation, d.rate_hz) == (DETECTIONS, 2.0), "the paper's line for less than 5 Mb/s"


def test_only_the_two_most_overlapping_peers_get_anything_and_jitter_of_a_metre_does_not_reorder_them() -> None:
    view = fleet_of(5)
    assert [d.destination for d in worked(view) if d.representation] == [1, 2]
    near = changed(changed(view, 3, position_m=(15.0, 0.5, 60.0)), 2, position_m=(15.5, 0.0, 60.0))
    assert [d.destination for d in worked(near) if d.rate_hz] == [1, 2], "overlaps within a step tie, and go by id"


@pytest.mark.parametrize("policy", [worked, deputies])
def test_a_link_is_weak_by_the_sender_s_own_goodput(policy: Policy) -> None:
    view = changed(fleet_of(3), coverage_grid=SEES_ALL)
    weak = by_peer(policy(matrix(view, {(0, 1): 1.0}, 100.0)))
    assert (weak[1].representation, weak[2].representation) == (DETECTIONS, FEATURES)
    assert by_peer(policy(matrix(view, {(1, 0): 1.0}, 100.0)))[1].representation == FEATURES


# --- deputies -------------------------------------------------------------------------------------


def serving(view: FleetView, receiver: int, k: int = 1) -> list[int]:
    """Which drones the deputies of a receiver are."""
    others = [i for i in view.descriptors if i != receiver]
    return [i for i in others if by_peer(deputies(view._replace(ego=i), k=k))[receiver].representation != NONE]


def one_place(n: int, **grids: bytes) -> FleetView:
    """Drones above one point that see all, but for those with a grid of their own: `d2` …"""
    view = changed(fleet_of(n), position_m=(0.0, 0.0, 60.0), coverage_grid=SEES_ALL)
    for name, grid in grids.items():
        view = changed(view, int(name[1:]), coverage_grid=grid)
    return view


def test_what_a_deputy_sends_for_every_combination() -> None:
    """The peer's age lowers the weight of maps and of boxes alike; a low battery rests on every link."""
    for soc, mbps, age_s in product((0.6, 0.59, 0.3, 0.29), (5.0, 4.9), (0.1, 0.31, 1.0)):
        view = changed(fleet_of(3), battery_soc=soc, peer_goodput_mbps=(mbps,) * 2, coverage_grid=SEES_ALL)
        view = aged(view, {1: age_s, 2: 0.0})
        sent = by_peer(deputies(view, k=2, rho=0.5))
        duty = RESTING_DUTY_PERCENT if soc < 0.3 else 100
        for peer, weight in ((1, 1.0 if age_s <= 0.3 else AGEING), (2, 1.0)):
            if soc < 0.3 or mbps < 5.0:
                wanted = Directive(0, peer, DETECTIONS, 0.0, None, 2.0, 0.5, weight, duty)
            else:
                wanted = Directive(0, peer, FEATURES, 0.5, None, 10.0 if soc >= 0.6 else 5.0, 0.1, weight, duty)
            assert sent[peer] == wanted
        assert {d.duty_percent for d in deputies(view, k=0)} == {duty}


def test_freshness_has_one_step_in_periods_of_any_length() -> None:
    for period_s in (0.1, 0.5):
        ages = [0.0, 3.0, 3.01, 10.0, 1e6]
        assert [freshness(a * period_s, period_s) for a in ages] == [1.0, 1.0, AGEING, AGEING, AGEING]
    late = fleet_of(3)._replace(detached_after_periods=30.0, age_s={0: 0.0, 1: 2.0, 2: 3.0 + 1e-9})
    assert [d.fusion_weight for d in deputies(late)] == [0.5, 0.5], "every peer that is attached has a weight"


def test_a_deputy_is_appointed_by_its_link_to_the_receiver_and_not_by_the_way_back() -> None:
    """Drone 3 receives; 0, 1 and 2 add the same, each with another goodput to it and the reverse from it."""
    good, bad = 100.0, 6.0
    for best in (0, 1, 2):
        links = {(i, 3): good if i == best else bad for i in range(3)}
        links |= {(3, i): bad if i == best else good for i in range(3)}
        assert serving(matrix(one_place(4, d3=bytes(64)), links, 50.0), 3) == [best]


def test_a_deputy_s_battery_counts_in_three_steps_that_begin_at_their_bounds() -> None:
    """Drone 0 adds four times the cells of drone 1: at half weight it is still ahead, at a tenth no longer."""
    view = one_place(3, d2=bytes(64), d1=SEES_ALL[:16] + bytes(48))
    found = {soc: serving(changed(view, 0, battery_soc=soc), 2) for soc in (0.6, 0.59, 0.3, 0.29)}
    assert found == {0.6: [0], 0.59: [0], 0.3: [0], 0.29: [1]}
    equal = one_place(3, d2=bytes(64), d1=SEES_ALL[:48] + bytes(16))  # at half weight it adds less than drone 1
    assert [serving(changed(equal, 0, battery_soc=soc), 2) for soc in (0.6, 0.59)] == [[0], [1]]


def test_a_deputy_without_a_goodput_counts_a_quarter() -> None:
    """Not nothing: it may be the only one that sees. A good link is one of 20 Mb/s."""
    view = one_place(3, d2=bytes(64), d1=SEES_ALL[:12] + bytes(52))
    assert [serving(matrix(view, {(0, 2): mbps}, 100.0), 2) for mbps in (100.0, 20.0, 7.0, 0.0)] == [[0]] * 4
    nearly = one_place(3, d2=bytes(64), d1=SEES_ALL[:20] + bytes(44))
    assert [serving(matrix(nearly, {(0, 2): mbps}, 100.0), 2) for mbps in (7.0, 5.0, 0.0)] == [[0], [1], [1]]


def test_who_adds_hardly_more_does_not_go_before_who_overlaps_more() -> None:
    """What is added counts in whole cells, weighted by the link. Of two that add as many, who overlaps more serves."""
    x_m, y_m, z_m = fleet_of(3).descriptors[2].position_m
    grid, view = bytes([0b10101010] * 2) + bytes(62), changed(fleet_of(3), 2, coverage_grid=bytes(64))  # eight cells
    for i, off_m, mbps in ((0, 20.0, 20.0), (1, 0.0, 19.5)):  # eight, and 7.8
        at = (x_m + off_m, y_m, z_m)
        view = changed(view, i, position_m=at, coverage_grid=grid, peer_goodput_mbps=(mbps, mbps))
    assert serving(view, 2) == [1]
    assert serving(changed(view, 1, peer_goodput_mbps=(15.0, 15.0)), 2) == [0]  # six


def test_of_drones_that_add_as_much_the_nearer_one_serves_though_a_higher_one_covers_more() -> None:
    """Ties go by the share of a sender's own footprint: that of a low drone lies within the receiver's."""
    x_m, y_m, z_m = fleet_of(4).descriptors[2].position_m
    view = changed(fleet_of(4), 0, position_m=(x_m, y_m, z_m), footprint_radius_m=20.0)  # wholly inside
    view = changed(view, 1, position_m=(x_m + 10.0, y_m, z_m), footprint_radius_m=90.0)  # a fifth of it inside
    view = changed(changed(view, 2, footprint_radius_m=40.0), 3, position_m=(x_m + 400.0, y_m, z_m))
    assert serving(view, 2) == [0]


def test_of_equal_drones_the_next_after_the_receiver_serves_it() -> None:
    """So that not one drone serves all."""
    view = changed(one_place(4), coverage_grid=bytes(64))
    assert [serving(view, receiver) for receiver in range(4)] == [[1], [2], [3], [0]]


def test_a_drone_sees_a_disc_that_reaches_into_a_cell_that_it_sees() -> None:
    """The cell's middle may lie beyond the disc by half of the cell's diagonal."""
    me = fleet_of(1).descriptors[0]._replace(coverage_grid=bytes([0b01] + [0] * 63))  # the south-west cell alone
    row, column = me.coverage_corner
    x_m, y_m = (column + 0.5) * COVERAGE_CELL_M, (row + 0.5) * COVERAGE_CELL_M
    half_diagonal_m = COVERAGE_CELL_M * 2**0.5 / 2
    for beyond_m, seen in ((0.0, True), (0.95 * half_diagonal_m, True), (1.05 * half_diagonal_m, False)):
        assert sees(me, Disc(x_m - 30.0 - beyond_m, y_m, 30.0)) == seen
    assert not sees(me._replace(coverage_grid=bytes(64)), Disc(x_m, y_m, 30.0))
