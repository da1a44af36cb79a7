"""The policies' joints: which argument goes where, two options together, peers that are stale or gone, agreement of senders.

Joints, each with a test below:

1. Peers that are detached: no policy and no viewpoint reads them, and the duty cycle holds for their links too.
2. Drones that were never heard: budgets count the fleet, not the drones in the view.
3. The mission region outside of phase `track`: no policy confines anything to it.
4. A link's two directions: the sender's own goodput decides, of each possible sender where several are weighed.
5. A goodput that is only probed: a state, not a rate.
6. Battery, link, phase and age together: each lowers what it lowers, whatever the others do.
7. Parameters: of policy, handshake and viewpoint alike.
8. Cells that a budget leaves over, and a budget for nobody.
9. What one drone sees and the other does not: in which direction a difference is taken.
10. Damping with two fields at once, and hysteresis where the fleet's members change.
11. Networks: boxes in place of maps carry no share of cells.

What must be drawn alike by all senders, and apart for each receiver, epoch and salt: the peers of `random-2`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue import adaptive, baselines
from sortie.policies.catalogue.coverage_cells import disc_around, seen_well, sees
from sortie.policies.catalogue.deputies import RESTING_DUTY_PERCENT, deputies
from sortie.policies.catalogue.freshness import AGEING, freshness
from sortie.policies.catalogue.prior.hydracollab import hydracollab
from sortie.policies.catalogue.prior.syncnet import STEPS, syncnet
from sortie.policies.catalogue.prior.when2com import when2com
from sortie.policies.catalogue.prior.where2comm import REQUEST_MAP_BYTES
from sortie.policies.catalogue.vantage import over_region
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import (
    COVERAGE_CELL_M,
    FEATURE_CELLS,
    FEATURE_MAP_MEGABITS,
    PERSON_FLAG,
    Descriptor,
    Directive,
    Disc,
    FleetView,
    Representation,
    Roster,
    TaskPhase,
)
from sortie.policies.damping import DampedLink, apply_hysteresis, damp
from sortie.policies.geometry import footprint_overlap, peers_by_overlap
from sortie.policies.registry import POLICIES, handshake_bytes, resolve, viewpoint_of
from sortie.policies.verification.invariants.language import WORDS, Scope
from sortie.policies.verification.kit.views import draw_views
from sortie.scenarios.link_state import PROBED_MBPS, SILENT_MBPS, WAITING_MBPS, probed_mbps

REGION = Disc(3.0, 4.0, 32.0)
SEES_ALL = bytes([0b10101010]) * 64
FEATURES, DETECTIONS, NONE = Representation.FEATURES, Representation.DETECTIONS, Representation.NONE


def changed(view: FleetView, ids: Sequence[int] | None = None, **fields: Any) -> FleetView:
    """The view with fields of some drones' descriptors replaced."""
    some = view.descriptors if ids is None else ids
    return view._replace(descriptors={i: d._replace(**fields) if i in some else d for i, d in view.descriptors.items()})


def aged(view: FleetView, **ages_s: float) -> FleetView:
    return view._replace(age_s={**view.age_s, **{int(k[1:]): v for k, v in ages_s.items()}})


def of_ego(view: FleetView, ego: int) -> FleetView:
    return view._replace(ego=ego)


def by_peer(directives: Sequence[Directive]) -> dict[int, Directive]:
    return {d.destination: d for d in directives}


