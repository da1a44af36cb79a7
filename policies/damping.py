"""Damping around a policy: it does not read small changes of context, and short changes do not switch a link.

Before the policy there is a hysteresis band (`apply_hysteresis`). A value that a policy reads falls at once and rises
only by more than the band. A threshold therefore switches up at a higher value than it switches down.

After the policy there is a dwell time (`damp`). Reductions take effect at once. Upgrades take effect when they have
been proposed without a break for the dwell time. Repeating a directive changes nothing. There are at most 1 + t / dwell
upgrades in t seconds (average dwell time; Hespanha & Morse 1999). Both functions are pure.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sortie.policies.contract import Descriptor, Directive, Disc, Representation

_NONE = Representation.NONE
SAME_DISC_M = 1.6
"""A disc that moved by less than this (half a feature cell) is the same disc: it selects almost the same cells."""
EPSILON_S = 1e-9
"""Tolerance of times: a dwell of 1 s is over at the tenth frame, whatever the rounding."""


def apply_hysteresis(before: Descriptor, heard: Descriptor, hysteresis: float) -> Descriptor:
    """A descriptor as a policy reads it: goodput, charge and headrooms with a hysteresis band, all else as heard.

    The play operator (backlash) of width h in the logarithm: for a quantity u the value read is
    min(u, max(value read before, u / (1 + h))).

    Args:
        before: the descriptor of that drone that it read the last time.
        heard: the drone's new descriptor.
        hysteresis: h, the share by which a quantity must rise before its rise is read, ≥ 0.

    Returns:
        A descriptor of which no value is better than in `heard`; `heard` itself if they are equal.
    """
    if not hysteresis:
        return heard
    last = _last_results.get(heard.agent_id)  # all receivers of one broadcast call this with the same arguments in turn
    if last is not None and last[0] is before and last[1] is heard and last[2] == hysteresis:
        return last[3]
    result = _banded(before, heard, hysteresis)
    _last_results[heard.agent_id] = before, heard, hysteresis, result
    return result


_last_results: dict[int, tuple[Descriptor, Descriptor, float, Descriptor]] = {}
"""By drone: the last arguments of `apply_hysteresis`, and its result."""


def _banded(before: Descriptor, heard: Descriptor, hysteresis: float) -> Descriptor:
    part = 1.0 / (1.0 + hysteresis)
    # unpacked and built again for speed: every drone reads every other one in every frame
    (
        stamp, agent, at, turn, velocity, footprint, heard_soc, heard_cpu, heard_gpu, heard_links, grid, flags, phase, region, targets,
    ) = heard  # fmt: skip
    soc, cpu, gpu, links, last = heard_soc, heard_cpu, heard_gpu, heard_links, before.peer_goodput_mbps
    if links != last and len(links) == len(last):  # else the roster is another
        links = tuple([u if u <= v else (v if v > u * part else u * part) for u, v in zip(links, last, strict=True)])
    if soc > before.battery_soc:
        soc = max(before.battery_soc, soc * part)
    if cpu > before.cpu_headroom:
        cpu = max(before.cpu_headroom, cpu * part)
    if gpu > before.gpu_headroom:
        gpu = max(before.gpu_headroom, gpu * part)
    if soc == heard_soc and cpu == heard_cpu and gpu == heard_gpu and links == heard_links:
        return heard
    return Descriptor(
        stamp, agent, at, turn, velocity, footprint, soc, cpu, gpu, links, grid, flags, phase, region, targets
    )


class LinkState(NamedTuple):
    """The directive in force on a link, and since when an upgrade has been proposed (None: none is)."""

    enforced: Directive
    upgrade_since_s: float | None = None


def damp(state: LinkState, proposed: Directive, now_s: float, dwell_s: float) -> LinkState:
    """The link's next state.

    Args:
        state: its present state.
        proposed: the policy's directive, after the staleness rules.
        now_s: the drone's clock.
        dwell_s: how long an upgrade must be proposed.

    Returns:
        `state` itself if nothing changes (a repeated directive restarts no timer). Otherwise a new state: its
        directive is `proposed`, or the lower of both in every part while an upgrade waits.
    """
    current = state.enforced
    if state.upgrade_since_s is not None:
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
    since_s = now_s if state.upgrade_since_s is None else state.upgrade_since_s
    if now_s - since_s >= dwell_s - EPSILON_S:
        return LinkState(proposed)
    if lower == current and since_s == state.upgrade_since_s:
        return state
    # The reason in force stays while only an upgrade waits; a reduction brings its own.
    return LinkState(current if lower == current else lower, since_s)


def _lower_of(current: Directive, proposed: Directive) -> Directive:
    """The lower of two directives in every part: what may take effect at once."""
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
    # A disc that moved while an upgrade waits does not come from that upgrade, so its reason would mislead.
    return reduced._replace(reason=current.reason) if _level(reduced) == _level(current) else reduced


def _is_small_move(proposed: Directive, current: Directive) -> bool:
    """Whether two directives of one level are equal, or differ only by a small move of their disc."""
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
