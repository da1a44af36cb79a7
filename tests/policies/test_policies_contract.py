"""The contract's types: numbers, what a view and a roster say of a fleet, and when two directives are the same."""

from __future__ import annotations

import copy
import pickle
from itertools import product
from typing import Any

import pytest
from policies_examples import aged, changed, fleet_of, without

from sortie.perception import budget
from sortie.perception.geometry import CELLS, CHANNELS
from sortie.policies.catalogue.coverage_cells import well_cells
from sortie.policies.contract import (
    FEATURE_CELL_BYTES,
    FEATURE_CELLS,
    FEATURE_MAP_MEGABITS,
    OTHER_NETWORK,
    PERSON_FLAG,
    Coverage,
    Directive,
    Disc,
    FleetView,
    Representation,
    Roster,
    TaskPhase,
    boxes_across_networks,
    nothing,
    nothing_to_all,
)
from sortie.policies.staleness import LinkHealth, health
from sortie.policies.verification.invariants.language import WORDS, Scope
from sortie.scenarios.representation import BOX_NAMES, MAP_NAMES, NAME_OF, REPRESENTATION_OF
from sortie.sim.export.topics import TopicKind

FEATURES, CODES, DETECTIONS = Representation.FEATURES, Representation.CODES, Representation.DETECTIONS


def test_a_feature_map_is_as_large_as_the_detector_makes_it() -> None:
    assert FEATURE_CELLS == budget.CELLS == CELLS**2
    assert FEATURE_CELL_BYTES == budget.payload_bytes(1) == 2 * CHANNELS
    assert budget.payload_bytes(FEATURE_CELLS) * 8 / 1e6 == FEATURE_MAP_MEGABITS


def test_every_representation_has_its_name_and_its_topic() -> None:
    assert all(name == r.name.lower() and REPRESENTATION_OF[name] is r for r, name in NAME_OF.items())
    assert {"none", *BOX_NAMES, *MAP_NAMES} == set(REPRESENTATION_OF)
    assert [TopicKind.of(r).reliable for r in Representation] == [NAME_OF[r] in BOX_NAMES for r in Representation]


# --- views ----------------------------------------------------------------------------------------


def test_a_view_without_detached_peers_is_that_view_in_everything_else() -> None:
    """Limit and period too: what is attached in it is what was attached in the one before."""
    view = fleet_of(4)._replace(period_s=0.5, detached_after_periods=4.0, age_s={0: 0.0, 1: 2.0, 2: 2.1, 3: 9.0})
    near = view.attached
    assert near == (0, 0.5, {i: view.descriptors[i] for i in (0, 1)}, {0: 0.0, 1: 2.0}, 4.0)
    assert near.attached is near
    assert (near.members, view.members) == ((0, 1), (0, 1))
    wider = view._replace(detached_after_periods=4.2)
    assert wider.attached.detached_after_periods == 4.2
    assert wider.members == (0, 1, 2)
    assert list(fleet_of(2)._replace(age_s={0: 99.0, 1: 99.0}).attached.descriptors) == [0], "the ego is attached"


@pytest.mark.parametrize("age_periods", [9.999, 10.0, 10.001, 25.0])
def test_attached_is_what_the_staleness_rules_call_attached(age_periods: float) -> None:
    view = aged(fleet_of(3), {0: 0.0, 1: age_periods * 0.1, 2: 0.0})
    attached = health(view.age_s[1], view.period_s, 3.0, view.detached_after_periods) != LinkHealth.DETACHED
    assert (1 in view.attached.descriptors) == attached
    assert (view.attached is view) == attached
    assert view._replace(detached_after_periods=30.0).attached.descriptors.keys() == {0, 1, 2}


@pytest.mark.parametrize("age_s", [0.1, 0.9, 1.5, 60.0])
def test_what_a_view_says_of_the_fleet_leaves_out_who_is_detached(age_s: float) -> None:
    """Every word of the invariants and every figure of the view that is about the fleet as a whole."""
    tracking = fleet_of(4, phase=TaskPhase.TRACK)
    view = aged(changed(tracking, 2, novelty_flags=PERSON_FLAG, priority_target_ids=(0,)), {2: age_s})
    others, attached = without(view, 2), age_s <= 1.0
    assert view.human_in_region == attached
    assert view.members == ((0, 1, 2, 3) if attached else others.members)
    for name, word in WORDS.items():
        if not word.of_link:
            said, unsaid = (word.value(Scope(v, v.descriptors[0], [], {})) for v in (view, others))
            assert said == unsaid or (attached and name in ("peers", "human_in_region")), name


def test_full_sharing_is_as_many_maps_as_there_are_others() -> None:
    """Those that a drone lists goodput to, or those that it heard, if these are more."""
    for listed, heard, maps in ((3, 3, 3), (3, 1, 3), (1, 3, 3), (0, 3, 3), (5, 3, 5), (0, 0, 0), (4, 0, 4)):
        view = changed(fleet_of(heard + 1), 0, peer_goodput_mbps=(7.0,) * listed)
        assert view.full_sharing_maps == maps
        assert without(view, 0).full_sharing_maps == heard


def test_a_person_is_in_a_region_where_the_drone_has_one() -> None:
    """Whoever found the person, and whatever other flags are set. Without a region of its own nobody is in it."""
    for region, who, flags in product((Disc(3.0, 4.0, 32.0), None), (0, 1), range(8)):
        view = changed(changed(fleet_of(3), 0, region=region), who, novelty_flags=flags)
        assert view.human_in_region == (region is not None and flags & PERSON_FLAG > 0)