# --- stale and unheard drones ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", POLICIES)
def test_detached_peers_change_nothing_but_their_own_links(name: str) -> None:
    """Of any views: what the others get, and where the drone looks from, is as if they had never been heard."""
    policy, tested = POLICIES[name], 0
    look = viewpoint_of(policy)
    for view in draw_views(11, 60):
        me = view.me
        if me is None or len(view.peers) < 2:
            continue
        attached = view.attached.peers
        gone = view.peers[: len(view.peers) // 2]
        ages = {i: (1e4 if i in gone else 0.0) for i in view.descriptors}
        ages[view.ego] = 0.0
        old = view._replace(age_s=ages)
        without = old._replace(
            descriptors={i: d for i, d in old.descriptors.items() if i not in gone},
            age_s={i: a for i, a in ages.items() if i not in gone},
        )
        tested += bool(attached)
        found, wanted = by_peer(policy(old)), by_peer(policy(without))
        assert {i: d for i, d in found.items() if i not in gone} == wanted
        for i in gone:
            assert found[i].representation == NONE
            assert found[i].duty_percent == max(
                (d.duty_percent for d in wanted.values()), default=found[i].duty_percent
            )
        if look is not None:
            assert look(old) == look(without)
    assert tested > 10


@pytest.mark.parametrize("age_s", [0.1, 0.9, 1.5, 60.0])
def test_what_a_view_says_of_the_fleet_leaves_out_who_is_detached(age_s: float) -> None:
    """Every word of the invariants and every figure of the view that is about the fleet as a whole."""
    view = fleet_of(4, phase=TaskPhase.TRACK)
    view = aged(changed(view, [2], novelty_flags=PERSON_FLAG, priority_target_ids=(0,)), _2=age_s)
    without = view._replace(
        descriptors={i: d for i, d in view.descriptors.items() if i != 2},
        age_s={i: a for i, a in view.age_s.items() if i != 2},
    )
    attached = age_s <= 1.0
    assert view.human_in_region == attached
    assert view.members == ((0, 1, 2, 3) if attached else without.members)
    for name, word in WORDS.items():
        if not word.of_link:
            said, unsaid = (word.value(Scope(v, v.descriptors[0], [], {})) for v in (view, without))
            assert said == unsaid or (attached and name in ("peers", "human_in_region")), name


def test_the_middle_of_the_fleet_is_that_of_the_drones_that_are_there() -> None:
    view = changed(fleet_of(4), task_phase=TaskPhase.TRACK, region=REGION)
    asked, without = over_region(aged(view, _3=50.0)), over_region(
        view._replace(
            descriptors={i: d for i, d in view.descriptors.items() if i != 3},
            age_s={i: a for i, a in view.age_s.items() if i != 3},
        )
    )  # fmt: skip
    assert asked == without != over_region(view)
    assert asked is not None
    middle_x = sum(view.descriptors[i].position_m[0] for i in range(3)) / 3
    assert asked.x_m == pytest.approx(view.descriptors[0].position_m[0] + REGION.x_m - middle_x)


@pytest.mark.parametrize("heard", [1, 2, 4])
def test_a_budget_is_of_the_fleet_whoever_was_heard(heard: int) -> None:
    """In a fleet of five, of which some are unknown: links that there are get what they would get, up to a whole map."""
    whole = fleet_of(5)
    view = whole._replace(
        descriptors={i: whole.descriptors[i] for i in range(heard + 1)}, age_s=dict.fromkeys(range(heard + 1), 0.1)
    )
    assert view.full_sharing_maps == 4
    for d in baselines.everyone(view, received_budget=0.1):
        assert d.rho == pytest.approx(0.1, abs=1 / FEATURE_CELLS)
    for policy in (baselines.best_k_receivers, baselines.worst_k_receivers, baselines.random_k_receivers):
        sending = [d.rho for d in policy(view, k=2, sent_budget=0.1) if d.rho]
        assert sending == pytest.approx([0.4 / min(2, heard)] * min(2, heard))
    fast = changed(view, peer_goodput_mbps=(4000.0,) * 4)
    sending = [d.rho for d in adaptive.spend(fast, adaptive.MAPS, 0.1, "x")]
    assert sending == pytest.approx([0.4 / heard] * heard)


@pytest.mark.parametrize("name", POLICIES)
def test_a_duty_cycle_is_one_for_all_links(name: str) -> None:
    """The gate takes the highest, so one link that says more would undo it."""
    for view in draw_views(5, 80):
        duties = {d.duty_percent for d in POLICIES[name](view)}
        assert len(duties) <= 1


# --- the mission region ------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", TaskPhase)
@pytest.mark.parametrize("name", POLICIES)
def test_only_who_tracks_is_confined_to_the_mission_region(name: str, phase: TaskPhase) -> None:
    for soc, mbps in product((0.9, 0.5, 0.1), (400.0, 2.0)):
        view = changed(fleet_of(4), task_phase=phase, region=REGION, battery_soc=soc, peer_goodput_mbps=(mbps,) * 3)
        view = changed(view, coverage_grid=SEES_ALL)
        directives = POLICIES[name](view)
        assert directives
        if phase != TaskPhase.TRACK:
            assert REGION not in [d.roi for d in directives]
        elif name in ("worked", "deputies"):
            assert {d.roi for d in directives if d.representation != NONE} <= {REGION}
        assert not any(d.roi for d in POLICIES[name](changed(view, region=None))) or "style" in name


def test_an_arm_confines_maps_alone_and_only_while_tracking() -> None:
    view = changed(fleet_of(4, goodput=4000.0), region=REGION)
    for arm, phase in product(adaptive.ARMS, TaskPhase):
        for d in adaptive.spend(changed(view, task_phase=phase), arm, 0.5, "x"):
            confined = d.representation == FEATURES and arm.region and phase == TaskPhase.TRACK
            assert d.roi == (REGION if confined else None)


# --- links --------------------------------------------------------------------------------------------------


def matrix(view: FleetView, mbps: dict[tuple[int, int], float], otherwise: float) -> FleetView:
    """The view with these goodputs, sender by receiver."""
    n = len(view.descriptors)
    rows = {i: tuple(mbps.get((i, j), otherwise) for j in range(n) if j != i) for i in view.descriptors}
    return view._replace(descriptors={i: d._replace(peer_goodput_mbps=rows[i]) for i, d in view.descriptors.items()})


def at_one_place(view: FleetView) -> FleetView:
    return changed(view, position_m=(0.0, 0.0, 60.0), coverage_grid=SEES_ALL)


def test_a_deputy_is_appointed_by_its_link_to_the_receiver_and_not_by_the_way_back() -> None:
    """Drone 3 receives; 0, 1 and 2 add the same, each with another goodput to it and the reverse from it."""
    view = at_one_place(fleet_of(4))
    view = changed(view, (3,), coverage_grid=bytes(64))
    good, bad = 100.0, 6.0
    for best in (0, 1, 2):
        links = {(i, 3): good if i == best else bad for i in range(3)}
        links |= {(3, i): bad if i == best else good for i in range(3)}
        chosen = [i for i in range(3) if by_peer(deputies(of_ego(matrix(view, links, 50.0), i), k=1))[3].rho]
        assert chosen == [best]


@pytest.mark.parametrize(("soc", "wins"), [(0.6, True), (0.59, True), (0.3, True), (0.29, False)])
def test_a_deputy_s_battery_counts_in_three_steps_that_begin_at_their_bounds(soc: float, wins: bool) -> None:
    """Drone 0 adds four times the cells of drone 1: at half weight it is still ahead, at a tenth no longer."""
    view = changed(at_one_place(fleet_of(3)), (2,), coverage_grid=bytes(64))
    view = changed(changed(view, (1,), coverage_grid=SEES_ALL[:16] + bytes(48)), (0,), battery_soc=soc)
    chosen = [i for i in (0, 1) if by_peer(deputies(of_ego(view, i), k=1))[2].representation != NONE]
    assert chosen == [0 if wins else 1]


@pytest.mark.parametrize(("mbps", "wins"), [(100.0, True), (20.0, True), (7.0, True), (0.0, True)])
def test_a_deputy_without_a_goodput_counts_a_quarter(mbps: float, wins: bool) -> None:
    """Not nothing: it may be the only one that sees."""
    view = changed(at_one_place(fleet_of(3)), (2,), coverage_grid=bytes(64))
    view = changed(view, (1,), coverage_grid=SEES_ALL[:12] + bytes(52))
    view = matrix(view, {(0, 2): mbps}, 100.0)
    chosen = [i for i in (0, 1) if by_peer(deputies(of_ego(view, i), k=1))[2].representation != NONE]
    assert chosen == [0 if wins else 1]


def test_overlap_is_the_share_of_the_receiver_s_footprint() -> None:
    """Of drones at different heights the two shares differ; each function takes the same one."""
    low, high = (fleet_of(2).descriptors[i]._replace(position_m=(0.0, 0.0, 60.0)) for i in (0, 1))
    low, high = low._replace(footprint_radius_m=20.0), high._replace(footprint_radius_m=40.0)
    assert footprint_overlap(low, high) == 1.0
    assert footprint_overlap(high, low) == 0.25
    third = high._replace(agent_id=2, position_m=(5.0, 0.0, 60.0), footprint_radius_m=30.0)
    view = FleetView(1, 0.1, {0: low, 1: high, 2: third}, {0: 0.0, 1: 0.0, 2: 0.0})
    assert peers_by_overlap(view) == [2, 0]  # 0.56 of its footprint, and a quarter
    assert peers_by_overlap(view, 0) == [1, 2]
    seen = adaptive.features(view, 0.25)
    assert seen[2] == pytest.approx((0.25 + footprint_overlap(high, third)) / 2)


@pytest.mark.parametrize("policy", [worked, deputies])
def test_a_link_is_weak_by_the_sender_s_own_goodput(policy: Any) -> None:
    view = changed(fleet_of(3), coverage_grid=SEES_ALL)
    weak = matrix(view, {(0, 1): 1.0}, 100.0)
    assert by_peer(policy(weak))[1].representation == DETECTIONS
    assert by_peer(policy(matrix(view, {(1, 0): 1.0}, 100.0)))[1].representation == FEATURES
    assert by_peer(policy(weak))[2].representation == FEATURES


@pytest.mark.parametrize("probe", [probed_mbps(0.5), probed_mbps(1.0)])
def test_a_probed_link_counts_in_no_mean_of_goodputs(probe: float) -> None:
    """It says that descriptors arrive. A silent link and one whose payloads only waited are known."""
    me = fleet_of(3).descriptors[0]
    assert SILENT_MBPS < probe <= PROBED_MBPS
    measured = adaptive.carried(me._replace(peer_goodput_mbps=(8.0, 8.0)), (1, 2))
    assert measured < 1.0
    assert adaptive.carried(me._replace(peer_goodput_mbps=(8.0, probe)), (1, 2)) == measured
    assert adaptive.carried(me._replace(peer_goodput_mbps=(8.0, 0.0)), (1, 2)) == measured
    for known in (SILENT_MBPS, WAITING_MBPS):
        assert adaptive.carried(me._replace(peer_goodput_mbps=(8.0, known)), (1, 2)) < measured
    assert adaptive.carried(me._replace(peer_goodput_mbps=(probe, 0.0)), (1, 2)) == 1.0


# --- tables, every combination -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("soc", "mbps", "phase"),
    list(product((0.6, 0.59, 0.3, 0.29), (5.0, 4.9, 0.0), (TaskPhase.SEARCH, TaskPhase.TRACK))),
)
def test_the_worked_table_for_every_combination(soc: float, mbps: float, phase: TaskPhase) -> None:
    """Battery picks representation and rate, a weak link lowers both, the phase confines, whatever the others say."""
    view = changed(fleet_of(3), battery_soc=soc, peer_goodput_mbps=(mbps,) * 2, task_phase=phase, region=REGION)
    rung, rate_hz = (FEATURES, 10.0) if soc >= 0.6 else (FEATURES, 5.0) if soc >= 0.3 else (DETECTIONS, 2.0)
    rho = 0.25 if rung == FEATURES else 0.0
    if mbps < 5.0:
        rung, rate_hz, rho = DETECTIONS, min(rate_hz, 2.0), 0.0
    for d in worked(view, rho=0.25):
        roi = REGION if phase == TaskPhase.TRACK else None
        assert d == Directive(0, d.destination, rung, rho, roi, rate_hz)


