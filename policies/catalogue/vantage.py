"""A policy that also chooses viewpoints: while tracking, the fleet moves over the mission region.

It shares what `all-4` shares, so that their sorties differ by the viewpoints alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import fsum, hypot

from sortie.policies.catalogue.baselines import everyone
from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Reposition, TaskPhase, looks_from

NEAR_M = 5.0
"""If the fleet is nearer than this, all drones stay where they are."""
MOST_M = 100.0
"""The farthest move that it requests; the formation's reach is shorter."""


def over_region(view: FleetView) -> Reposition | None:
    """While tracking: the drone's place if the fleet's centre were over the region. In other phases: its slot.

    The fleet is the attached drones with cameras, except those with another region. It shifts as a whole, so no paths cross.
    """
    me = view.me
    if me is None or me.region is None or me.task_phase != TaskPhase.TRACK:
        return None
    there = [d.position_m for d in view.attached.descriptors.values() if d is me or _belongs(d, me.region)]
    middle_x, middle_y = (fsum(p[axis] for p in there) / len(there) for axis in (0, 1))
    dx_m, dy_m = me.region.x_m - middle_x, me.region.y_m - middle_y
    far_m = hypot(dx_m, dy_m)
    share = 0.0 if far_m < NEAR_M else MOST_M / far_m if far_m > MOST_M else 1.0
    x_m, y_m, _ = me.position_m
    return Reposition(x_m + share * dx_m, y_m + share * dy_m, f"the fleet's middle is {far_m:.0f} m from the region")


def _belongs(d: Descriptor, region: Disc) -> bool:
    """Whether a drone has a camera and no other region.

    A region moves with its target, and a descriptor is a little older. One of before the phase turned has none yet; a drone
    that searches on has none either, and counts. One that lands does not.
    """
    if d.region is None or d.footprint_radius_m <= 0.0:
        return d.footprint_radius_m > 0.0 and d.task_phase != TaskPhase.LANDING
    return hypot(d.region.x_m - region.x_m, d.region.y_m - region.y_m) <= region.radius_m


@looks_from(over_region)
def vantage(view: FleetView, *, received_budget: float = 0.25) -> Sequence[Directive]:
    """Features to every peer, from places around the mission region."""
    return everyone(view, received_budget=received_budget)
