"""Adaptive policies: what each arm spends, where the rules turn, and that the learned one does what its numbers say."""

from __future__ import annotations

import numpy as np
import pytest
from policies_examples import fleet_of

from policies import adaptive as a
from policies.baselines import everyone
from policies.contract import Descriptor, FleetView, Representation, TaskPhase

BOXES, FEATURES, NONE = Representation.DETECTIONS, Representation.FEATURES, Representation.NONE


def rungs(directives: list[a.Directive]) -> list[Representation]:
    return [d.representation for d in directives]


@pytest.mark.parametrize("arm", a.ARMS)
@pytest.mark.parametrize("rho", [0.005, 0.1, 1.0])
def test_no_arm_spends_more_than_the_budget(arm: a.Arm, rho: float) -> None:
    directives = a.spend(fleet_of(5), arm, rho, "test")
    assert sum(d.rho for d in directives) <= rho * 4 + 1e-9
    if arm.peers > 0 and rho <= 0.25:
        assert sum(d.rho for d in directives) == pytest.approx(rho * 4), "and all of it"


def test_arms_by_hand() -> None:
    view = fleet_of(5, phase=TaskPhase.TRACK)
    assert rungs(a.spend(view, a.Arm(2, True, False), 0.1, "")) == [FEATURES, FEATURES, BOXES, BOXES]
    assert rungs(a.spend(view, a.Arm(2, False, False), 0.1, "")) == [FEATURES, FEATURES, NONE, NONE]
    assert rungs(a.spend(view, a.Arm(0, True, False), 0.1, "")) == [BOXES] * 4
    confined = a.spend(view, a.Arm(255, True, True), 0.1, "")
    assert {d.roi for d in confined} == {view.descriptors[0].region}
    weak = a.spend(fleet_of(5, goodput=1.0), a.Arm(255, True, False), 0.1, "")
    assert rungs(weak) == [BOXES] * 4
    assert {d.rate_hz for d in weak} == {2.0}


@pytest.mark.parametrize("goodput", [0.0, 100.0])
def test_maps_to_all_are_what_the_fixed_policy_sends(goodput: float) -> None:
    """An unmeasured link (goodput 0) is not a weak one: waiting for a measure would cost the climb of a rung."""
    view = fleet_of(5, goodput=goodput)
    assert a.spend(view, a.MAPS, 0.1, "") == everyone(view, rho=0.1)


def spread(view: FleetView, by: float) -> FleetView:
    """The same fleet, `by` times as far apart: less overlap."""

    def moved(d: Descriptor) -> Descriptor:
        x_m, y_m, z_m = d.position_m
        return d._replace(position_m=(by * x_m, by * y_m, z_m))

    return view._replace(descriptors={i: moved(d) for i, d in view.descriptors.items()})


@pytest.mark.parametrize(
    ("phase", "apart", "rho", "expected"),
    [
        (TaskPhase.SEARCH, 3.0, 0.029, BOXES),
        (TaskPhase.SEARCH, 3.0, 0.03, FEATURES),
        (TaskPhase.SEARCH, 0.5, 0.059, BOXES),
        (TaskPhase.SEARCH, 0.5, 0.06, FEATURES),
        (TaskPhase.TRACK, 0.5, 0.099, BOXES),
        (TaskPhase.TRACK, 0.5, 0.1, FEATURES),
    ],
)
def test_budget_mission_and_coverage_decide_together(
    phase: TaskPhase, apart: float, rho: float, expected: Representation
) -> None:
    view = spread(fleet_of(5, phase=phase), apart)
    assert set(rungs(a.adaptive(view, rho=rho))) == {expected}


def test_the_learned_policy_takes_the_arm_of_the_highest_prediction() -> None:
    model = a.read_model(a.LEARNED)
    for phase in (TaskPhase.SEARCH, TaskPhase.TRACK):
        for rho in (0.005, 0.02, 0.1, 0.4, 1.0):
            view = fleet_of(5, phase=phase)
            z = (np.array(a.features(view, rho)) - model.mean) / model.scale
            predicted = np.array(model.weights) @ np.concatenate([[1.0], z])
            expected = a.spend(view, a.ARMS[int(np.argmax(predicted))], rho, "learned")
            assert a.learned(view, rho=rho) == expected


def test_what_the_learned_policy_reads() -> None:
    seen = dict(zip(a.FEATURES, a.features(fleet_of(5, soc=0.7, goodput=99.0), 0.1), strict=True))
    assert seen["log10 of the budget"] == pytest.approx(-1)
    assert seen["tracking a region"] == 0
    assert 0 < seen["mean overlap of peers"] < 1
    assert seen["log10 of 1 + mean goodput"] == pytest.approx(2)
    assert seen["charge"] == 0.7
