"""A policy that also chooses where to look from: while tracking, the fleet stands about the mission's region.

What is shared is full sharing's (`all-4`), so that a sortie under each differs by the viewpoints alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

from policies.baselines import everyone
from policies.contract import Directive, FleetView, Reposition, TaskPhase, looks_from

FRESH_PERIODS = 10.0
"""Peers heard longer ago than this are detached: where they are now is not known."""


def over_region(view: FleetView) -> Reposition | None:
    """While tracking: where it would be if the fleet's middle stood over the region, each drone at its own side.

    The fleet shifts as a whole, so that nobody crosses another's way. In other phases, and alone, its slot.
    """
    me = view.me
    if me is None or me.region is None or me.task_phase != TaskPhase.TRACK:
        return None
    fresh = [d.position_m for i, d in view.descriptors.items() if view.age_s[i] <= FRESH_PERIODS * view.period_s]
    if not fresh:
        return None
    middle_x, middle_y = (sum(p[axis] for p in fresh) / len(fresh) for axis in (0, 1))
    return Reposition(
        me.region.x_m + me.position_m[0] - middle_x,
        me.region.y_m + me.position_m[1] - middle_y,
        f"the fleet's middle is {hypot(me.region.x_m - middle_x, me.region.y_m - middle_y):.0f} m from the region",
    )


@looks_from(over_region)
def vantage(view: FleetView, *, rho: float = 0.25) -> Sequence[Directive]:
    """Features to every peer, from about the mission's region."""
    return everyone(view, rho=rho)
