"""One suite over every policy, with no exemptions."""

from __future__ import annotations

import copy
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_examples import fleet_of

from policies.contract import Descriptor, Disc, FleetView, Representation, TaskPhase, check_directives
from policies.registry import POLICIES

goodputs = st.floats(0, 600, allow_nan=False)
positions = st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(0, 120))


@st.composite
def views(draw: st.DrawFn) -> FleetView:
    """A fleet view as the plane may hand it over: some drones never heard, some stale, in any order."""
    n = draw(st.integers(1, 9))
    ego = draw(st.integers(0, n - 1))
    heard = [i for i in range(n) if i == ego or draw(st.booleans())]
    order = draw(st.permutations(heard))
    descriptors = {
        i: Descriptor(
            stamp_ns=draw(st.integers(0, 10**12)),
            agent_id=i,
            position_m=draw(positions),
            orientation_xyzw=(0.0, 0.0, 0.0, 1.0),
            velocity_mps=(1.0, 0.0, 0.0),
            footprint_radius_m=draw(st.floats(0, 100)),
            battery_soc=draw(st.floats(0, 1)),
            cpu_headroom=1.0,
            gpu_headroom=1.0,
            peer_goodput_mbps=tuple(draw(goodputs) for _ in range(n - 1)),
            coverage_grid=bytes(64),
            novelty_flags=0,
            task_phase=draw(st.sampled_from(TaskPhase)),
            region=draw(st.none() | st.just(Disc(1.0, 2.0, 32.0))),
        )
        for i in order
    }
    return FleetView(ego, 0.1, descriptors, {i: draw(st.floats(0, 10)) for i in order})


@pytest.mark.parametrize("name", POLICIES)
@settings(max_examples=60, deadline=None)
@given(view=views())
def test_a_policy_keeps_the_contract(name: str, view: FleetView) -> None:
    policy = POLICIES[name]
    before = copy.deepcopy(view)
    directives = policy(view)
    check_directives(directives, view)
    assert view == before, "the policy changed its input"
    assert list(policy(view)) == list(directives), "same in, same out"
    assert {d.destination for d in directives} == set(view.peers), "one directive per outgoing link"
    assert all(d.reason for d in directives), "every directive says why"
    shuffled = list(view.descriptors)
    random.Random(1).shuffle(shuffled)
    other = FleetView(
        view.ego, view.period_s, {i: view.descriptors[i] for i in shuffled}, {i: view.age_s[i] for i in shuffled}
    )
    by_peer = {d.destination: d for d in directives}
    assert {d.destination: d for d in policy(other)} == by_peer, "the order of drones matters"


@pytest.mark.parametrize("name", POLICIES)
def test_empty_and_lonely_views_give_no_directives(name: str) -> None:
    assert list(POLICIES[name](FleetView(0, 0.1, {}, {}))) == []


@pytest.mark.parametrize("name", [n for n in POLICIES if n not in ("worked", "silence")])
@pytest.mark.parametrize("rho", [0.02, 0.05, 0.1, 0.25, 1.0])
def test_fixed_policies_spend_the_same_budget(name: str, rho: float) -> None:
    """Matched bytes: what a drone sends over all its links is ρ of full sharing, up to a full map a link."""
    view = fleet_of(5)
    directives = [d for d in POLICIES[name](view, rho=rho) if d.representation == Representation.FEATURES]
    spent = math.fsum(d.rho for d in directives)
    assert spent == pytest.approx(min(rho * 4, len(directives)))


def chosen(name: str, **params: object) -> list[int]:
    return [d.destination for d in POLICIES[name](fleet_of(5), **params) if d.representation != Representation.NONE]


def test_best_and_worst_choose_by_overlap() -> None:
    assert chosen("best-2") == [1, 2]
    assert chosen("worst-2") == [3, 4]
    assert chosen("all-4") == [1, 2, 3, 4]
    assert chosen("silence") == []
    assert len(chosen("random-2")) == 2
    assert {tuple(chosen("random-2", salt=s)) for s in range(40)} == {
        (a, b) for a in range(1, 5) for b in range(a + 1, 5)
    }
