"""What every built-in policy keeps: about detached peers, other networks, mission regions and duty cycles."""

from __future__ import annotations

from itertools import product

from policies_examples import SEES_ALL, by_peer, changed, fleet_of, without
from sim_examples import example

from sortie.policies.catalogue.adaptive import arm
from sortie.policies.contract import Directive, Disc, FleetView, Representation, TaskPhase
from sortie.policies.registry import POLICIES, viewpoint_of
from sortie.policies.verification.kit.views import draw_views
from sortie.sim.engine.sortie import run_sortie

FEATURES, CODES, DETECTIONS = Representation.FEATURES, Representation.CODES, Representation.DETECTIONS
NONE = Representation.NONE
NO_MAPS = ("silence", "boxes", "uncertain-boxes", "learned")
"""What the model of `learned` chooses depends on its last fit."""
REGION = Disc(3.0, 4.0, 32.0)


def test_detached_peers_get_nothing_and_change_nothing_but_their_own_links() -> None:
    """What the others get, and where the drone looks from, is as if the detached had never been heard."""
    wrong, tested = set(), 0
    for view in draw_views(11, 60):
        if view.me is None or len(view.peers) < 2:
            continue
        gone = view.peers[: len(view.peers) // 2]
        ages_s = {i: 15 * view.detached_after_periods * view.period_s * (i in gone) for i in view.descriptors}
        old = view._replace(age_s=ages_s)
        others, tested = without(old, *gone), tested + 1
        for name, policy in POLICIES.items():
            found, wanted, look = by_peer(policy(old)), by_peer(policy(others)), viewpoint_of(policy)
            duties = {d.duty_percent for d in found.values()}
            left = {i: d for i, d in found.items() if i not in gone}
            silent = all(found[i].representation == NONE for i in gone)
            if left != wanted or not silent or len(duties) > 1 or (look is not None and look(old) != look(others)):
                wrong.add(name)
    assert wrong == set()
    assert tested > 30


def test_a_lost_drone_gives_its_place_to_the_next_best_after_the_scenarios_limit() -> None:
    """With the leader of a cross lost, four drones are left, each of which serves two others."""
    limits = set[float]()

    def best(view: FleetView) -> list[Directive]:
        limits.add(view.detached_after_periods)
        return list(POLICIES["best-2"](view, received_budget=0.02))

    lost = "events=[{kind: drone_lost, at_s: 1, drone: 0}]"
    record = run_sortie(example("context.detached_after_periods=12", "duration_s=4", lost), best)
    used = {(row["drone"], row["peer"]): row["representation"] for row in record.tables["directives"].to_pylist()}
    assert len([link for link, rung in used.items() if rung != "nothing" and 0 not in link]) == 8
    assert limits == {12.0}


def test_a_duty_cycle_is_one_for_all_links() -> None:
    """The gate takes the highest, so one link that says more would undo it."""
    for view in draw_views(5, 80):
        for name, policy in POLICIES.items():
            assert len({d.duty_percent for d in policy(view)}) <= 1, name


def test_only_who_tracks_is_confined_to_the_mission_region() -> None:
    for phase, soc, mbps in product(TaskPhase, (0.9, 0.5, 0.1), (400.0, 2.0)):
        own = {"battery_soc": soc, "peer_goodput_mbps": (mbps,) * 3, "coverage_grid": SEES_ALL}
        view = changed(fleet_of(4), task_phase=phase, region=REGION, **own)
        for name, policy in POLICIES.items():
            directives = policy(view)
            assert directives, name
            if phase != TaskPhase.TRACK:
                assert REGION not in [d.roi for d in directives], name
            elif name in ("worked", "deputies"):
                assert {d.roi for d in directives if d.representation != NONE} <= {REGION}
            assert "style" in name or not any(d.roi for d in policy(changed(view, region=None))), name


def test_maps_become_boxes_for_another_network_and_nothing_else_changes() -> None:
    replaced, wrong = set(), set()
    for view in draw_views(7, 60):
        if len(view.peers) < 2:
            continue
        other = view.peers[-1]
        alike = changed(view, feature_space="", codebook="")._replace(age_s=dict.fromkeys(view.age_s, 0.0))
        mixed = changed(alike, other, feature_space="theirs")
        for name, policy in {**POLICIES, "an arm": arm}.items():
            usual = by_peer(policy(alike))
            wanted = usual[other]
            if wanted.representation in (FEATURES, CODES):
                replaced.add(name)
                wanted = wanted._replace(representation=DETECTIONS, rho=0.0)
            if by_peer(policy(mixed)) != {**usual, other: wanted}:
                wrong.add(name)
    assert wrong == set()
    assert replaced >= {*POLICIES, "an arm"} - set(NO_MAPS), "the views show the policies at work"


def test_a_drone_of_the_other_network_sends_maps_to_its_own_kind_alone() -> None:
    mixed = changed(fleet_of(4), 0, 1, feature_space="theirs")
    rungs = {d.destination: d.representation for d in POLICIES["disconet-style"](mixed)}
    assert rungs == {1: FEATURES, 2: DETECTIONS, 3: DETECTIONS}


def test_a_drone_that_does_not_know_itself_decides_nothing_even_of_who_is_gone() -> None:
    view = FleetView(9, 0.1, fleet_of(4).descriptors, {0: 0.1, 1: 30.0, 2: 0.1, 3: 0.1})
    for name in ("worked", "all-4", "codes", "where2comm-style", "adaptive"):
        assert list(POLICIES[name](view)) == [], name