@pytest.mark.parametrize(("soc", "mbps", "age"), list(product((0.6, 0.59, 0.3, 0.29), (5.0, 4.9), (0.1, 0.31, 1.0))))
def test_what_a_deputy_sends_for_every_combination(soc: float, mbps: float, age: float) -> None:
    """The peer's age lowers the weight of maps and of boxes alike; a low battery rests on every link."""
    view = changed(fleet_of(3), battery_soc=soc, peer_goodput_mbps=(mbps,) * 2, coverage_grid=SEES_ALL)
    view = aged(view, _1=age, _2=0.0)
    sent = by_peer(deputies(view, k=2, rho=0.5))
    duty = RESTING_DUTY_PERCENT if soc < 0.3 else 100
    for peer, weight in ((1, 1.0 if age <= 0.3 else AGEING), (2, 1.0)):
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


def test_a_map_s_delay_follows_from_how_much_of_it_is_sent() -> None:
    view = changed(fleet_of(2), peer_goodput_mbps=(40.0,))
    for rho, trusted_for_s in product((1.0, 0.25, 0.02), (0.5, 0.1)):
        (d,) = syncnet(view, rho=rho, trusted_for_s=trusted_for_s)
        delay_s = rho * FEATURE_MAP_MEGABITS / 40.0
        assert d.fusion_weight == max(1, round(STEPS * math.exp(-delay_s / trusted_for_s))) / STEPS
        assert d.rho == rho


