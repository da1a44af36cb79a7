"""A policy that also chooses where to look from: while tracking, the fleet stands about the mission's region.

What is shared is full sharing's (`all-4`), so that a sortie under each differs by the viewpoints alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import fsum, hypot

from sortie.policies.catalogue.baselines import everyone
from sortie.policies.catalogue.freshness import GONE_PERIODS
from sortie.policies.contract import Directive, FleetView, Reposition, TaskPhase, looks_from

NEAR_M = 5.0
"""Nearer than this is near enough: everyone stays where it is."""
MOST_M = 100.0
"""It asks for no place farther away; the formation's reach is shorter."""


def over_region(view: FleetView) -> Reposition | None:
    """While tracking: where it would be if the fleet's middle stood over the region, each drone at its own side.

    The fleet shifts as a whole, so that nobody crosses another's way. In other phases its slot.
    """
    me = view.me
    if me is None or me.region is None or me.task_phase != TaskPhase.TRACK:
        return None
    fresh = [d.position_m for i, d in view.descriptors.items() if view.age_s[i] <= GONE_PERIODS * view.period_s]
    if not fresh:
        return None
    middle_x, middle_y = (fsum(p[axis] for p in fresh) / len(fresh) for axis in (0, 1))
    dx_m, dy_m = me.region.x_m - middle_x, me.region.y_m - middle_y
    far_m = hypot(dx_m, dy_m)
    share = 0.0 if far_m < NEAR_M else MOST_M / far_m if far_m > MOST_M else 1.0
    x_m, y_m, _ = me.position_m
    return Reposition(x_m + share * dx_m, y_m + share * dy_m, f"the fleet's middle is {far_m:.0f} m from the region")


@looks_from(over_region)
def vantage(view: FleetView, *, rho: float = 0.25) -> Sequence[Directive]:
    """Features to every peer, from about the mission's region."""
    return everyone(view, rho=rho)
