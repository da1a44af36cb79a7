"""Adaptive policies: what each arm spends, where the rules turn, and that the learned one does what its numbers say."""

from __future__ import annotations

import numpy as np
import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue import adaptive as a
from sortie.policies.catalogue.baselines import everyone
from sortie.policies.contract import Coverage, Disc, FleetView, Representation, TaskPhase
from sortie.scenarios.link_state import SILENT_MBPS

BOXES, FEATURES, NONE = Representation.DETECTIONS, Representation.FEATURES, Representation.NONE


def rungs(directives: list[a.Directive]) -> list[Representation]:
    return [d.representation for d in directives]


@pytest.mark.parametrize("arm", a.ARMS)
@pytest.mark.parametrize("budget", [0.005, 0.1, 1.0])
def test_no_arm_spends_more_than_the_budget(arm: a.Arm, budget: float) -> None:
    directives = a.spend(fleet_of(5), arm, budget, "test")
    assert sum(d.rho for d in directives) <= budget * 4 + 1e-9
    if arm.peers > 0 and budget <= 0.25:
        assert sum(d.rho for d in directives) == pytest.approx(budget * 4), "and all of it"


def test_arms_by_hand() -> None:
    view = fleet_of(5, phase=TaskPhase.TRACK)
    assert rungs(a.spend(view, a.Arm(2, True, False), 0.1, "")) == [FEATURES, FEATURES, BOXES, BOXES]
    assert rungs(a.spend(view, a.Arm(2, False, False), 0.1, "")) == [FEATURES, FEATURES, NONE, NONE]
    assert rungs(a.spend(view, a.Arm(0, True, False), 0.1, "")) == [BOXES] * 4
    confined = a.spend(view, a.Arm(255, True, True), 0.1, "")
    assert {d.roi for d in confined} == {view.descriptors[0].region}


def test_no_more_is_sent_than_the_air_carries() -> None:
    """Half a drone's goodput for all its links, rounded down in steps of √2; by hand, a map is 5.24 Mb."""
    assert pytest.approx(5.24288) == a.FEATURE_MAP_MEGABITS
    me = fleet_of(5, goodput=52.4288).descriptors[0]
    assert a.carried(me, (1, 2, 3, 4)) == pytest.approx(0.125)  # 26.2 of 4 × 52.4 Mb/s, exactly a step
    assert a.carried(me, (1, 2)) == pytest.approx(0.25)
    assert a.carried(fleet_of(5, goodput=52.0).descriptors[0], (1, 2, 3, 4)) == pytest.approx(0.125 / 2**0.5)
    assert a.carried(fleet_of(5, goodput=1e6).descriptors[0], (1, 2, 3, 4)) == 1.0
    assert a.carried(fleet_of(5, goodput=0.0).descriptors[0], (1, 2, 3, 4)) == 1.0, "unmeasured is not weak"
    silent = fleet_of(5, goodput=SILENT_MBPS).descriptors[0]
    assert a.carried(silent, (1, 2, 3, 4)) < a.FEW, "silent links carry no map"
    one = silent._replace(peer_goodput_mbps=(SILENT_MBPS, SILENT_MBPS, SILENT_MBPS, 100.0))
    assert a.carried(one, (1, 2, 3, 4)) < a.carried(fleet_of(5).descriptors[0], (1, 2, 3, 4)), "nor raise what is sent"
    some = me._replace(peer_goodput_mbps=(0.0, 104.8576, 0.0, 0.0))
    assert a.carried(some, (1, 2, 3, 4)) == pytest.approx(0.25), "by the links that were measured"
    tight = a.spend(fleet_of(5, goodput=5.0), a.MAPS, 0.4, "")
    assert rungs(tight) == [FEATURES] * 4
    assert sum(d.rho for d in tight) * a.FEATURE_MAP_MEGABITS * 10 <= 0.5 * 5.0
    roomy = a.spend(fleet_of(5, goodput=5.0), a.MAPS, 0.005, "")
    assert sum(d.rho for d in roomy) == pytest.approx(4 * 0.005), "a budget below it is spent whole"


@pytest.mark.parametrize("goodput", [0.0, 200.0])
def test_maps_to_all_are_what_the_fixed_policy_sends(goodput: float) -> None:
    """An unmeasured link (goodput 0) is not a weak one: waiting for a measure would cost the climb of a rung."""
    view = fleet_of(5, goodput=goodput)
    assert a.spend(view, a.MAPS, 0.125, "") == everyone(view, received_budget=0.125)