def test_attention_counts_the_receiver_itself() -> None:
    """Two senders that add all the receiver lacks: each has e^s / (1 + 2 e^s)."""
    view = changed(at_one_place(fleet_of(3)), (2,), coverage_grid=bytes(64))
    share = math.exp(1.0) / (1 + 2 * math.exp(1.0))
    for threshold, rung in ((share - 1e-3, FEATURES), (share + 1e-3, NONE)):
        sent = by_peer(when2com(view, threshold=threshold, sharpness=1.0))
        assert sent[2].representation == rung
    alone = by_peer(when2com(view, threshold=1 / 3 - 1e-3, sharpness=1.0))  # nobody adds anything to drone 1
    assert alone[1].representation == FEATURES
    assert by_peer(when2com(view, threshold=1 / 3 + 1e-3, sharpness=1.0))[1].representation == NONE


# --- what one sees and the other does not --------------------------------------------------------------------


def half(west: bool) -> bytes:
    """A grid seen well in its western or its eastern half."""
    row = [0b10101010] * 2 + [0] * 2
    return bytes((row if west else row[::-1]) * 16)


def test_detections_are_of_what_the_sender_sees_and_the_receiver_does_not() -> None:
    view = at_one_place(fleet_of(2))
    view = changed(changed(view, (0,), coverage_grid=half(True)), (1,), coverage_grid=half(False))
    for ego, peer in ((0, 1), (1, 0)):
        (d,) = hydracollab(of_ego(view, ego))
        mine, theirs = seen_well(view.descriptors[ego]), seen_well(view.descriptors[peer])
        assert (d.representation, d.rho, d.roi) == (DETECTIONS, 0.0, disc_around(mine - theirs))
        assert (d.roi.x_m < 0) == (ego == 0)
    alike = changed(view, coverage_grid=half(True))
    (d,) = hydracollab(alike, rho=0.5)
    assert (d.representation, d.rho, d.roi) == (FEATURES, 0.5, disc_around(seen_well(alike.descriptors[0])))


