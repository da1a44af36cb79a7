"""The plane's rule that age only reduces: makes views with older descriptors, and finds directives that are higher there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.verification.invariants.language import by_peer


def older_views(view: FleetView, *, one_by_one: bool = True) -> Iterator[FleetView]:
    """Views in which one descriptor, or all, are older.

    Args:
        view: with the ages that are raised.
        one_by_one: also each by itself, besides all together.
    """
    for periods in (1.0, 3.5, 10.5, 1000.0):
        add_s = periods * view.period_s
        for i in view.age_s if one_by_one else ():
            yield view._replace(age_s={**view.age_s, i: view.age_s[i] + add_s})
        yield view._replace(age_s={i: a + add_s for i, a in view.age_s.items()})


def without_detached(view: FleetView, older: FleetView) -> FleetView:
    """A view without the peers that are detached in an older one."""
    left = older.attached.descriptors
    if len(left) == len(view.descriptors):
        return view
    return view._replace(
        descriptors={i: d for i, d in view.descriptors.items() if i in left},
        age_s={i: a for i, a in view.age_s.items() if i in left},
    )


def raised_part(
    before: Iterable[Directive], after: Iterable[Directive], without: Iterable[Directive] = ()
) -> str | None:
    """The first directive of `after` that is higher than that of `before`, and than that of `without` if there is one.

    Higher is a higher representation, a higher budget of the same representation, or a higher rate.
    """
    usual, instead = by_peer(before), by_peer(without)
    for d in after:
        raised = _rise(usual.get(d.destination), d)
        if raised and (d.destination not in instead or _rise(instead[d.destination], d)):
            return f"directive {d.source}→{d.destination}: {raised}"
    return None


def _rise(old: Directive | None, d: Directive) -> str | None:
    """In what a directive is higher than the one before."""
    if old is None:
        return "there was none before" if d.representation > 0 else None
    before, after = _rung(old), _rung(d)
    if after > before:
        return f"representation rises from {before:d} to {after:d}"
    if after == before and d.rho > old.rho:
        return f"rho rises from {old.rho} to {d.rho}"
    if d.rate_hz > old.rate_hz:
        return f"rate_hz rises from {old.rate_hz} to {d.rate_hz}"
    return None


def _rung(d: Directive) -> Representation:
    """Its representation; plain numbers are not ordered by fidelity."""
    return Representation(d.representation) if type(d.representation) is int else d.representation
