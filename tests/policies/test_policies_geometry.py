"""Overlap of footprints, and the ranking of peers by it: the compiled one against each overlap by itself."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from policies_examples import fleet_of

from sortie.policies.catalogue import adaptive
from sortie.policies.contract import FleetView
from sortie.policies.geometry import footprint_overlap, peers_by_overlap
from sortie.scenarios.disc import rank_by_overlap


@given(st.integers(1, 100), st.sampled_from((0.0, 5.0, 40.0, 300.0)), st.integers(0, 2**32))
def test_peers_are_ranked_as_by_each_overlap_alone(drones: int, spread_m: float, seed: int) -> None:
    rng, view = random.Random(seed), fleet_of(drones)
    ids = rng.sample(range(256), drones)
    descriptors = {
        i: d._replace(
            agent_id=i,
            position_m=(rng.gauss(0.0, spread_m), rng.gauss(0.0, spread_m), 60.0),
            footprint_radius_m=rng.choice((0.0, 20.0, rng.uniform(0.0, 90.0))),
        )
        for i, d in zip(ids, view.descriptors.values(), strict=True)
    }
    view = view._replace(ego=ids[0], descriptors=descriptors, age_s=dict.fromkeys(ids, 0.1))
    for of in (None, ids[-1]):
        me = ids[0] if of is None else of
        overlap = {i: footprint_overlap(descriptors[me], d) for i, d in descriptors.items() if i != me}
        assert peers_by_overlap(view, of) == rank_by_overlap(me, overlap)


def test_a_drone_that_is_not_in_the_view_ranks_nobody() -> None:
    assert peers_by_overlap(fleet_of(3), 7) == []


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