# --- budgets, senders that agree ----------------------------------------------------------------------------------

CHOOSE = (baselines.everyone, baselines.best_k, baselines.worst_k, baselines.random_k)


@pytest.mark.parametrize("policy", CHOOSE)
@pytest.mark.parametrize("cells", [1, 2, 3, 5, 7, 4096, 4099])
def test_every_receiver_gets_the_budget_to_the_cell(policy: Any, cells: int) -> None:
    """Over all senders together, also where it cannot be shared evenly."""
    view = fleet_of(5)
    budget = (cells + 0.5) / (4 * FEATURE_CELLS)
    got = dict.fromkeys(range(5), 0)
    for ego in range(5):
        for d in policy(of_ego(view, ego), received_budget=budget):
            got[d.destination] += round(d.rho * FEATURE_CELLS)
    assert got == dict.fromkeys(range(5), cells)


@pytest.mark.parametrize("policy", CHOOSE[1:])
@pytest.mark.parametrize(("drones", "k"), [(2, 1), (2, 2), (2, 5), (3, 3), (5, 4), (5, 7)])
def test_more_senders_than_there_are_leave_nothing_of_the_budget_over(policy: Any, drones: int, k: int) -> None:
    """Each receiver gets it from those that there are."""
    view, budget = fleet_of(drones), 0.4
    got = dict.fromkeys(range(drones), 0)
    for ego in range(drones):
        for d in policy(of_ego(view, ego), k=k, received_budget=budget):
            got[d.destination] += round(d.rho * FEATURE_CELLS)
    assert got == dict.fromkeys(range(drones), math.floor(budget * (drones - 1) * FEATURE_CELLS))