def seeing(view: FleetView, state: Coverage = Coverage.WELL) -> FleetView:
    """The same fleet, all of whose grids say this of every cell."""
    grid = bytes([state * 0b01010101] * 64)
    return view._replace(descriptors={i: d._replace(coverage_grid=grid) for i, d in view.descriptors.items()})


def test_a_small_budget_is_enough_for_the_few_peers_that_are_attached() -> None:
    """What a link would get is compared, not the budget: one peer of four gets all of it."""
    view = seeing(fleet_of(5, phase=TaskPhase.TRACK))
    few = view._replace(age_s={**view.age_s, 2: 1e3, 3: 1e3, 4: 1e3})
    assert rungs(a.adaptive(view, sent_budget=a.FEW / 2)) == [BOXES] * 4
    first, *others = a.adaptive(few, sent_budget=a.FEW / 2)
    assert (first.representation, first.rho) == (FEATURES, pytest.approx(2 * a.FEW))
    assert rungs(others) == [NONE] * 3


@pytest.mark.parametrize("budget", [0.004, 0.05, 1.0])
def test_a_region_is_worth_its_cells_and_the_rest_boxes(budget: float) -> None:
    searching = a.adaptive(fleet_of(5, phase=TaskPhase.SEARCH, goodput=1000.0), sent_budget=budget)
    assert rungs(searching) == [BOXES] * 4
    view = seeing(fleet_of(5, phase=TaskPhase.TRACK, goodput=1000.0))
    tracking = a.adaptive(view, sent_budget=budget)
    assert rungs(tracking) == [FEATURES] * 4
    assert {d.roi for d in tracking} == {view.descriptors[0].region}
    assert sum(d.rho for d in tracking) == pytest.approx(4 * budget, rel=0.01) or budget == 1.0, (
        "as far as the air carries"
    )


def test_hardly_any_cells_are_worth_less_than_boxes() -> None:
    view = seeing(fleet_of(5, phase=TaskPhase.TRACK, goodput=1000.0))
    assert rungs(a.adaptive(view, sent_budget=0.0019)) == [BOXES] * 4
    assert rungs(a.adaptive(view, sent_budget=0.002)) == [FEATURES] * 4
    weak = seeing(fleet_of(5, phase=TaskPhase.TRACK, goodput=0.5))  # carries 0.001 of a map a link
    assert rungs(a.adaptive(weak, sent_budget=0.2)) == [BOXES] * 4


def test_who_sees_nothing_of_the_region_sends_boxes() -> None:
    for state, expected in ((Coverage.UNSEEN, BOXES), (Coverage.POOR, FEATURES)):
        view = seeing(fleet_of(5, phase=TaskPhase.TRACK, goodput=1000.0), state)
        assert rungs(a.adaptive(view, sent_budget=0.2)) == [expected] * 4
    view = seeing(fleet_of(5, phase=TaskPhase.TRACK, goodput=1000.0))
    me = view.descriptors[0]
    for away_m, expected in ((60.0, FEATURES), (500.0, BOXES)):
        x_m, y_m, _ = me.position_m
        there = me._replace(region=Disc(x_m + away_m, y_m, 20.0))
        assert (
            rungs(a.adaptive(view._replace(descriptors={**view.descriptors, 0: there}), sent_budget=0.2))
            == [expected] * 4
        )


def test_the_learned_policy_takes_the_arm_of_the_highest_prediction() -> None:
    model = a.read_model(a.LEARNED)
    for phase in (TaskPhase.SEARCH, TaskPhase.TRACK):
        for budget in (0.005, 0.02, 0.1, 0.4, 1.0):
            view = fleet_of(5, phase=phase)
            z = (np.array(a.features(view, budget)) - model.mean) / model.scale
            predicted = np.array(model.weights) @ np.concatenate([[1.0], z])
            expected = a.spend(view, a.ARMS[int(np.argmax(predicted))], budget, "learned")
            assert a.learned(view, sent_budget=budget) == expected


def test_what_the_learned_policy_reads() -> None:
    seen = dict(zip(a.FEATURES, a.features(fleet_of(5, soc=0.7, goodput=99.0), 0.1), strict=True))
    assert seen["log10 of the budget"] == pytest.approx(-1)
    assert seen["tracking a region"] == 0
    assert 0 < seen["mean overlap of peers"] < 1
    assert seen["log10 of 1 + mean goodput"] == pytest.approx(2)
    assert seen["charge"] == 0.7
