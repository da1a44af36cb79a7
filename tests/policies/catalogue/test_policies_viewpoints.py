"""Viewpoints: where the built-in one looks from, and that the kit finds what a viewpoint does wrong."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import pytest
from policies_examples import aged, changed, fleet_of, without

from sortie.policies.catalogue.baselines import everyone
from sortie.policies.catalogue.vantage import MOST_M, NEAR_M, over_region
from sortie.policies.contract import Directive, Disc, FleetView, Reposition, TaskPhase, looks_from
from sortie.policies.verification.kit.conformance import conform, failing

REGION = Disc(10.0, 50.0, 32.0)


def tracking(view: FleetView, region: Disc = REGION) -> FleetView:
    return changed(view, task_phase=TaskPhase.TRACK, region=region)


def wish(view: FleetView) -> Reposition:
    asked = over_region(view)
    assert asked is not None
    return asked


def test_vantage_brings_the_fleets_middle_over_the_region_and_nobody_past_another() -> None:
    view = tracking(fleet_of(5))
    asked = [wish(view._replace(ego=ego)) for ego in range(5)]
    middle = [math.fsum(p[axis] for p in asked) / 5 for axis in (0, 1)]
    assert middle == pytest.approx([10.0, 50.0])
    places = [d.position_m for d in view.descriptors.values()]
    shifts = [(a.x_m - at[0], a.y_m - at[1]) for a, at in zip(asked, places, strict=True)]
    assert all(shift == pytest.approx(shifts[0]) for shift in shifts)


def test_vantage_moves_a_fleet_that_is_not_near_and_no_farther_than_it_may() -> None:
    def x_of(away_m: float) -> float:
        return wish(tracking(changed(fleet_of(4), position_m=(away_m, 0.0, 60.0)), Disc(0.0, 0.0, 32.0))).x_m

    assert [x_of(away_m) for away_m in (NEAR_M - 0.5, NEAR_M, 250.0)] == [NEAR_M - 0.5, 0.0, 250.0 - MOST_M]


def test_vantage_leaves_ground_stations_other_groups_and_the_detached_out_of_the_fleets_middle() -> None:
    """A peer's descriptor is older, so that its region may lie a little behind."""
    view = changed(tracking(fleet_of(5)), 1, region=Disc(7.0, 50.0, 32.0))
    alone = wish(without(view, 3, 4))
    station = changed(view, 3, footprint_radius_m=0.0, position_m=(-300.0, 0.0, 1.5))
    assert wish(changed(station, 4, region=Disc(400.0, 50.0, 32.0), position_m=(400.0, 50.0, 60.0))) == alone
    assert wish(aged(view, {3: 50.0, 4: 50.0})) == alone != wish(view)
    middle_x = sum(view.descriptors[i].position_m[0] for i in range(3)) / 3
    assert alone.x_m == pytest.approx(view.descriptors[0].position_m[0] + REGION.x_m - middle_x)


def test_vantage_stays_in_its_slot_unless_it_tracks_a_region() -> None:
    assert over_region(changed(tracking(fleet_of(5)), task_phase=TaskPhase.SEARCH)) is None
    assert over_region(without(fleet_of(5), *range(5))) is None


calls = [0]


def place_of(view: FleetView, more_m: float) -> Reposition | None:
    return None if view.me is None else Reposition(view.me.position_m[0] + more_m, view.me.position_m[1])


def remembers(view: FleetView) -> Reposition | None:
    calls[0] += 1
    return place_of(view, calls[0])


def reads_the_order(view: FleetView) -> Reposition | None:
    return place_of(view, next((d.battery_soc for d in view.descriptors.values()), 0.0))


def changes_its_input(view: FleetView) -> Reposition | None:
    view.age_s.clear()  # type: ignore[attr-defined]
    return None


@pytest.mark.parametrize(
    ("look", "complaint"),
    [
        (remembers, "its viewpoint: two calls with the same view differ"),
        (lambda view: place_of(view, time.time() % 1), "its viewpoint: two calls with the same view differ"),
        (reads_the_order, "its viewpoint: drones in another order get another place"),
        (changes_its_input, "its viewpoint changed its input"),
        (lambda view: Reposition(1e4, 0.0) if view.me else None, "reposition of drone"),
        (lambda view: place_of(view, view.descriptors[view.ego].battery_soc), "its viewpoint raises KeyError"),
    ],
)
def test_the_kit_finds_what_a_viewpoint_does_wrong(
    look: Callable[[FleetView], Reposition | None], complaint: str
) -> None:
    @looks_from(look)
    def decide(view: FleetView) -> list[Directive]:
        return everyone(view)

    (broken,) = failing(conform(decide, count=40))
    assert broken.name == "viewpoint kept"
    assert broken.what.startswith(complaint)