def test_a_frozen_view_is_read_only_throughout_and_a_copy_is_all_of_it() -> None:
    view = FleetView(2, 0.2, fleet_of(4).descriptors, fleet_of(4).age_s, 7.0)
    frozen: Any = view.frozen
    for part in (frozen.descriptors, frozen.age_s):
        with pytest.raises(TypeError, match="does not support item assignment"):
            part[0] = part[1]
        with pytest.raises(TypeError, match="doesn't support item deletion"):
            del part[1]
    for other in (pickle.loads(pickle.dumps(frozen)), copy.deepcopy(frozen), copy.copy(frozen)):  # noqa: S301
        assert other == view
        assert (type(other.descriptors), type(other.age_s)) == (dict, dict)


def test_a_roster_says_whose_goodputs_are_listed() -> None:
    """By place among the members, the drone's own left out; drones off the roster have none, and are not counted."""
    roster = Roster(3, (1, 4, 6, 9))
    assert [roster.slot(i) for i in range(11)] == [None, 0, None, None, 1, None, 2, None, None, 3, None]
    me = fleet_of(5).descriptors[4]._replace(roster=roster, peer_goodput_mbps=(10.0, 60.0, 90.0))
    wanted = {1: 10.0, 6: 60.0, 9: 90.0}
    assert {i: me.goodput_to(i) for i in range(12)} == {i: wanted.get(i, 0.0) for i in range(12)}
    assert me.goodput_by_id(8) == (0.0, 10.0, 0.0, 0.0, 0.0, 60.0, 0.0)
    assert [i for i in range(12) if me.counts(i)] == [1, 4, 6, 9]
    stranger = me._replace(agent_id=2, roster=Roster(1, (1, 4)), peer_goodput_mbps=(5.0,))
    assert [i for i in range(6) if stranger.counts(i)] == [1, 4]  # itself it counts if it is on it
    other = me.with_roster(Roster(4, (0, 4, 6, 7)))
    assert (other.peer_goodput_mbps, other.roster) == ((0.0, 60.0, 0.0), Roster(4, (0, 4, 6, 7)))
    plain = me._replace(roster=None, peer_goodput_mbps=(1.0, 2.0, 3.0, 4.0, 5.0))
    assert plain.goodput_by_id(6) == (1.0, 2.0, 3.0, 4.0, 5.0)
    assert [plain.goodput_to(i) for i in range(8)] == [1.0, 2.0, 3.0, 4.0, 0.0, 5.0, 0.0, 0.0]
    assert all(plain.counts(i) for i in range(12))
    assert fleet_of(3).roster == Roster(0, (0, 1, 2))
    assert changed(fleet_of(2), 0, roster=roster).roster == roster


# --- directives -----------------------------------------------------------------------------------


def test_a_directive_is_the_same_whatever_its_reason_says() -> None:
    a = Directive(0, 1, FEATURES, 0.5, rate_hz=5.0, reason="one")
    b = a._replace(reason="other")
    assert a == b
    assert (a != b) is False
    assert hash(a) == hash(b)
    assert {a: 1}[b] == 1
    assert a != a._replace(duty_percent=99)
    assert a != tuple(a)


def test_maps_go_to_the_same_network_and_codes_to_the_same_codebook_too() -> None:
    """In place of others boxes go, and the reason says why; all else is as decided."""
    for rung, space, book in product(Representation, ("", "theirs"), ("", "theirs")):
        view = changed(fleet_of(3), 1, feature_space=space, codebook=book)
        decided = [Directive(0, p, rung, 0.3, Disc(1.0, 2.0, 3.0), 5.0, 0.2, 0.5, 40, "decided") for p in (1, 2)]
        first, second = boxes_across_networks(lambda view, to=decided: to)(view)
        reads = not space if rung == FEATURES else not space and not book if rung == CODES else True
        wanted = decided[0] if reads else decided[0]._replace(representation=DETECTIONS, rho=0.0, reason=OTHER_NETWORK)
        assert (tuple(first), tuple(second)) == (tuple(wanted), tuple(decided[1]))
        assert (view.shares_features_with(1), view.shares_codes_with(1)) == (not space, not space and not book)


def test_where_all_have_one_network_a_policy_s_answer_is_handed_on_as_it_is() -> None:
    answer: list[Directive] = []

    @boxes_across_networks
    def policy(view: FleetView, *, rho: float = 0.5) -> list[Directive]:
        answer[:] = [Directive(view.ego, p, FEATURES, rho) for p in view.peers]
        return answer

    assert policy(fleet_of(3), rho=0.25) is answer
    assert {d.rho for d in answer} == {0.25}


def test_equal_arguments_of_other_types_leave_nothing_behind() -> None:
    """What one decision asked for must not change what the next one gets."""
    for other in (901.0, TaskPhase.TRACK):
        same = int(other)
        assert type(nothing(other, 7, "r").source) is type(other)  # type: ignore[arg-type]
        assert type(nothing(same, 7, "r").source) is int
        assert type(nothing_to_all(same, (other,), "r")[0].destination) is type(other)
        assert type(nothing_to_all(same, (same,), "r")[0].destination) is int
    assert type(min(well_cells(bytes([255]), 3.0, 4, Coverage.POOR))[0]) is float  # type: ignore[arg-type]
    assert type(min(well_cells(bytes([255]), 3, 4, Coverage.POOR))[0]) is int
    assert nothing(901, 7, "r") is nothing(901, 7, "r")
