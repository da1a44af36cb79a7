"""Damping between a policy and the gate: reductions at once, upgrades after a dwell time, repeats for free.

A pure function over one link's state. An upgrade is made once it has been asked for without a break for the
dwell time, so that a small or passing change of context does not switch the link; the number of upgrades in
t seconds is at most 1 + t / dwell (average dwell time, FACTS §5).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from policies.contract import Directive, Disc, Representation

_NONE = Representation.NONE
SAME_DISC_M = 1.6
"""A disc that moved less, half a feature cell, is the same disc: it would select almost the same cells."""
EPSILON_S = 1e-9
"""Clocks step in frames: a dwell of 1 s is over at the tenth frame whatever the last bit says."""


class LinkState(NamedTuple):
    """What the gate enforces on a link, and since when more is being asked for (None: it is not)."""

    enforced: Directive
    asking_since_s: float | None = None


def damp(state: LinkState, proposed: Directive, now_s: float, dwell_s: float) -> LinkState:
    """The link's next state.

    Args:
        state: its present state.
        proposed: what the policy, capped by the staleness rules, asks for now.
        now_s: the drone's clock.
        dwell_s: how long an upgrade must be asked for.

    Returns:
        `state` itself where nothing changes (a repeated directive restarts no timer), otherwise a new one whose
        directive is `proposed`, or the lower of both in every part while an upgrade waits.
    """
    current = state.enforced
    if state.asking_since_s is not None:
        if proposed == current:
            return LinkState(current)
    elif proposed is current:
        return state
    elif _level(proposed) == _level(current):
        # A disc that follows its target, a deadline: no step on the ladder.
        return state if _hardly_moved(proposed, current) else LinkState(proposed)
    lower = _lower_of(current, proposed)
    if lower == proposed:
        return LinkState(proposed)
    since_s = now_s if state.asking_since_s is None else state.asking_since_s
    if now_s - since_s >= dwell_s - EPSILON_S:
        return LinkState(proposed)
    if lower == current and since_s == state.asking_since_s:
        return state
    # The reason in force stays while only an upgrade waits; a reduction brings its own.
    return LinkState(current if lower == current else lower, since_s)


def _lower_of(current: Directive, proposed: Directive) -> Directive:
    """The directive that is nowhere above either: what may be enforced at once."""
    if current.representation == _NONE:
        # Nothing flows, so the duty cycle alone can be lowered.
        duty = min(current.duty_percent, proposed.duty_percent)
        return current if duty == current.duty_percent else current._replace(duty_percent=duty, reason=proposed.reason)
    if proposed.representation < current.representation:
        rho, roi = proposed.rho, proposed.roi  # the budget of another rung does not bound this one
    else:
        rho, roi = min(current.rho, proposed.rho), _lower_roi(current.roi, proposed.roi)
    reduced = proposed._replace(
        representation=min(current.representation, proposed.representation),
        rho=rho,
        roi=roi,
        rate_hz=min(current.rate_hz, proposed.rate_hz),
        fusion_weight=min(current.fusion_weight, proposed.fusion_weight),
        duty_percent=min(current.duty_percent, proposed.duty_percent),
    )
    if reduced == current:
        return current
    # A disc that moved while an upgrade waits is not that upgrade's doing: its reason would mislead.
    return reduced._replace(reason=current.reason) if _level(reduced) == _level(current) else reduced


def _hardly_moved(proposed: Directive, current: Directive) -> bool:
    """Whether two directives of one level are equal, or differ by a small step of their disc alone."""
    a, b = proposed.roi, current.roi
    if proposed.deadline_s != current.deadline_s:
        return False
    if a is None or b is None:
        return a is b
    return math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) < SAME_DISC_M


def _level(d: Directive) -> tuple[float, ...]:
    _, _, rung, rho, roi, rate_hz, _, weight, duty_percent, _ = d
    return rung, rho, math.inf if roi is None else roi.radius_m, rate_hz, duty_percent, weight


def _lower_roi(current: Disc | None, proposed: Disc | None) -> Disc | None:
    if current is None or proposed is None:
        return proposed if current is None else current
    # A disc that moves with its target is no switch; one that grows is.
    return proposed._replace(radius_m=min(current.radius_m, proposed.radius_m))
