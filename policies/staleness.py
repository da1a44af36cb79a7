"""The staleness rules of the plane: age may only reduce what a link carries.

A descriptor older than 3 periods degrades the link to its peer, one older than 10 detaches the peer
(the paper's second rule). Pure functions; the reduction passes damping at once because it is a reduction.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

from sortie.policies.contract import ROUNDING_PERIODS, Directive, Representation

DEGRADED_RATE_HZ = 2.0
"""A degraded link carries detections at most this often, as the worked policy's lowest rung does."""


_REST = Directive(0, 0)

Limit = tuple[str, str, Any]
"""A field of a directive as invariants name it, a sign, and the other side."""
Ceiling = tuple[Limit, ...]
"""What a link may carry at most, by the age of what is known about its peer."""
Ceilings = Mapping[int, Ceiling]
"""By peer."""


class LinkHealth(IntEnum):
    """How far the context about a peer can be relied on."""

    FRESH = 0
    DEGRADED = 1
    DETACHED = 2


def health(
    age_s: float | None, period_s: float, degraded_after_periods: float, detached_after_periods: float
) -> LinkHealth:
    """Health of the link to a peer whose latest descriptor is `age_s` old (None: never heard)."""
    if age_s is None:
        return LinkHealth.DETACHED
    periods = age_s / period_s - ROUNDING_PERIODS
    if periods > detached_after_periods:
        return LinkHealth.DETACHED
    return LinkHealth.DEGRADED if periods > degraded_after_periods else LinkHealth.FRESH


CEILING: dict[LinkHealth, Ceiling] = {
    LinkHealth.FRESH: (),
    LinkHealth.DEGRADED: (
        ("representation", "<=", Representation.DETECTIONS.level),
        ("rate_hz", "<=", DEGRADED_RATE_HZ),
    ),
    LinkHealth.DETACHED: (
        ("representation", "==", Representation.NONE.level),
        ("rate_hz", "==", 0.0),
        *((word, "==", float(getattr(_REST, word))) for word in ("rho", "deadline_s", "fusion_weight")),
        ("roi", "==", 0.0),
    ),  # its sender's duty cycle is still free
}
"""What a shield may give a link: nothing else than what `cap_by_age` leaves as it is."""


def cap_by_age(directive: Directive, link: LinkHealth, age_s: float | None) -> Directive:
    """The directive as far as the age of the peer's descriptor allows it."""
    if link == LinkHealth.FRESH:
        return directive
    age = "never heard" if age_s is None else f"descriptor {age_s:.2f} s old"
    if link == LinkHealth.DETACHED:
        return Directive(
            directive.source, directive.destination, duty_percent=directive.duty_percent, reason=f"detached: {age}"
        )
    more = directive.representation > Representation.DETECTIONS  # also boxes with uncertainty: they lose it
    if not more and directive.rate_hz <= DEGRADED_RATE_HZ:
        return directive
    return directive._replace(
        representation=Representation.DETECTIONS if more else directive.representation,
        rho=0.0 if more else directive.rho,
        rate_hz=min(directive.rate_hz, DEGRADED_RATE_HZ),
        reason=f"degraded: {age}",
    )
