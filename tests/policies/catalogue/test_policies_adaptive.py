"""Adaptive policies: what each arm spends, where the rules turn, and that the learned one does what its numbers say."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policies_examples import aged, by_peer, changed, fleet_of

from sortie.policies.catalogue import adaptive as a
from sortie.policies.catalogue.baselines import everyone
from sortie.policies.contract import Coverage, Disc, FleetView, Representation, TaskPhase
from sortie.scenarios.link_state import PROBED_MBPS, SILENT_MBPS, WAITING_MBPS, probed_mbps

BOXES, FEATURES, NONE = Representation.DETECTIONS, Representation.FEATURES, Representation.NONE
REGION = Disc(3.0, 4.0, 32.0)


def rungs(directives: list[a.Directive]) -> list[Representation]:
    return [d.representation for d in directives]


def seeing(view: FleetView, state: Coverage = Coverage.WELL) -> FleetView:
    """The same fleet, all of whose grids say this of every cell."""
    return changed(view, coverage_grid=bytes([state * 0b01010101] * 64))


# --- what an arm spends ---------------------------------------------------------------------------


def test_no_arm_spends_more_than_the_budget() -> None:
    for arm, budget in product(a.ARMS, (0.005, 0.1, 1.0)):
        spent = sum(d.rho for d in a.spend(fleet_of(5), arm, budget, "test"))
        assert spent <= budget * 4 + 1e-9
        assert spent == pytest.approx(budget * 4) or arm.peers == 0 or budget > 0.25, "and all of it"


def test_arms_by_hand() -> None:
    view = fleet_of(5, phase=TaskPhase.TRACK)
    assert rungs(a.spend(view, a.Arm(2, True, False), 0.1, "")) == [FEATURES, FEATURES, BOXES, BOXES]
    assert rungs(a.spend(view, a.Arm(2, False, False), 0.1, "")) == [FEATURES, FEATURES, NONE, NONE]
    assert rungs(a.spend(view, a.Arm(0, True, False), 0.1, "")) == [BOXES] * 4
    confined = a.spend(view, a.Arm(255, True, True), 0.1, "")
    assert {d.roi for d in confined} == {view.descriptors[0].region}
    far = changed(fleet_of(4), 1, position_m=(500.0, 0.0, 60.0))
    few = by_peer(a.spend(far, a.Arm(2, True, True), 0.25, "why"))
    assert {p: d.representation for p, d in few.items()} == {1: BOXES, 2: FEATURES, 3: FEATURES}
    assert a.spend(far, a.Arm(2, False, True), 0.25, "why")[0].representation == NONE


def test_arms_are_counted_round_and_round() -> None:
    view, arms = fleet_of(4), len(a.ARMS)
    answers = [a.arm(view, index=k, sent_budget=0.1) for k in range(arms)]
    assert answers[0] != answers[-1]
    for k in range(arms):
        assert a.arm(view, index=arms + k, sent_budget=0.1) == answers[k]
        assert answers[k] == a.spend(view, a.ARMS[k], 0.1, "fixed arm")


def test_an_arm_confines_maps_alone_and_only_while_tracking() -> None:
    view = changed(fleet_of(4, goodput=4000.0), region=REGION)
    for arm, phase in product(a.ARMS, TaskPhase):
        for d in a.spend(changed(view, task_phase=phase), arm, 0.5, "x"):
            confined = d.representation == FEATURES and arm.region and phase == TaskPhase.TRACK
            assert d.roi == (REGION if confined else None)


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


@pytest.mark.parametrize("probe", [probed_mbps(0.5), probed_mbps(1.0)])
def test_a_probed_link_counts_in_no_mean_of_goodputs(probe: float) -> None:
    """It says that descriptors arrive. A silent link and one whose payloads only waited are known."""
    me = fleet_of(3).descriptors[0]
    assert SILENT_MBPS < probe <= PROBED_MBPS
    measured = a.carried(me._replace(peer_goodput_mbps=(8.0, 8.0)), (1, 2))
    assert measured < 1.0
    assert a.carried(me._replace(peer_goodput_mbps=(8.0, probe)), (1, 2)) == measured
    assert a.carried(me._replace(peer_goodput_mbps=(8.0, 0.0)), (1, 2)) == measured
    for known in (SILENT_MBPS, WAITING_MBPS):
        assert a.carried(me._replace(peer_goodput_mbps=(8.0, known)), (1, 2)) < measured
    assert a.carried(me._replace(peer_goodput_mbps=(probe, 0.0)), (1, 2)) == 1.0


def test_maps_to_all_are_what_the_fixed_policy_sends() -> None:
    """An unmeasured link (goodput 0) is not a weak one: waiting for a measure would cost the climb of a rung."""
    for goodput in (0.0, 200.0):
        view = fleet_of(5, goodput=goodput)
        assert a.spend(view, a.MAPS, 0.125, "") == everyone(view, received_budget=0.125)


# --- where the rules turn -------------------------------------------------------------------------


def test_a_small_budget_is_enough_for_the_few_peers_that_are_attached() -> None:
    """What a link would get is compared, not the budget: one peer of four gets all of it."""
    view = seeing(fleet_of(5, phase=TaskPhase.TRACK))
    assert rungs(a.adaptive(view, sent_budget=a.FEW / 2)) == [BOXES] * 4
    first, *others = a.adaptive(aged(view, {2: 1e3, 3: 1e3, 4: 1e3}), sent_budget=a.FEW / 2)
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
    spent = sum(d.rho for d in tracking)
    assert spent == pytest.approx(4 * budget, rel=0.01) or budget == 1.0, "as far as the air carries"


def test_hardly_any_cells_are_worth_less_than_boxes() -> None:
    view = seeing(fleet_of(5, phase=TaskPhase.TRACK, goodput=1000.0))
    assert rungs(a.adaptive(view, sent_budget=0.0019)) == [BOXES] * 4
    assert rungs(a.adaptive(view, sent_budget=0.002)) == [FEATURES] * 4
    weak = seeing(fleet_of(5, phase=TaskPhase.TRACK, goodput=0.5))  # carries 0.001 of a map a link
    assert rungs(a.adaptive(weak, sent_budget=0.2)) == [BOXES] * 4


def test_who_sees_nothing_of_the_region_sends_boxes() -> None:
    plain = fleet_of(5, phase=TaskPhase.TRACK, goodput=1000.0)
    for state, expected in ((Coverage.UNSEEN, BOXES), (Coverage.POOR, FEATURES)):
        assert rungs(a.adaptive(seeing(plain, state), sent_budget=0.2)) == [expected] * 4
    x_m, y_m, _ = plain.descriptors[0].position_m
    for away_m, expected in ((60.0, FEATURES), (500.0, BOXES)):
        view = changed(seeing(plain), 0, region=Disc(x_m + away_m, y_m, 20.0))
        assert rungs(a.adaptive(view, sent_budget=0.2)) == [expected] * 4


# --- the learned policy ---------------------------------------------------------------------------


def test_the_learned_policy_takes_the_arm_of_the_highest_prediction() -> None:
    model = a.read_model(a.LEARNED)
    for phase, budget in product((TaskPhase.SEARCH, TaskPhase.TRACK), (0.005, 0.02, 0.1, 0.4, 1.0)):
        view = fleet_of(5, phase=phase)
        z = (np.array(a.features(view, budget)) - model.mean) / model.scale
        predicted = np.array(model.weights) @ np.concatenate([[1.0], z])
        expected = a.spend(view, a.ARMS[int(np.argmax(predicted))], budget, "learned")
        assert a.learned(view, sent_budget=budget) == expected


def test_the_learned_policy_reads_of_a_drone_what_is_its_own() -> None:
    """Every input by hand: peers' overlap is of the ego's footprint, a region counts while it is tracked."""
    near = changed(fleet_of(3), 1, position_m=(0.0, 0.0, 60.0), footprint_radius_m=40.0, battery_soc=0.1)
    view = changed(near, 2, position_m=(900.0, 0.0, 60.0))
    own = {"battery_soc": 0.625, "cpu_headroom": 0.25, "gpu_headroom": 0.125, "footprint_radius_m": 20.0}
    for phase, region in product(TaskPhase, (None, Disc(0.0, 0.0, 30.0))):
        me = {**own, "peer_goodput_mbps": (27.0, 171.0), "task_phase": phase, "region": region}
        tracking = float(phase == TaskPhase.TRACK and region is not None)
        assert a.features(changed(view, 0, **me), 0.01) == pytest.approx((-2.0, tracking, 0.5, 2.0, 0.625))


SIX = [0.0] * 6
OTHER_SHAPES: list[tuple[list[float], list[float], list[list[float]]]] = [
    ([0.0] * 4, [1.0] * 5, [SIX] * 3),
    ([0.0] * 5, [1.0] * 6, [SIX] * 3),
    ([0.0] * 5, [1.0] * 5, [[0.0] * 5] * 3),
    ([0.0] * 5, [1.0] * 5, [SIX] * 2),
    ([0.0] * 5, [1.0] * 5, [SIX] * 4),
    ([0.0] * 5, [float("nan")] * 5, [SIX] * 3),
    ([0.0] * 5, [1.0] * 5, [[0.0] * 5 + [float("inf")]] * 3),
]


def test_a_model_of_other_shapes_or_without_numbers_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.json"

    def write(mean: Any, scale: Any, weights: Any) -> Path:
        path.write_text(json.dumps({"mean": mean, "scale": scale, "weights": weights}))
        return path

    assert a.read_model(write([0.0] * 5, [1.0] * 5, [SIX] * 3)).mean == (0.0,) * 5
    for shapes in OTHER_SHAPES:
        with pytest.raises(ValueError, match="must have 3 arms of 1"):
            a.read_model(write(*shapes))
