"""No built-in policy sends feature maps to a drone with another network, and nothing else changes for that."""

from __future__ import annotations

import pytest

from sortie.policies.catalogue.adaptive import arm
from sortie.policies.contract import Directive, FleetView, Representation, boxes_across_networks
from sortie.policies.registry import POLICIES
from sortie.policies.verification.kit.views import draw_view

VIEWS = [v for v in (draw_view(7, n) for n in range(60)) if len(v.peers) >= 2]
FEATURES, DETECTIONS = Representation.FEATURES, Representation.DETECTIONS
CODES = Representation.CODES
NO_FEATURES = ("silence", "boxes", "uncertain-boxes", "learned")
"""What the model of `learned` chooses depends on its last fit."""
BUILT_IN = {**POLICIES, "an arm": arm}


def in_spaces(view: FleetView, **names: str) -> FleetView:
    """The view with every drone in the common feature space and with the common codebook, but for some."""
    of = {int(k[1:]): name for k, name in names.items()}
    return view._replace(
        descriptors={i: d._replace(feature_space=of.get(i, ""), codebook="") for i, d in view.descriptors.items()},
        age_s=dict.fromkeys(view.age_s, 0.0),
    )


@pytest.mark.parametrize("name", BUILT_IN)
def test_features_become_boxes_for_another_network_and_nothing_else_changes(name: str) -> None:
    policy, replaced = BUILT_IN[name], 0
    for view in VIEWS:
        other = view.peers[-1]
        alike = {d.destination: d for d in policy(in_spaces(view))}
        mixed = {d.destination: d for d in policy(in_spaces(view, **{f"_{other}": "theirs"}))}
        wanted = alike[other]
        if wanted.representation in (FEATURES, CODES):
            replaced += 1
            wanted = wanted._replace(representation=DETECTIONS, rho=0.0)
        assert mixed == {**alike, other: wanted}
    assert replaced > 0 or name in NO_FEATURES, "the views show the policy at work"


def test_a_drone_of_the_other_network_sends_maps_to_its_own_kind_alone() -> None:
    view = next(v for v in VIEWS if len(v.peers) >= 3)
    kin, *others = view.peers
    mixed = in_spaces(view, **{f"_{view.ego}": "theirs", f"_{kin}": "theirs"})
    rungs = {d.destination: d.representation for d in POLICIES["disconet-style"](mixed)}
    assert rungs == {kin: FEATURES, **dict.fromkeys(others, DETECTIONS)}


def test_the_helper_keeps_a_policy_s_parameters_and_its_answer_where_all_are_alike() -> None:
    answer: list[Directive] = []

    @boxes_across_networks
    def policy(view: FleetView, *, rho: float = 0.5) -> list[Directive]:
        answer[:] = [Directive(view.ego, p, FEATURES, rho) for p in view.peers]
        return answer

    assert policy(in_spaces(VIEWS[0]), rho=0.25) is answer
    assert {d.rho for d in answer} == {0.25}
