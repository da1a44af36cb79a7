"""The rules that every policy must keep, each tested on one view. The conformance kit (`conformance`) runs them."""

from __future__ import annotations

import contextlib
import functools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from sortie.policies.checks import check_directives, check_reposition, find_wrong_type
from sortie.policies.contract import Descriptor, Directive, FleetView, Policy, PolicyError, Representation
from sortie.policies.registry import parameters, viewpoint_of
from sortie.policies.verification.age_rule import by_peer, listed, older_views, raised_part, without_detached
from sortie.policies.verification.confine import Reached, confined
from sortie.policies.verification.invariants import just_heard
from sortie.policies.verification.subject import searchable
from sortie.policies.verification.symbols import Refused
from sortie.policies.verification.views import draw_view
from sortie.scenarios.plugins.user_calls import guarded, text_of

BUDGETS = (0.02, 0.25, 1.0)
_STALE_PERIODS = 20.0  # beyond the plane's ten, at which a peer is detached
_ROUNDING = 1e-9

Rule = Callable[[Policy, FleetView], str | None]
"""Tests a policy on one view. Returns a complaint, or None if the policy keeps the rule."""


class NoDirectives(Exception):
    """The policy itself raised, or returned no directives. Only the rules `returns directives` and `bounds kept` report it."""


def decide(policy: Policy, view: FleetView) -> list[Directive]:
    """The policy's directives for a copy of the view, so that a policy that changes its input affects no other rule."""
    directives = _decide_unchecked(policy, view)
    if any(find_wrong_type(d) is not None for d in directives):
        raise NoDirectives
    return directives


def _decide_unchecked(policy: Policy, view: FleetView) -> list[Directive]:
    """The same, without a check of the directives' types."""
    try:
        answer = policy(view.frozen)
    except Exception as error:
        raise NoDirectives from error
    if type(answer) not in (list, tuple):
        raise NoDirectives
    return list(answer)


def _returns_a_sequence(policy: Policy, view: FleetView) -> str | None:
    try:
        answer = policy(view.frozen)
    except Exception as error:
        return f"raises {type(error).__name__}: {text_of(error, str)}"
    if type(answer) not in (list, tuple):
        return f"returns {type(answer).__name__}, must be a list or a tuple of directives"
    return None


def _keeps_bounds(policy: Policy, view: FleetView) -> str | None:
    try:
        answer = policy(view.frozen)
    except Exception as error:
        raise NoDirectives from error
    try:
        check_directives(answer, view)
    except PolicyError as error:
        return str(error)
    return None


def _one_directive_per_link(policy: Policy, view: FleetView) -> str | None:
    return missing_links(decide(policy, view), view)


def missing_links(directives: Iterable[Directive], view: FleetView) -> str | None:
    """A complaint if the directives are not exactly one for each peer."""
    decided, peers = sorted(d.destination for d in directives), list(view.peers)
    return None if decided == peers else f"directives for [{listed(decided)}], must be for each of [{listed(peers)}]"


def _gives_reasons(policy: Policy, view: FleetView) -> str | None:
    silent = [f"{d.source}→{d.destination}" for d in decide(policy, view) if not d.reason]
    return f"no reason given for {', '.join(silent)}" if silent else None


def _keeps_its_input(policy: Policy, view: FleetView) -> str | None:
    before = copied(view)
    with contextlib.suppress(Exception):  # a policy that raises may have changed its input before
        policy(view)
    if view == before and list(view.descriptors) == list(before.descriptors) and list(view.age_s) == list(before.age_s):
        return None
    changed = [n for n in ("descriptors", "age_s") if getattr(view, n) != getattr(before, n)]
    return f"the policy changed its input: {', '.join(changed) or 'the order of drones'}"


def _is_deterministic(policy: Policy, view: FleetView) -> str | None:
    first = as_tuples(decide(policy, view))
    if as_tuples(decide(policy, view)) != first:
        return "two calls with the same view differ"
    decide(policy, draw_view(1, 0))
    return None if as_tuples(decide(policy, view)) == first else "differs after another view: it has a memory"


