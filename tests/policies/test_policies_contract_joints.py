"""What the contract's types say of a fleet: whose goodput, whom a roster names, who is attached, how many maps are all."""

from __future__ import annotations

import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue import adaptive
from sortie.policies.catalogue.coverage_cells import centre_cell, disc_around
from sortie.policies.catalogue.deputies import deputies
from sortie.policies.catalogue.prior.hydracollab import hydracollab
from sortie.policies.catalogue.prior.syncnet import STEPS, syncnet
from sortie.policies.catalogue.prior.where2comm import where2comm
from sortie.policies.contract import (
    OTHER_NETWORK,
    Directive,
    Disc,
    Representation,
    Roster,
    TaskPhase,
    boxes_across_networks,
)

FEATURES, CODES, DETECTIONS = Representation.FEATURES, Representation.CODES, Representation.DETECTIONS


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


@pytest.mark.parametrize(
    ("listed", "heard", "maps"), [(3, 3, 3), (3, 1, 3), (1, 3, 3), (0, 3, 3), (5, 3, 5), (0, 0, 0), (4, 0, 4)]
)
def test_full_sharing_is_as_many_maps_as_there_are_others(listed: int, heard: int, maps: int) -> None:
    """Those that a drone lists goodput to, or those that it heard, if these are more."""
    view = fleet_of(heard + 1)
    me = view.descriptors[0]._replace(peer_goodput_mbps=(7.0,) * listed)
    assert view._replace(descriptors={**view.descriptors, 0: me}).full_sharing_maps == maps
    peers = {i: d for i, d in view.descriptors.items() if i}
    assert view._replace(descriptors=peers).full_sharing_maps == heard


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
    view = fleet_of(2)
    with_one = view._replace(descriptors={**view.descriptors, 0: view.descriptors[0]._replace(roster=roster)})
    assert with_one.roster == roster


@pytest.mark.parametrize("rung", list(Representation))
@pytest.mark.parametrize(("space", "book"), [("", ""), ("theirs", ""), ("", "theirs"), ("theirs", "theirs")])
def test_maps_go_to_the_same_network_and_codes_to_the_same_codebook_too(
    rung: Representation, space: str, book: str
) -> None:
    """In place of others boxes go, and the reason says why; all else is as decided."""
    view = fleet_of(3)
    their = view.descriptors[1]._replace(feature_space=space, codebook=book)
    view = view._replace(descriptors={**view.descriptors, 1: their})
    decided = [Directive(0, p, rung, 0.3, Disc(1.0, 2.0, 3.0), 5.0, 0.2, 0.5, 40, "decided") for p in (1, 2)]
    first, second = boxes_across_networks(lambda view: decided)(view)
    reads = not space if rung == FEATURES else not space and not book if rung == CODES else True
    wanted = decided[0] if reads else decided[0]._replace(representation=DETECTIONS, rho=0.0, reason=OTHER_NETWORK)
    assert (tuple(first), tuple(second)) == (tuple(wanted), tuple(decided[1]))
    assert (view.shares_features_with(1), view.shares_codes_with(1)) == (not space, not space and not book)


def test_of_drones_that_add_as_much_the_nearer_one_serves_though_a_higher_one_covers_more() -> None:
    """Ties go by the share of a sender's own footprint: that of a low drone lies within the receiver's, a high one's hardly."""
    view = fleet_of(4)
    near, high = view.descriptors[0], view.descriptors[1]
    x_m, y_m, z_m = view.descriptors[2].position_m
    each = {
        **view.descriptors,
        0: near._replace(position_m=(x_m, y_m, z_m), footprint_radius_m=20.0),  # wholly inside
        1: high._replace(position_m=(x_m + 10.0, y_m, z_m), footprint_radius_m=90.0),  # a fifth of it inside
        2: view.descriptors[2]._replace(footprint_radius_m=40.0),
        3: view.descriptors[3]._replace(position_m=(x_m + 400.0, y_m, z_m)),
    }
    serving = [
        ego
        for ego in (0, 1, 3)
        if {d.destination: d for d in deputies(view._replace(ego=ego, descriptors=each), k=1)}[2].rate_hz > 0
    ]
    assert serving == [0]


@pytest.mark.parametrize("phase", list(TaskPhase))
@pytest.mark.parametrize("region", [None, Disc(0.0, 0.0, 30.0)])
def test_the_learned_policy_reads_of_a_drone_what_is_its_own(phase: TaskPhase, region: Disc | None) -> None:
    """Every input by hand: peers' overlap is of the ego's footprint, a region counts while it is tracked."""
    view = fleet_of(3)
    me = view.descriptors[0]._replace(
        battery_soc=0.625, cpu_headroom=0.25, gpu_headroom=0.125, footprint_radius_m=20.0, peer_goodput_mbps=(27.0, 171.0),
        task_phase=phase, region=region,
    )  # fmt: skip
    each = {
        0: me,
        1: view.descriptors[1]._replace(position_m=me.position_m, footprint_radius_m=40.0, battery_soc=0.1),
        2: view.descriptors[2]._replace(position_m=(900.0, 0.0, 60.0)),
    }
    found = adaptive.features(view._replace(descriptors=each), 0.01)
    tracking = float(phase == TaskPhase.TRACK and region is not None)
    assert found == pytest.approx((-2.0, tracking, 0.5, 2.0, 0.625))


def test_borders_of_prior_methods() -> None:
    """What agrees just as far as the threshold; a map that comes far too late; a drone that sees nothing well."""
    view = fleet_of(2)
    at = view.descriptors[0].position_m
    grids = {
        0: bytes([0b10_10_10_00]) + bytes(63),
        1: bytes([0b00_10_10_10]) + bytes(63),
    }  # two cells in common of four
    alike = {i: d._replace(position_m=at, coverage_grid=grids[i]) for i, d in view.descriptors.items()}
    for threshold, rung in ((0.5, FEATURES), (0.51, DETECTIONS)):
        (d,) = hydracollab(view._replace(descriptors=alike), threshold=threshold)
        assert d.representation == rung
    slow = {**view.descriptors, 0: view.descriptors[0]._replace(peer_goodput_mbps=(0.5,))}
    (d,) = syncnet(view._replace(descriptors=slow))
    assert (d.representation, d.fusion_weight) == (FEATURES, 1 / STEPS)
    apart = {**view.descriptors, 1: view.descriptors[1]._replace(position_m=(500.0, 0.0, 60.0))}
    (d,) = where2comm(view._replace(descriptors=apart))
    assert d.roi == disc_around(centre_cell(view.descriptors[0]))
