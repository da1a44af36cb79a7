"""Drawn views, small and of up to 5,000 drones: what is in them, views in JSON, and how a view is shrunk."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

import pytest
from policies_examples import fleet_of

from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.policies.contract import Disc, FleetView, Roster, TaskPhase
from sortie.policies.verification.kit.drawn import views_at_sizes
from sortie.policies.verification.kit.tried import shrink
from sortie.policies.verification.kit.views import (
    AT_CONSTANTS,
    LARGEST,
    ViewError,
    draw_view,
    draw_views,
    from_json,
    to_json,
)
from sortie.scenarios.disc import LISTED_MEMBERS
from sortie.scenarios.schema.base import MOST_DRONES


def test_drawn_views_repeat_and_have_every_state_on_which_a_rule_may_decide() -> None:
    views = list(draw_views(0, 600))
    assert views[:100] == list(draw_views(0, 100))
    assert views[7] == draw_view(0, 7) != draw_view(1, 7)
    drones = [(v, d) for v in views for d in v.descriptors.values()]
    assert {len(v.descriptors) for v in views} == set(range(1, 21))
    assert len(draw_view(11, 0, 40).descriptors) > 20
    assert {d.task_phase for _, d in drones} == set(TaskPhase)
    assert {d.novelty_flags for _, d in drones} == set(range(8))
    assert {0.0, 0.3, 0.6, 0.2999, 1.0} <= {d.battery_soc for _, d in drones}
    assert {0.0, 5.0, 4.99, 1e5} <= {g for _, d in drones for g in d.peer_goodput_mbps}
    assert {v.detached_after_periods for v in views} == {4.0, 10.0, 20.0, 1000.0}
    assert {v.period_s for v in views} == {0.1, 0.2, 1.0}
    ages = {(v.period_s, age_s) for v in views for age_s in v.age_s.values()}
    for period_s in (0.1, 0.2, 1.0):
        assert {(period_s, period_s * periods) for periods in (0.0, 1.0, 3.0, 3.1, 10.0, 10.1)} <= ages
        assert any(age_s > 100 * period_s for p, age_s in ages if p == period_s), "stale"
    away_m = [math.dist(d.region[:2], d.position_m[:2]) for _, d in drones if d.region is not None]
    assert min(away_m) < 10 < 2000 < max(away_m)
    assert any(d.region is None for _, d in drones)
    assert any(d.priority_target_ids for _, d in drones)
    assert any(list(v.descriptors) != sorted(v.descriptors) for v in views), "any order"
    known = [v for v in views if v.me is not None]
    assert any(set(v.me.roster.members) - v.descriptors.keys() for v in known if v.me and v.me.roster)
    assert any(len(v.peers) < len(v.me.peer_goodput_mbps) for v in known if v.me and v.me.roster is None)


def shares(views: Sequence[FleetView]) -> set[float]:
    return {x for v in views for d in v.descriptors.values() for x in (d.battery_soc, d.cpu_headroom, d.gpu_headroom)}


def test_views_at_constants_have_them_and_the_floats_beside_them() -> None:
    c, rate_mbps, age_s = 0.4321, 77.25, 1234.5
    views = list(draw_views(5, 80 * AT_CONSTANTS, {c, rate_mbps, age_s, 2.0}))[::AT_CONSTANTS]
    assert {c, math.nextafter(c, 0), math.nextafter(c, 1)} <= shares(views)
    assert all(0 <= x <= 1 for x in shares(views))
    goodputs = {x for v in views for d in v.descriptors.values() for x in d.peer_goodput_mbps}
    assert {rate_mbps, math.nextafter(rate_mbps, 0), math.nextafter(rate_mbps, 100)} <= goodputs
    assert any(v.age_s[i] == age_s for v in views for i in v.peers)
    assert any(d.stamp_ns == 2 * 10**9 for v in views for d in v.descriptors.values())
    assert any(v.ego == 2 for v in views)
    assert all(v.ego in v.descriptors and v.age_s.keys() == v.descriptors.keys() for v in views)
    assert all(a.descriptors != b.descriptors for k, a in enumerate(views) for b in views[:k] if len(a.descriptors) > 2)
    assert list(draw_views(5, 5, {c})) == list(draw_views(5, 5, {c})) != list(draw_views(5, 5))


def test_fleets_are_as_large_as_the_constants_of_a_policy() -> None:
    large = [view for seed in range(4) for view in views_at_sizes({0.5, 30.0}, seed)]
    assert {v.ego for v in large} >= {30}
    sizes = {len(d.peer_goodput_mbps) + 1 for v in large for d in v.descriptors.values() if d.roster is None}
    assert sizes == {30, 31, 32}
    assert list(views_at_sizes({0.4321}, 0)) == []


# --- JSON -----------------------------------------------------------------------------------------


def test_a_view_survives_json_exactly() -> None:
    own = {
        "roster": Roster(6, (0, 1, 2)),
        "priority_target_ids": (4, 5),
        "codebook": "0" * 14,
        "feature_space": "other",
    }
    numbers = {"stamp_ns": 123, "orientation_xyzw": (0.1, 0.2, 0.3, 0.4), "region": Disc(1.5, -2.5, 3.5)}
    one = fleet_of(3).descriptors[1]._replace(coverage_grid=bytes(range(64)), **own, **numbers)
    precise = FleetView(2, 0.1234567890123, {**fleet_of(3).descriptors, 1: one}, {0: 0.1, 1: 0.2, 2: 0.3}, 7.000000001)
    for view in (precise, FleetView(2, 0.1, {}, {}), *draw_views(3, 30)):
        again = from_json(to_json(view))
        assert again == view
        assert list(again.descriptors) == list(view.descriptors)


BROKEN: list[tuple[tuple[str | int, ...], object, str]] = [
    (("period_s",), 0, "view.period_s is 0, must be above 0"),
    (("ego",), "x", "view.ego is 'x', must be a number"),
    (("drones", 0, "battery_soc"), 1.5, "drones[0].battery_soc is 1.5, must be in [0, 1]"),
    (("drones", 0, "task_phase"), "idle", "drones[0].task_phase is 'idle', must be one of transit, search"),
    (("drones", 0, "coverage_grid"), "00", "drones[0].coverage_grid has 1 bytes, must have 64"),
    (("drones", 0, "coverage_grid"), "zz", "drones[0].coverage_grid must be hexadecimal"),
    (("drones", 0, "position_m"), [1, 2], "drones[0].position_m is [1, 2], must be a list of 3 numbers"),
    (("drones", 1, "agent_id"), 0, "drones[1].agent_id is 0, which another drone has already"),
    (("drones", 0, "age_s"), -1, "drones[0].age_s is -1, must be in [0, inf]"),
    (("drones", 0), 3, "drones[0] must be an object"),
    (("drones",), 3, "a view is an object with ego, period_s and a list of drones"),
]


def test_a_broken_view_names_its_field() -> None:
    wrong = {}
    for path, value, message in BROKEN:
        data = inner = json.loads(to_json(fleet_of(2)))
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
        with pytest.raises(ViewError) as caught:
            from_json(json.dumps(data))
        if message not in str(caught.value):
            wrong[message] = str(caught.value)
    assert wrong == {}


# --- shrinking ------------------------------------------------------------------------------------


def test_smaller_keeps_failing_and_drops_what_does_not_matter() -> None:
    def tired(view: FleetView) -> bool:
        assert view.age_s.keys() == view.descriptors.keys()
        return 3 in view.descriptors and view.descriptors[3].battery_soc < 0.3

    view = next(v for v in draw_views(5, 1000) if tired(v) and v.ego != 3 and len(v.descriptors) > 6)
    small = shrink(view, tired)
    assert tired(small)
    assert len(small.descriptors) == 2
    assert small.descriptors[small.ego].battery_soc == 1.0
    assert small.descriptors[3].battery_soc in {d.battery_soc for d in view.descriptors.values()}
    nobody = FleetView(0, 0.1, {}, {})
    assert shrink(nobody, lambda _: True) == nobody


def test_shrinking_makes_a_view_plain() -> None:
    view = next(v for v in draw_views(11, 500) if v.me is not None and v.me.roster is not None and len(v.peers) > 4)
    small = shrink(view, lambda candidate: len(candidate.peers) >= 2)
    assert (len(small.peers), set(small.age_s.values())) == (2, {0.0})
    for d in small.descriptors.values():
        assert (d.roster, d.battery_soc, d.region, d.novelty_flags) == (None, 1.0, None, 0)
        assert set(d.peer_goodput_mbps) == {100.0}


# --- large fleets ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_drones_of_the_largest_fleet_have_rosters_as_in_flight() -> None:
    """They fit into a descriptor, and are read again from it; the view survives JSON and is shrunk by halves."""
    everyone, few = draw_view(3, 0, LARGEST, 1.0), draw_view(3, 1, LARGEST, 0.02)
    assert LARGEST == MOST_DRONES == len(everyone.descriptors)
    assert 50 < len(few.descriptors) < 150
    assert from_json(to_json(few)) == few
    for view in (everyone, few):
        rosters = [d.roster for d in view.descriptors.values() if d.roster is not None]
        assert len(rosters) == len(view.descriptors)
        for i, d in list(view.descriptors.items())[:200]:
            again = decode_descriptor(encode_descriptor(d._replace(priority_target_ids=())))
            assert (again.agent_id, again.roster) == (i, d.roster)
            assert d.roster is not None
            assert (i in d.roster.members, len(d.peer_goodput_mbps)) == (True, len(d.roster.members) - 1)
        sizes = {len(roster.members) for roster in rosters}
        assert min(sizes) < 8 < max(sizes) <= LISTED_MEMBERS
        assert any(len(view.descriptors.keys() & set(roster.members)) > 30 for roster in rosters)
    tried = list[int]()

    def has_4321(view: FleetView) -> bool:
        tried.append(1)
        return 4321 in view.descriptors

    small = shrink(everyone, has_4321)
    assert set(small.descriptors) == {everyone.ego, 4321}
    assert len(tried) < 300
    assert small.descriptors[4321].roster == everyone.descriptors[4321].roster, "else it would not be listed"
    large = shrink(everyone, lambda view: len(view.peers) >= 1234)
    assert 1234 <= len(large.peers) < 1300, "of thousands that matter, not each is tried by itself"


@pytest.mark.slow
def test_views_at_constants_reach_the_largest_fleet() -> None:
    sizes = {len(view.descriptors) for view in views_at_sizes({0.5, 1000.0, LARGEST - 1.0, 1e6}, 0)}
    assert sizes >= {1000, 1001, 1002, LARGEST - 1, LARGEST}
    assert max(sizes) == LARGEST
    many = {len(view.descriptors) for view in views_at_sizes({*range(25, 95, 5), 3000}, 0)}
    assert {26, 91, 3001} <= many, "small ones leave the large one its place"