def _reads_only_its_view(policy: Policy, view: FleetView) -> str | None:
    usual = as_tuples(decide(policy, view))
    try:
        try:
            alone = as_tuples(decide(_alone(policy), view))  # type: ignore[arg-type]
        except Refused:  # here it goes where no search can follow
            alone = as_tuples(decide(confined(policy), view))
    except Reached as error:
        return str(error)
    return None if alone == usual else "decides differently if it can only use its view"


@functools.lru_cache(maxsize=4)
def _alone(policy: Policy) -> Policy:
    """The policy, able to use nothing but its view: with checks in its source, or by its copied functions."""
    try:
        follows, why = searchable(policy)
        if why:
            return confined(policy)
        follows(draw_view(1, 0).frozen)
    except (Refused, Exception):  # a search cannot follow it, or other rules report what it raises
        return confined(policy)
    return follows


def _order_is_irrelevant(policy: Policy, view: FleetView) -> str | None:
    usual = by_peer(decide(policy, view))
    ids = list(view.descriptors)
    for order in (ids[::-1], sorted(ids), ids[1:] + ids[:1]):
        other = view._replace(
            descriptors={i: view.descriptors[i] for i in order}, age_s={i: view.age_s[i] for i in order}
        )
        if by_peer(decide(policy, other)) != usual:
            return f"drones in the order {order} get other directives than in the order {ids}"
    return None


def _accepts_small_views(policy: Policy, view: FleetView) -> str | None:
    alone = {i: d for i, d in view.descriptors.items() if i == view.ego}
    for few in (
        view._replace(descriptors=alone, age_s={i: view.age_s[i] for i in alone}),
        view._replace(descriptors={}, age_s={}),
    ):
        try:
            directives = guarded(list)(policy(few.frozen))
        except Exception as error:
            return f"{len(few.descriptors)} drones in the view: raises {type(error).__name__}: {text_of(error, str)}"
        if directives:
            return f"{len(few.descriptors)} drones in the view: {len(directives)} directives, must be none"
    return None


def _accepts_stale_views(policy: Policy, view: FleetView) -> str | None:
    stale = view._replace(age_s=dict.fromkeys(view.age_s, _STALE_PERIODS * view.period_s))
    try:
        check_directives(policy(stale.frozen), stale)
    except Exception as error:
        return f"every descriptor {_STALE_PERIODS:g} periods old: {type(error).__name__}: {text_of(error, str)}"
    return None


def age_monotone(policy: Policy, view: FleetView) -> str | None:
    """The plane's second rule: an older descriptor raises no directive's representation, budget or rate.

    Each descriptor's age is raised by itself, and all together, beyond each of the plane's two thresholds. A peer that is
    detached has left the fleet, and its place may go to others: no directive may be higher than it was with that peer and
    than it is without.
    """
    before = decide(policy, view)
    for who, add_s, older in older_views(view):
        after = decide(policy, older)
        if raised_part(before, after) is None:  # mostly, and then a third decision changes nothing
            continue
        raised = raised_part(before, after, decide(policy, without_detached(view, older)))
        if raised is not None:
            return f"drone {', '.join(map(str, who))} {add_s:g} s older: {raised}"
    return None


_SENDS_BOXES = "put @sortie.boxes_across_networks above the policy, which sends boxes there"


def _sends_maps_where_they_are_fused(policy: Policy, view: FleetView) -> str | None:
    """A drone with another network cannot fuse the ego's feature maps, so their bytes would be spent in vain."""
    for d in decide(policy, view):
        if d.representation == Representation.FEATURES and not view.shares_features_with(d.destination):
            return f"directive {d.source}→{d.destination}: features, must be boxes: the peer has another network; {_SENDS_BOXES}"
        if d.representation == Representation.CODES and not view.shares_codes_with(d.destination):
            return f"directive {d.source}→{d.destination}: codes, must be boxes: the peer has another codebook; {_SENDS_BOXES}"
    return None