@pytest.mark.parametrize("policy", CHOOSE[1:])
@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_k_senders_serve_each_receiver_and_all_agree_who(policy: Any, k: int) -> None:
    """Though their clocks, and so their own stamps, differ."""
    view = fleet_of(5)
    stamps = {i: (3 + 20 * i) * 1_000_000_000 for i in range(5)}
    view = view._replace(descriptors={i: d._replace(stamp_ns=stamps[i]) for i, d in view.descriptors.items()})
    served = dict.fromkeys(range(5), 0)
    for ego in range(5):
        for d in policy(of_ego(view, ego), k=k):
            served[d.destination] += d.representation == FEATURES
    assert served == dict.fromkeys(range(5), k)


@pytest.mark.parametrize("k", [0, 1, 3, 4, 7])
def test_a_drone_sends_to_k_receivers_and_to_none_for_a_k_of_0(k: int) -> None:
    """And the worst ones are the last of its order."""
    view, sent = fleet_of(5), {}
    for policy in (baselines.best_k_receivers, baselines.worst_k_receivers, baselines.random_k_receivers):
        sent[policy] = [d.destination for d in policy(view, k=k) if d.representation == FEATURES]
        assert len(sent[policy]) == min(k, 4)
    best, worst = sent[baselines.best_k_receivers], sent[baselines.worst_k_receivers]
    assert sorted(worst) == sorted(peers_by_overlap(view)[4 - len(best) :])


def test_random_senders_differ_by_receiver_epoch_and_salt() -> None:
    view = at_one_place(fleet_of(5))

    def senders(receiver: int, at_s: float, salt: int = 0) -> tuple[int, ...]:
        now = changed(view, stamp_ns=round(at_s * 1e9))
        drones = [i for i in range(5) if i != receiver]
        return tuple(i for i in drones if by_peer(baselines.random_k(of_ego(now, i), k=2, salt=salt))[receiver].rho)

    assert len({senders(0, 0.5 * half) for half in range(20)}) == 1
    epochs = [senders(0, 10.0 * e) for e in range(30)]
    salted = [senders(0, 10.0 * e, salt=1) for e in range(30)]
    assert len(set(epochs)) == len(set(salted)) == 6  # every pair of four comes up
    # those of another receiver: by distance in the round of ids, and by place among its peers
    others = [[senders(r, 10.0 * e) for e in range(30)] for r in range(1, 5)]
    distance = [[tuple(sorted((i - r) % 5 for i in two)) for two in others[r - 1]] for r in range(1, 5)]
    place = [[tuple(i if i < r else i - 1 for i in two) for two in others[r - 1]] for r in range(1, 5)]
    mine = [tuple(i - 1 for i in two) for two in epochs]
    same = [sum(a == b for a, b in zip(epochs, x, strict=True)) for x in (*distance, salted)]
    same += [sum(a == b for a, b in zip(mine, x, strict=True)) for x in place]
    assert max(same) < 15
    sent = [tuple(d.destination for d in baselines.random_k_receivers(changed(view, stamp_ns=e * 10**10)) if d.rho) for e in range(30)]  # fmt: skip
    assert len(set(sent)) == 6


# --- parameters ------------------------------------------------------------------------------------------------------


