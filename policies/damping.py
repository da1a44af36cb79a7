"""Damping around a policy: small changes of context are not published, and short changes do not switch a link.

Before the policy there is a hysteresis band (`apply_hysteresis`). A value that a drone publishes falls at once and
rises only by more than the band. A threshold therefore switches up at a higher value than it switches down.

After the policy there is a dwell time (`damp`). Reductions take effect at once. An upgrade is granted as far as it was
proposed without a break for the dwell time: the least of that time, in every part. Repeating a directive changes nothing.
There are at most 1 + t / dwell upgrades in t seconds (average dwell time; Hespanha & Morse 1999). Both functions are pure.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import NamedTuple

from sortie.policies.contract import Descriptor, Directive, Disc, Representation, goodput_to_members
from sortie.scenarios.link_state import PROBED_MBPS

_NONE = Representation.NONE
SAME_DISC_M = 1.6
"""A disc that moved by less than this (half a feature cell) is the same disc: it selects almost the same cells."""
EPSILON_S = 1e-9
"""Tolerance of times: a dwell of 1 s is over at the tenth frame, whatever the rounding."""

_CHARGE_TO_LINKS = slice(Descriptor._fields.index("battery_soc"), Descriptor._fields.index("peer_goodput_mbps") + 1)
"""The fields of a descriptor with a hysteresis band: charge, both headrooms, goodput."""


def apply_hysteresis(before: Descriptor, measured: Descriptor, hysteresis: float) -> Descriptor:
    """A descriptor as it is published: goodput, charge and headrooms with a hysteresis band, all else as measured.

    The publisher does this once, so all who hear a descriptor read the same, whichever ones they missed before.

    The play operator (backlash) of width h in the logarithm: for a quantity u the value published is
    min(u, max(value published before, u / (1 + h))).

    Args:
        before: its last descriptor, published or not, before the wire rounded it: its own decisions read each of them.
        measured: what it measures now.
        hysteresis: h, the share by which a quantity must rise before its rise is published, ≥ 0.

    Returns:
        A descriptor of which no value is better than in `measured`; `measured` itself if they are equal.
    """
    if not hysteresis:
        return measured
    part = 1.0 / (1.0 + hysteresis)
    own = measured.battery_soc, measured.cpu_headroom, measured.gpu_headroom, measured.peer_goodput_mbps
    (soc, cpu, gpu, links), last = own, before.peer_goodput_mbps
    if measured.roster is not None and measured.roster != before.roster:
        last = goodput_to_members(before, measured.roster)
    if links != last and len(links) == len(last):  # else the fleet is another
        risen = list(links)
        for k in [k for k, u in enumerate(links) if u > PROBED_MBPS]:  # tiny values are states, not rates
            u, v = links[k], last[k]
            if u > v:
                risen[k] = v if v > u * part else u * part
        links = tuple(risen)
    if soc > before.battery_soc:
        soc = max(before.battery_soc, soc * part)
    if cpu > before.cpu_headroom:
        cpu = max(before.cpu_headroom, cpu * part)
    if gpu > before.gpu_headroom:
        gpu = max(before.gpu_headroom, gpu * part)
    if (soc, cpu, gpu, links) == own:
        return measured
    # built from its parts for speed: every drone does this in every frame
    before_these, after_them = measured[: _CHARGE_TO_LINKS.start], measured[_CHARGE_TO_LINKS.stop :]
    return Descriptor._make((*before_these, soc, cpu, gpu, links, *after_them))


class DampedLink(NamedTuple):
    """The directive in force on a link, and what the policy has proposed since it began to propose more than that."""

    enforced: Directive
    proposals: tuple[tuple[float, Directive], ...] = ()
    """(since when, directive), ascending in time; each was proposed until the next. Empty: no upgrade waits."""


def damp(link: DampedLink, proposed: Directive, now_s: float, dwell_s: float) -> DampedLink:
    """The link's next state.

    A reduction takes effect at once. An upgrade goes as far as the least that was proposed at every instant of the
    last `dwell_s`, and the dwell time then begins anew.

    Args:
        link: its present state.
        proposed: the policy's directive, after the staleness rules.
        now_s: the drone's clock.
        dwell_s: how long an upgrade must be proposed.

    Returns:
        `link` itself if nothing changes (a repeated directive restarts no timer). Otherwise a new state.
    """
    current, proposals = link
    if proposals:
        if proposed == current:
            return DampedLink(current)
    elif proposed is current:
        return link
    elif _level(proposed) == _level(current):
        # A disc that follows its target, a deadline: no step on the ladder.
        return link if _is_small_move(proposed, current) else DampedLink(proposed)
    lower = lower_of(current, proposed)
    if lower == proposed:
        return DampedLink(proposed)
    proposals = _with(proposals, proposed, now_s)
    if now_s - proposals[0][0] >= dwell_s - EPSILON_S:
        proposals = _since(proposals, now_s - dwell_s + EPSILON_S)
        least = reduce(lower_of, [directive for _, directive in proposals])
        if least == proposed:
            return DampedLink(proposed)
        if _level(least) != _level(lower):  # more than now: `lower` bounds it from below
            return DampedLink(least, ((now_s, proposed),))
    if lower == current and proposals == link.proposals:
        return link
    # The reason in force stays while only an upgrade waits; a reduction brings its own.
    return DampedLink(current if lower == current else lower, proposals)


def _with(
    proposals: tuple[tuple[float, Directive], ...], proposed: Directive, now_s: float
) -> tuple[tuple[float, Directive], ...]:
    """The proposals and one more; the last one's time stays if only its disc, deadline or reason changed."""
    if not proposals:
        return ((now_s, proposed),)
    since_s, last = proposals[-1]
    if _level(proposed) != _level(last):
        return (*proposals, (now_s, proposed))
    return proposals if proposed == last else (*proposals[:-1], (since_s, proposed))


