"""Peers that are detached are out of every choice of every built-in policy."""

from __future__ import annotations

import pytest
from policies_examples import fleet_of
from sim_examples import example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.registry import POLICIES
from sortie.policies.staleness import LinkHealth, health
from sortie.policies.verification.kit.views import draw_view
from sortie.sim.engine.sortie import run_sortie

GONE_S = 1.5


def plain(directives: object) -> set[Directive]:
    return set(directives)  # type: ignore[call-overload,no-any-return]  # equality leaves reasons out


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("number", [n for n in range(20) if len(draw_view(5, n).peers) >= 2])
def test_a_detached_peer_gets_nothing_and_the_rest_is_decided_as_without_it(name: str, number: int) -> None:
    view = draw_view(5, number)
    view = view._replace(period_s=0.1, age_s=dict.fromkeys(view.age_s, 0.0), detached_after_periods=10.0)
    lost = view.peers[number % len(view.peers)]
    with_lost = view._replace(age_s={**view.age_s, lost: GONE_S})
    without = view._replace(
        descriptors={i: d for i, d in view.descriptors.items() if i != lost},
        age_s={i: 0.0 for i in view.descriptors if i != lost},
    )
    decided = {d.destination: d for d in POLICIES[name](with_lost)}
    assert decided.pop(lost).representation == Representation.NONE
    assert plain(decided.values()) == plain(POLICIES[name](without))


@pytest.mark.parametrize("age_periods", [9.999, 10.0, 10.001, 25.0])
def test_attached_is_what_the_staleness_rules_call_attached(age_periods: float) -> None:
    view = fleet_of(3)
    view = view._replace(age_s={0: 0.0, 1: age_periods * view.period_s, 2: 0.0})
    attached = health(view.age_s[1], view.period_s, 3.0, view.detached_after_periods) != LinkHealth.DETACHED
    assert (1 in view.attached.descriptors) == attached
    assert (view.attached is view) == attached
    assert view._replace(detached_after_periods=30.0).attached.descriptors.keys() == {0, 1, 2}


def test_the_ego_is_attached_to_itself() -> None:
    view = fleet_of(2)
    assert list(view._replace(age_s={0: 99.0, 1: 99.0}).attached.descriptors) == [0]


def test_a_lost_drone_gives_its_place_to_the_next_best() -> None:
    """With the leader of a cross lost, four drones are left, each of which serves two others."""
    record = run_sortie(
        example(
            "policy={name: best-2, params: {received_budget: 0.02}}", "events=[{kind: drone_lost, at_s: 1, drone: 0}]"
        )
    )
    used: dict[tuple[int, int], str] = {}
    for row in record.tables["directives"].to_pylist():
        used[row["drone"], row["peer"]] = row["representation"]
    links = [link for link, rung in used.items() if rung != "nothing" and 0 not in link]
    assert len(links) == 8


def test_a_view_knows_the_scenarios_limit() -> None:
    seen: list[float] = []

    def watch(view: FleetView) -> list[Directive]:
        seen.append(view.detached_after_periods)
        return []

    run_sortie(example("context.detached_after_periods=20", "duration_s=0.5"), watch)
    assert set(seen) == {20.0}