def test_a_handshake_has_the_bytes_of_its_parameters() -> None:
    sizes = [handshake_bytes("where2comm-style", {"rounds": r}) for r in (1, 2, 4)]
    assert sizes == [0, REQUEST_MAP_BYTES, 3 * REQUEST_MAP_BYTES]
    assert handshake_bytes("where2comm-style") == handshake_bytes("worked", {"rho": 0.5}) == 0
    assert handshake_bytes("who2com-style") == handshake_bytes("when2com-style", {"rho": 0.1}) == 132


def test_parameters_reach_the_policy_and_its_viewpoint(tmp_path: Path) -> None:
    """Each gets those that it has, by name."""
    (tmp_path / "both.py").write_text(
        """
from sortie.policies.contract import Reposition, looks_from, nothing

def away(view, *, far_m=1.0, why="default"):
    x, y, _ = view.me.position_m
    return Reposition(x + far_m, y, why)

@looks_from(away)
def both(view, *, far_m=1.0, rho=0.1):
    return [nothing(view.ego, p, f"{far_m:g} {rho:g}") for p in view.peers]
"""
    )
    policy = resolve(f"{tmp_path / 'both.py'}:both", {"far_m": 7.0, "rho": 0.5})
    view, look = fleet_of(2), viewpoint_of(policy)
    assert policy(view)[0].reason == "7 0.5"
    assert look is not None
    assert look(view) == (7.0, 0.0, "default")
    plain = viewpoint_of(resolve(f"{tmp_path / 'both.py'}:both"))
    assert plain is not None
    assert plain(view) == (1.0, 0.0, "default")


def test_of_equal_drones_the_next_after_the_receiver_serves_it() -> None:
    """So that not one drone serves all."""
    view = at_one_place(fleet_of(4))
    view = changed(view, coverage_grid=bytes(64))
    for name in ("who2com-style", "deputies"):
        servers = {
            peer: [
                ego
                for ego in range(4)
                if ego != peer
                and by_peer(POLICIES[name](of_ego(view, ego), **({"k": 1} if name == "deputies" else {})))[peer].rate_hz
            ]
            for peer in range(4)
        }
        assert servers == {peer: [(peer + 1) % 4] for peer in range(4)}


def test_a_drone_sees_a_disc_that_reaches_into_a_cell_that_it_sees() -> None:
    """The cell's middle may lie beyond the disc by half of the cell's diagonal."""
    me = fleet_of(1).descriptors[0]._replace(coverage_grid=bytes([0b01] + [0] * 63))  # the south-west cell alone
    row, column = me.coverage_corner
    x_m, y_m = (column + 0.5) * COVERAGE_CELL_M, (row + 0.5) * COVERAGE_CELL_M
    half_diagonal_m = COVERAGE_CELL_M * math.sqrt(2) / 2
    for beyond_m, seen in ((0.0, True), (0.95 * half_diagonal_m, True), (1.05 * half_diagonal_m, False)):
        assert sees(me, Disc(x_m - 30.0 - beyond_m, y_m, 30.0)) == seen
    assert not sees(me._replace(coverage_grid=bytes(64)), Disc(x_m, y_m, 30.0))


# --- damping and hysteresis ------------------------------------------------------------------------------------------


def test_a_disc_in_force_follows_its_target_and_does_not_grow_before_its_dwell_time() -> None:
    small = Directive(0, 1, FEATURES, 0.2, Disc(0, 0, 20), 5.0, reason="small")
    link = damp(DampedLink(small), small._replace(roi=Disc(50, 10, 40), rho=0.9, rate_hz=10.0), 0.0, 1.0)
    assert link.enforced.roi == Disc(50, 10, 20)
    assert (link.enforced.rho, link.enforced.rate_hz) == (0.2, 5.0)
    link = damp(link, small._replace(roi=Disc(60, 10, 40), rho=0.1, rate_hz=10.0), 0.5, 1.0)
    assert (link.enforced.roi, link.enforced.rho, link.enforced.rate_hz) == (Disc(60, 10, 20), 0.1, 5.0)
    link = damp(link, small._replace(roi=Disc(60, 10, 40), rho=0.1, rate_hz=10.0), 1.5, 1.0)
    assert (link.enforced.roi, link.enforced.rate_hz) == (Disc(60, 10, 40), 10.0)