def _since(proposals: tuple[tuple[float, Directive], ...], begin_s: float) -> tuple[tuple[float, Directive], ...]:
    """Those that still stood after `begin_s`."""
    first = sum(1 for since_s, _ in proposals[1:] if since_s <= begin_s)
    return proposals[first:]


def lower_of(current: Directive, proposed: Directive) -> Directive:
    """The lower of two directives in every part: what may take effect at once."""
    if current.representation == _NONE or proposed.representation == _NONE:
        # Nothing flows, so the duty cycle alone is left to lower.
        duty = min(current.duty_percent, proposed.duty_percent)
        if current.representation == _NONE and duty == current.duty_percent:
            return current
        rest = proposed if proposed.representation == _NONE else current
        return rest if duty == rest.duty_percent else rest._replace(duty_percent=duty, reason=proposed.reason)
    # The share of cells of another rung does not bound this one's.
    if proposed.representation < current.representation:
        rho, roi = proposed.rho, proposed.roi
    elif proposed.representation > current.representation:
        rho, roi = current.rho, _lower_roi(current.roi, proposed.roi)
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


def is_climb(a: Directive, b: Directive) -> bool:
    """Whether the second of two directives for one link is higher in some part, so that damping would make it wait."""
    return _level(a) != _level(b) and lower_of(a, b) != b


def is_switch(a: Directive, b: Directive) -> bool:
    """Whether two directives for one link differ by more than a small move of the disc, which damping ignores."""
    return a is not b and a != b and not (_level(a) == _level(b) and _is_small_move(a, b))


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
    if rung == _NONE:
        return rung, duty_percent
    return rung, rho, math.inf if roi is None else roi.radius_m, rate_hz, duty_percent, weight


def _lower_roi(current: Disc | None, proposed: Disc | None) -> Disc | None:
    if current is None or proposed is None:
        return proposed if current is None else current
    # A disc that moves with its target is no switch; one that grows is.
    return proposed._replace(radius_m=min(current.radius_m, proposed.radius_m))
