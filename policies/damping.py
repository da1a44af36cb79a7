"""Damping about a policy: small changes of context are not read, passing ones do not switch the link.

Before the policy a hysteresis band (`apply_hysteresis`): of what can flicker, what a policy reads falls at once and rises only
by more than the band, so that a threshold switches up that much higher than it switches down. After it a dwell time
(`damp`): reductions at once, upgrades once they were asked for without a break for so long, repeats for free. The
number of upgrades in t seconds is at most 1 + t / dwell (average dwell time, FACTS §5). Pure functions both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sortie.policies.contract import Descriptor, Directive, Disc, Representation

_NONE = Representation.NONE
SAME_DISC_M = 1.6
"""A disc that moved less, half a feature cell, is the same disc: it would select almost the same cells."""
EPSILON_S = 1e-9
"""Clocks step in frames: a dwell of 1 s is over at the tenth frame whatever the last bit says."""


def apply_hysteresis(before: Descriptor, heard: Descriptor, hysteresis: float) -> Descriptor:
    """What a policy reads of a drone: its goodput, charge and headrooms with a hysteresis band, all else as heard.

    The play operator (backlash) of width h in the logarithm: for a quantity u the value read is
    min(u, max(value read before, u / (1 + h))).

    Args:
        before: what it read of that drone the last time.
        heard: the drone's new descriptor.
        hysteresis: h, the share by which a quantity must rise before its rise is read, ≥ 0.

    Returns:
        A descriptor that is nowhere better than `heard`; `heard` itself where they are equal.
    """
    if not hysteresis:
        return heard
    asked = _last_results.get(heard.agent_id)  # all that heard one broadcast ask the same, each in its turn
    if asked is not None and asked[0] is before and asked[1] is heard and asked[2] == hysteresis:
        return asked[3]
    answer = _banded(before, heard, hysteresis)
    _last_results[heard.agent_id] = before, heard, hysteresis, answer
    return answer


_last_results: dict[int, tuple[Descriptor, Descriptor, float, Descriptor]] = {}
"""By drone: what was asked of `apply_hysteresis` last, and its answer."""


def _banded(before: Descriptor, heard: Descriptor, hysteresis: float) -> Descriptor:
    part = 1.0 / (1.0 + hysteresis)
    # taken apart and built anew as a whole: every drone reads every other one in every frame
    (
        stamp, agent, at, turn, velocity, footprint, told_soc, told_cpu, told_gpu, told_links, grid, flags, phase, region, targets,
    ) = heard  # fmt: skip
    soc, cpu, gpu, links, last = told_soc, told_cpu, told_gpu, told_links, before.peer_goodput_mbps
    if links != last and len(links) == len(last):  # else the roster is another
        links = tuple([u if u <= v else (v if v > u * part else u * part) for u, v in zip(links, last, strict=True)])
    if soc > before.battery_soc:
        soc = max(before.battery_soc, soc * part)
    if cpu > before.cpu_headroom:
        cpu = max(before.cpu_headroom, cpu * part)
    if gpu > before.gpu_headroom:
        gpu = max(before.gpu_headroom, gpu * part)
    if soc == told_soc and cpu == told_cpu and gpu == told_gpu and links == told_links:
        return heard
    return Descriptor(
        stamp, agent, at, turn, velocity, footprint, soc, cpu, gpu, links, grid, flags, phase, region, targets
    )


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
        return state if _is_small_move(proposed, current) else LinkState(proposed)
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


def _is_small_move(proposed: Directive, current: Directive) -> bool:
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
