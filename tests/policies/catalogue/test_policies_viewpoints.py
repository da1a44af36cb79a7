"""Viewpoints as the contract has them: bounded, optional, parameters shared, and broken ones named."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue.baselines import everyone, silence
from sortie.policies.catalogue.vantage import MOST_M, over_region
from sortie.policies.checks import check_reposition
from sortie.policies.contract import Directive, Disc, FleetView, PolicyError, Reposition, TaskPhase, looks_from
from sortie.policies.registry import POLICIES, resolve, viewpoint_of
from sortie.policies.verification.kit.conformance import conform, failing


def tracking(view: FleetView, region: Disc) -> FleetView:
    return view._replace(
        descriptors={i: d._replace(task_phase=TaskPhase.TRACK, region=region) for i, d in view.descriptors.items()}
    )


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (Reposition(500.0, 0.0), r"reposition of drone 0: 500\.0 m from the drone, must be at most 200 m"),
        (Reposition(math.nan, 0.0), r"reposition of drone 0: nan m from the drone, must be at most 200 m"),
        (Reposition(0.0, math.inf), r"reposition of drone 0: inf m from the drone, must be at most 200 m"),
        ((3.0, 4.0), "a viewpoint returns Reposition or None, got tuple"),
        (Reposition("a", 0.0, "x"), "reposition of drone 0: x_m is 'a', must be a number"),  # type: ignore[arg-type]
        (Reposition(0.0, None), "reposition of drone 0: y_m is None, must be a number"),  # type: ignore[arg-type]
        (Reposition(0.0, 1j), "reposition of drone 0: y_m is 1j, must be a number"),  # type: ignore[arg-type]
        (Reposition(0.0, 0.0, 5), "reposition of drone 0: reason is 5, must be text"),  # type: ignore[arg-type]
    ],
)
def test_a_wish_out_of_bounds_is_named(asked: object, message: str) -> None:
    view = fleet_of(3)
    view = view._replace(descriptors={i: d._replace(position_m=(0.0, 0.0, 60.0)) for i, d in view.descriptors.items()})
    with pytest.raises(PolicyError, match=f"^{message}$"):
        check_reposition(asked, view)
    check_reposition(None, view)
    check_reposition(Reposition(200.0, 0.0), view)
    check_reposition(Reposition(np.float32(100), np.int64(5)), view)  # type: ignore[arg-type]


def test_nobody_asks_for_a_drone_that_the_view_does_not_hold() -> None:
    empty = fleet_of(1)._replace(descriptors={}, age_s={})
    check_reposition(None, empty)
    with pytest.raises(PolicyError, match="the view has no descriptor of it, must be None"):
        check_reposition(Reposition(0.0, 0.0), empty)


def test_a_policy_and_its_viewpoint_share_the_parameters_that_both_name() -> None:
    def look(view: FleetView, *, far_m: float = 1.0) -> Reposition:
        return Reposition(far_m, 0.0)

    @looks_from(look)
    def decide(view: FleetView, *, far_m: float = 1.0, rho: float = 1.0) -> list[Directive]:
        return everyone(view, received_budget=rho)

    def asked(policy: Callable[..., object]) -> Reposition | None:
        found = viewpoint_of(policy)  # type: ignore[arg-type]
        assert found is not None
        return found(fleet_of(2))

    assert asked(decide) == Reposition(1.0, 0.0)
    assert asked(partial(decide, rho=0.1)) == Reposition(1.0, 0.0)
    assert asked(partial(decide, rho=0.1, far_m=5.0)) == Reposition(5.0, 0.0)
    assert viewpoint_of(silence) is None
    assert [name for name in POLICIES if viewpoint_of(resolve(name))] == ["vantage"]


def middle_of(view: FleetView) -> list[float]:
    return [math.fsum(d.position_m[axis] for d in view.descriptors.values()) / len(view.descriptors) for axis in (0, 1)]


def test_vantage_brings_the_fleets_middle_over_the_region_and_nobody_past_another() -> None:
    view = tracking(fleet_of(5), Disc(10.0, 50.0, 32.0))
    asked = []
    for ego in range(5):
        own = over_region(view._replace(ego=ego))
        assert own is not None
        asked.append(own)
    middle = [math.fsum(p[axis] for p in asked) / 5 for axis in (0, 1)]
    assert middle == pytest.approx([10.0, 50.0])
    shifts = [
        (a.x_m - d.position_m[0], a.y_m - d.position_m[1])
        for a, d in zip(asked, view.descriptors.values(), strict=True)
    ]
    assert all(shift == pytest.approx(shifts[0]) for shift in shifts)
    me = view.me
    assert me is not None
    near = over_region(tracking(fleet_of(5), Disc(middle_of(view)[0] + 4.0, middle_of(view)[1], 32.0)))
    assert near is not None
    assert near[:2] == me.position_m[:2]
    far = over_region(tracking(fleet_of(5), Disc(4000.0, 0.0, 32.0)))
    assert far is not None
    assert math.dist(far[:2], me.position_m[:2]) == pytest.approx(MOST_M)


def test_vantage_leaves_ground_stations_and_other_mission_groups_out_of_the_fleets_middle() -> None:
    """A peer's descriptor is older, so that its region may lie a little behind."""
    view = tracking(fleet_of(5), Disc(10.0, 50.0, 32.0))
    known = dict(view.descriptors)
    known[1] = known[1]._replace(region=Disc(7.0, 50.0, 32.0))
    alone = over_region(
        view._replace(descriptors={i: known[i] for i in (0, 1, 2)}, age_s=dict.fromkeys((0, 1, 2), 0.0))
    )
    known[3] = known[3]._replace(footprint_radius_m=0.0, position_m=(-300.0, 0.0, 1.5))
    known[4] = known[4]._replace(region=Disc(400.0, 50.0, 32.0), position_m=(400.0, 50.0, 60.0))
    assert alone is not None
    assert over_region(view._replace(descriptors=known)) == alone


def test_vantage_stays_in_its_slot_unless_it_tracks_a_region() -> None:
    view = tracking(fleet_of(5), Disc(10.0, 50.0, 32.0))
    searching = {i: d._replace(task_phase=TaskPhase.SEARCH) for i, d in view.descriptors.items()}
    assert over_region(view._replace(descriptors=searching)) is None
    assert over_region(fleet_of(5)._replace(descriptors={}, age_s={})) is None


calls = [0]


def remembers(view: FleetView) -> Reposition | None:
    calls[0] += 1
    return None if view.me is None else Reposition(view.me.position_m[0] + calls[0], view.me.position_m[1])


def reads_the_order(view: FleetView) -> Reposition | None:
    if view.me is None:
        return None
    first = next(iter(view.descriptors.values()))
    return Reposition(view.me.position_m[0] + first.battery_soc, view.me.position_m[1])


def reads_the_clock(view: FleetView) -> Reposition | None:
    import time

    return None if view.me is None else Reposition(view.me.position_m[0] + time.time() % 1, view.me.position_m[1])


def changes_its_input(view: FleetView) -> Reposition | None:
    view.age_s.clear()  # type: ignore[attr-defined]
    return None


@pytest.mark.parametrize(
    ("look", "complaint"),
    [
        (remembers, "its viewpoint: two calls with the same view differ"),
        (reads_the_order, "its viewpoint: drones in another order get another place"),
        (reads_the_clock, "its viewpoint: two calls with the same view differ"),
        (changes_its_input, "its viewpoint changed its input"),
        (lambda view: Reposition(1e4, 0.0) if view.me else None, "reposition of drone"),
        (lambda view: view.nothing, "its viewpoint raises AttributeError"),
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
