"""Borders of what policies read: a person without a region, cells in tenths, lines about time in any order, gates that rest."""

from __future__ import annotations

from itertools import permutations

import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue.deputies import deputies
from sortie.policies.contract import PERSON_FLAG, Directive, FleetView, Representation
from sortie.policies.damping import DampedLink, damp
from sortie.policies.decision_loop import Steps
from sortie.policies.verification.enforced import effective, judge
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.invariants.past import Past
from sortie.scenarios.disc import Disc

REGION = Disc(3.0, 4.0, 32.0)


def changed(view: FleetView, i: int, **fields: object) -> FleetView:
    return view._replace(descriptors={**view.descriptors, i: view.descriptors[i]._replace(**fields)})  # type: ignore[arg-type]


@pytest.mark.parametrize("who", [0, 1])
@pytest.mark.parametrize("region", [REGION, None])
def test_a_person_is_in_a_region_where_the_drone_has_one(region: Disc | None, who: int) -> None:
    """Whoever found the person. Without a region of its own nobody is in it."""
    view = changed(fleet_of(3), 0, region=region)
    assert not view.human_in_region
    assert changed(view, who, novelty_flags=PERSON_FLAG).human_in_region == (region is not None)


def test_who_adds_hardly_more_does_not_go_before_who_overlaps_more() -> None:
    """What is added counts in whole cells, weighted by the link. Of two that add as many, the one that overlaps more serves."""
    view = changed(fleet_of(3), 2, coverage_grid=bytes(64))
    x_m, y_m, z_m = view.descriptors[2].position_m
    grid = bytes([0b10101010] * 2) + bytes(62)  # eight cells seen well
    for i, off_m, mbps in ((0, 20.0, 20.0), (1, 0.0, 19.5)):  # eight, and 7.8
        view = changed(view, i, position_m=(x_m + off_m, y_m, z_m), coverage_grid=grid, peer_goodput_mbps=(mbps, mbps))

    def serves(view: FleetView) -> list[int]:
        found = {i: {d.destination: d for d in deputies(view._replace(ego=i), k=1)}[2] for i in (0, 1)}
        return [i for i, d in found.items() if d.representation != Representation.NONE]

    assert serves(view) == [1]
    assert serves(changed(view, 1, peer_goodput_mbps=(15.0, 15.0))) == [0]  # six


LINES = ("climbs_in(0.3) <= 1", "climbs_in(1) <= 2", "switches_in(0.2) <= 1")


@pytest.mark.parametrize("order", list(permutations(LINES)))
def test_lines_about_time_count_the_same_in_any_order(order: tuple[str, ...]) -> None:
    """A short time does not make a longer one forget."""
    view = fleet_of(2)

    def broken(lines: tuple[str, ...]) -> dict[str, list[int]]:
        rules = parse("\n".join(lines))
        past, found = Past(rules, 1.0), {line: [] for line in lines}
        for k, rate_hz in enumerate((1, 2, 1, 2, 1, 2, 2, 2, 2, 5)):
            acting = [Directive(0, 1, Representation.DETECTIONS, rate_hz=float(rate_hz))]
            past.note(0.1 * k, acting)
            for violation in judge(rules, view, [Steps(d, d, d) for d in acting], acting, (), past):
                found[violation.line].append(k)
        return found

    together = broken(order)
    assert together == {line: broken((line,))[line] for line in order}
    assert any(together.values())


@pytest.mark.parametrize("rung", list(Representation))
def test_a_gate_that_rests_sends_no_share_of_its_cells(rung: Representation) -> None:
    """At a rate of 0 a directive acts as none does, in every field that lines read."""
    asked = Directive(0, 1, rung, 0.4 if rung == Representation.FEATURES else 0.0, None, 0.0)
    acting = effective(asked)
    assert acting.representation == Representation.NONE
    assert acting.rho == 0.0
    moving = asked._replace(rate_hz=2.0)
    assert effective(moving) is moving
    (rule,) = parse("rho <= 0.1")
    assert not judge([rule], fleet_of(2), [Steps(asked, asked, asked)], [asked])


@pytest.mark.parametrize("waits", [3, 5])
def test_an_upgrade_that_waited_begins_with_the_disc_of_the_moment(waits: int) -> None:
    """A target that drives on while its link waits: what is granted is aimed at where it is, and nothing waits any more."""
    low = Directive(0, 1, Representation.FEATURES, 0.2, Disc(0.0, 0.0, 30.0), 2.0)
    link = DampedLink(low)
    for k in range(waits + 1):
        disc = Disc(2.0 * k, 0.0, 30.0)
        link = damp(link, low._replace(roi=disc, rate_hz=10.0, deadline_s=0.1 + 0.01 * k), 0.1 * k, 0.1 * waits)
        assert link.enforced.roi == disc  # also while the rate waits
        assert link.enforced.rate_hz == (10.0 if k == waits else 2.0)
    assert link.enforced.deadline_s == pytest.approx(0.1 + 0.01 * waits)
    assert link.proposals == ()
