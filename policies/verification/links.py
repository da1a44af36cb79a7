"""A directive as lines compare it: seven numbers and the peer.

The shield works on these. Only what replaces a directive becomes one again.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, Disc, Representation
from sortie.policies.verification.words import DECISIONS
from sortie.scenarios.representation import AT_LEVEL, LEVELS

LEAST_RATE_HZ = 2.0
"""The rate of a link that a shield makes carry something, if no line names a rate: the bottom rung of the paper's table."""
Far = tuple[int, float]
"""How many fields differ, and by how much in all: a rung counts a quarter, a number its share of its bounds."""


class Link(NamedTuple):
    """A directive's fields, in the order of `words.DECISIONS`, and the peer."""

    level: float
    rho: float
    rate_hz: float
    deadline_s: float
    fusion_weight: float
    duty: float
    roi: bool
    destination: int


AT = {word: at for at, word in enumerate(DECISIONS)}
"""The place of a field in a `Link`, by its word."""
LEVEL, RHO, RATE_HZ, _, _, DUTY, ROI = AT.values()
HIGHEST = tuple([1.0 if word in ("duty", "roi") else DIRECTIVE_BOUNDS[word].high for word in AT])
"""The upper bound of each field; the lower one is 0."""
Compare = Callable[[Any, Any], Any]
Limit = tuple[Compare, float]
"""A comparison that a field must satisfy, and its other side."""
Ceiling = tuple[tuple[int, Limit], ...]
"""What a link may carry at most, for instance by the age of what is known about its peer: limits of fields, by their places."""


def nothing_but_duty() -> Ceiling:
    """The ceiling of a link that carries nothing. Its sender's duty cycle is still free."""
    rests = as_link(Directive(0, 0))
    return tuple([(at, (operator.eq, float(rests[at]))) for at in AT.values() if at != DUTY])


def as_link(directive: Directive) -> Link:
    """A directive as lines compare it."""
    _, peer, rung, rho, roi, rate_hz, deadline_s, weight, duty, _ = directive
    fields = LEVELS.get(rung, rung), rho, rate_hz, deadline_s, weight, duty / 100, roi is not None, peer
    return tuple.__new__(Link, fields)


def as_directive(before: Directive, was: Link, link: Link, region: Disc | None, reason: str) -> Directive:
    """A directive, changed where one link differs from another one.

    Args:
        before: the directive.
        was: the same as a link.
        link: the changed link.
        region: the sender's region, if the link may have to be confined to one.
        reason: of the new directive.
    """
    level, rho, rate_hz, deadline_s, weight, duty, roi, _ = link
    rung = before.representation if level is was.level else AT_LEVEL[level]
    percent = before.duty_percent if duty is was.duty else round(duty * 100)
    disc = before.roi if roi is was.roi else region if roi else None
    fields = before.source, before.destination, rung, rho, disc, rate_hz, deadline_s, weight, percent, reason
    return tuple.__new__(Directive, fields)


def changed(link: Link, wanted: Mapping[int, float], region: Disc | None) -> Link | None:
    """The link with changed fields, by their places; None if there is no such directive."""
    fields: list[Any] = list(link)
    for at, value in wanted.items():
        fields[at] = value
    if DUTY in wanted:
        fields[DUTY] = round(wanted[DUTY] * 100) / 100
    if ROI in wanted and region is None and wanted[ROI]:
        return None
    if LEVEL in wanted and fields[LEVEL] != link.level:
        level = fields[LEVEL]
        if level < _CELLS_FROM and link.rho and RHO not in wanted:
            fields[RHO] = 0.0  # only codes and features have cells
        if level > link.level and link.rate_hz <= 0 and RATE_HZ not in wanted:
            fields[RATE_HZ] = LEAST_RATE_HZ  # a link at 0 Hz carries nothing
    return tuple.__new__(Link, fields)


_CELLS_FROM = Representation.CODES.level


def distance(a: Link, b: Link) -> Far:
    """How far two links are from each other."""
    return further((0, 0.0), a, dict(enumerate(b[:-1])))


def further(far: Far, link: Link, values: Mapping[int, float]) -> Far:
    """A distance, and what fields with these values add to it."""
    fields, far_off = far
    for at, value in values.items():
        now = link[at]
        if value != now:
            fields, far_off = fields + 1, far_off + abs(value - now) / HIGHEST[at]
    return fields, far_off