def _keeps_budget(policy: Policy, view: FleetView) -> str | None:
    """The fleet keeps every budget that the policy takes (`_SPENT`), if each drone decides on this one view.

    All are just heard: a drone that is detached for the others would count itself in.
    """
    view = just_heard(view)
    takes: Callable[..., Any] = policy
    known = parameters(policy)
    for name, (whose, full_maps) in _SPENT.items():
        for budget in BUDGETS if name in known else ():
            bound = partial(takes, **{name: budget})
            maps: Counter[str] = Counter()
            for ego in view.descriptors:
                for d in decide(bound, view._replace(ego=ego)):
                    maps[whose(d)] += d.rho  # type: ignore[assignment]  # a counter of maps, not whole ones
            allowed = budget * (view.full_sharing_maps if full_maps else 1)
            for who, spent in maps.items():
                if not spent <= allowed * (1 + _ROUNDING):
                    return f"{name}={budget:g}: {who} {spent:g} maps, at most {allowed:g} is allowed"
    decide(policy, view)
    return None


_SPENT: dict[str, tuple[Callable[[Directive], str], bool]] = {
    "rho": (lambda d: f"link {d.source}→{d.destination} carries", False),
    "sent_budget": (lambda d: f"drone {d.source} sends", True),
    "received_budget": (lambda d: f"drone {d.destination} receives", True),
}
"""Parameters that limit feature cells: who spends a directive's cells, and whether the limit is a share of full sharing
(N − 1 maps) or of one map."""


def _viewpoint_keeps_rules(policy: Policy, view: FleetView) -> str | None:
    """A viewpoint keeps the same rules: bounds, input unchanged, no memory, any order of drones, nothing but its view."""
    viewpoint = viewpoint_of(policy)
    if viewpoint is None:
        decide(policy, view)
        return None
    shown, alone = copied(view), {i: d for i, d in view.descriptors.items() if i == view.ego}
    try:
        request = viewpoint(shown)
        check_reposition(request, view)
        if shown != view:
            return "its viewpoint changed its input"
        others = {
            "two calls with the same view differ": viewpoint(copied(view)),
            "drones in another order get another place": viewpoint(
                view._replace(descriptors=_reversed(view.descriptors))
            ),
            "decides differently if it can only use its view": confined(viewpoint)(view),
        }
        for few in (alone, {}):
            fewer = view._replace(descriptors=few, age_s={i: view.age_s[i] for i in few})
            check_reposition(viewpoint(fewer), fewer)
    except PolicyError as error:
        return str(error)
    except Reached as error:
        return f"its viewpoint {error}"
    except Exception as error:
        return f"its viewpoint raises {type(error).__name__}: {text_of(error, str)}"
    return next((f"its viewpoint: {what}" for what, other in others.items() if other != request), None)


def _reversed(descriptors: Mapping[int, Descriptor]) -> dict[int, Descriptor]:
    """The same descriptors in the opposite order."""
    return dict(reversed(list(descriptors.items())))


RULES: dict[str, Rule] = {
    "returns directives": _returns_a_sequence,
    "bounds kept": _keeps_bounds,
    "one directive per link": _one_directive_per_link,
    "gives reasons": _gives_reasons,
    "input unchanged": _keeps_its_input,
    "deterministic": _is_deterministic,
    "reads only its view": _reads_only_its_view,
    "order of drones irrelevant": _order_is_irrelevant,
    "one drone and empty views": _accepts_small_views,
    "stale views": _accepts_stale_views,
    "age-monotone": age_monotone,
    "maps within one network": _sends_maps_where_they_are_fused,
    "budget kept": _keeps_budget,
    "viewpoint kept": _viewpoint_keeps_rules,
}
"""The kit's rules by name. A policy without a parameter of `_SPENT` always keeps `budget kept`."""


def copied(view: FleetView) -> FleetView:
    """The view with new mappings; everything in them is immutable."""
    return view._replace(descriptors=dict(view.descriptors), age_s=dict(view.age_s))


def as_tuples(directives: Iterable[Directive]) -> list[tuple[object, ...]]:
    return [tuple(d) for d in directives]  # with the reasons, which `==` ignores