USUAL = Directive(0, 1, FEATURES, 0.4, Disc(0, 0, 30), 5.0, 0.2, 0.5, 50, "usual")


@pytest.mark.parametrize(
    ("field", "less", "more"),
    [
        ("representation", DETECTIONS, Representation.RAW), ("rho", 0.1, 0.9), ("roi", Disc(0, 0, 10), Disc(0, 0, 60)),
        ("roi", Disc(0, 0, 10), None), ("rate_hz", 2.0, 10.0), ("fusion_weight", 0.25, 1.0), ("duty_percent", 20, 100),
    ],
)  # fmt: skip
def test_each_field_alone_falls_at_once_and_rises_after_its_dwell_time(field: str, less: Any, more: Any) -> None:
    down = damp(DampedLink(USUAL), USUAL._replace(**{field: less}), 5.0, 1.0)
    assert getattr(down.enforced, field) == less
    up = damp(DampedLink(USUAL), USUAL._replace(**{field: more}), 5.0, 1.0)
    assert getattr(up.enforced, field) == getattr(USUAL, field)
    up = damp(up, USUAL._replace(**{field: more}), 5.9, 1.0)
    assert getattr(up.enforced, field) == getattr(USUAL, field)
    up = damp(up, USUAL._replace(**{field: more}), 6.0, 1.0)
    assert getattr(up.enforced, field) == more


@pytest.mark.parametrize("quantity", ["battery_soc", "cpu_headroom", "gpu_headroom"])
def test_a_published_value_falls_at_once_and_rises_by_more_than_the_band(quantity: str) -> None:
    before = fleet_of(2).descriptors[0]._replace(battery_soc=0.5, cpu_headroom=0.5, gpu_headroom=0.5)
    for value, wanted in ((0.4, 0.4), (0.55, 0.5), (0.6, 0.5), (0.9, 0.75)):
        published = apply_hysteresis(before, before._replace(**{quantity: value}), 0.2)
        assert getattr(published, quantity) == pytest.approx(wanted)
        for other in {"battery_soc", "cpu_headroom", "gpu_headroom"} - {quantity}:
            assert getattr(published, other) == 0.5


def test_a_goodput_keeps_its_band_when_members_come_and_go() -> None:
    """Each peer's is held against its own last one, in whichever place of the list that stands."""
    me: Descriptor = fleet_of(2).descriptors[0]._replace(agent_id=2)
    before = me._replace(peer_goodput_mbps=(10.0, 50.0, 90.0), roster=Roster(1, (0, 1, 2, 5)))
    now = me._replace(peer_goodput_mbps=(11.0, 30.0, 100.0), roster=Roster(2, (0, 2, 5, 9)))  # to 0, 5 and 9
    published = apply_hysteresis(before, now, 0.2)
    assert published.goodput_to(0) == 10.0  # a rise within the band
    assert published.goodput_to(5) == 30.0  # a fall from 90
    assert published.goodput_to(9) == pytest.approx(100 / 1.2)  # new: nothing was published before
    same = apply_hysteresis(before, before._replace(peer_goodput_mbps=(11.0, 55.0, 120.0)), 0.2)
    assert same.peer_goodput_mbps == pytest.approx((10.0, 50.0, 100.0))


# --- networks --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", POLICIES)
def test_who_has_another_network_gets_no_maps_and_no_share_of_cells(name: str) -> None:
    view = changed(fleet_of(4, goodput=400.0), coverage_grid=SEES_ALL)
    foreign = by_peer(POLICIES[name](changed(view, (2,), feature_space="theirs")))
    usual = by_peer(POLICIES[name](view))
    for peer, d in usual.items():
        if peer == 2 and d.representation == FEATURES:
            assert foreign[2] == d._replace(representation=DETECTIONS, rho=0.0)
        elif peer != 2:
            assert foreign[peer].representation == d.representation
