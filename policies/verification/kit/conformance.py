"""The conformance kit: rules that every policy must keep, each tried on drawn views. No policy is exempt.

    assert failing(conform(my_policy)) == []

A rule that fails has the smallest failing view that was found. What is unusual, and may be meant, is a warning.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Literal, NamedTuple

from sortie.policies.checks import check_directives, check_reposition, find_wrong_type
from sortie.policies.contract import Descriptor, Directive, FleetView, Policy, PolicyError, Representation
from sortie.policies.registry import parameters, viewpoint_of
from sortie.policies.verification.invariants.language import by_peer, just_heard
from sortie.policies.verification.kit.single_view import RepeatableView, missing_links, only_falls_with_age
from sortie.policies.verification.kit.tried import NotJudged, try_views
from sortie.policies.verification.kit.views import draw_view, draw_views
from sortie.policies.verification.subject import constants_of, with_function
from sortie.scenarios.plugins.user_calls import Guarded
from sortie.scenarios.plugins.user_code import load

VIEWS = 300
MANY_DECISIONS = 1 / 3
"""The share of the views on which a rule is tried that takes many decisions a view."""
ALL_EGOS = 1 / 6
"""The share of the views on which every drone of the view decides."""
LOADS_ANEW = 1 / 30
"""The share of the views for which the policy's file is loaded anew."""
DECISION_LIMIT_S = 0.010
"""A tenth of a frame at 10 Hz, at 20 drones. A slower decision is unusual."""
TIMED = 50
"""How many decisions are timed at each size."""
BUDGETS = (0.02, 0.25, 1.0)
_STALE_PERIODS = 20.0  # beyond the plane's ten, at which a peer is detached
_LATER_NS = 1_000_000_000_000
_ROUNDING = 1e-9
_ANOTHER = draw_view(1, 0)

Level = Literal["must", "unusual"]
Verdict = Literal["holds", "fails", "unusual", "not tried enough"]


@dataclass(frozen=True, slots=True)
class Check:
    """The verdict of one rule on one policy or model."""

    name: str
    verdict: Verdict
    what: str
    """The complaint if the rule fails, otherwise what was tested."""
    counterexample: FleetView | None = None
    """The smallest failing view found; None if the rule holds or needs no view."""

    @property
    def holds(self) -> bool:
        """Whether the rule was tried on all views and nothing broke it. What is unusual breaks no rule."""
        return self.verdict in ("holds", "unusual")


OnView = Callable[[Policy, FleetView], str | None]
"""Judges a policy on one view: returns what is wrong, or None. Raises `NotJudged` where there are no directives."""


class Rule(NamedTuple):
    """One rule of the kit."""

    level: Level
    says: str
    """What the policy does, as a sentence without its subject."""
    complaint: OnView
    share: float = 1.0
    """On which share of the views it is tried."""


def conform(
    policy: Policy, views: Iterable[FleetView] | None = None, *, seed: int = 0, count: int = VIEWS
) -> list[Check]:
    """Check a policy against every rule of the kit.

    Args:
        policy: any callable of the contract. The keyword parameters `rho`, `sent_budget` and `received_budget` limit its cells.
        views: the views to test it on; without them, the first `count` views of `seed`, some at the policy's constants.
        seed: of the drawn views.
        count: how many; a rule that takes many decisions a view is tried on `Rule.share` of them.

    Returns:
        One check for each rule, always in the same order. A rule that was tried on fewer views than promised does not hold.
    """
    drawn = list(draw_views(seed, count, constants_of(policy)) if views is None else views)
    checks = []
    for name, rule in RULES.items():
        tried = drawn[: max(1, round(rule.share * len(drawn)))] if views is None else drawn
        checks.append(_check_rule(name, rule, policy, tried))
    return [*checks, _decides_in_time(policy)]


def failing(checks: Sequence[Check]) -> list[Check]:
    """The checks of rules that do not hold: broken, or tried on fewer views than promised."""
    return [c for c in checks if not c.holds]


def _check_rule(name: str, rule: Rule, policy: Policy, views: Sequence[FleetView]) -> Check:
    tried = try_views({name: lambda view: rule.complaint(policy, copied(view))}, views)[name]
    if tried.view is not None:
        return Check(name, "fails" if rule.level == "must" else "unusual", tried.complaint, tried.view)
    if tried.judged < len(views) or not views:
        why = "see returns directives, bounds kept"
        return Check(name, "not tried enough", f"{tried.judged} of {len(views)} views could be checked: {why}")
    return Check(name, "holds", f"{tried.judged} views: {rule.says}")


def _decides_in_time(policy: Policy) -> Check:
    """CPU time of the fastest decision, at 5 and at 20 drones: other programs make decisions slower, and none faster."""
    name, took_s = "time per decision", {}
    for drones in (5, 20):
        view = full_view(drones)
        marks_ns = [time.thread_time_ns()]
        for _ in range(TIMED):
            try:
                policy(view)
            except Exception as error:
                return Check(name, "not tried enough", f"raises {type(error).__name__}: {error}")
            marks_ns.append(time.thread_time_ns())
        took_s[drones] = min(b - a for a, b in pairwise(marks_ns)) * 1e-9
    what = ", ".join(f"{s * 1e6:.0f} µs at {n} drones" for n, s in took_s.items())
    if took_s[20] > DECISION_LIMIT_S:
        return Check(name, "unusual", f"{what}, more than {DECISION_LIMIT_S * 1e3:g} ms")
    return Check(name, "holds", what)


def full_view(drones: int) -> FleetView:
    """A view of this many drones, all heard, in drawn states, for measuring the time of a decision."""
    drawn = next(v for v in draw_views(2, 10_000) if len(v.descriptors) >= 3)
    some = list(drawn.descriptors.values())
    descriptors = {
        i: some[i % len(some)]._replace(agent_id=i, peer_goodput_mbps=(100.0,) * (drones - 1), roster=None)
        for i in range(drones)
    }
    return FleetView(0, 0.1, descriptors, dict.fromkeys(descriptors, 0.1))


# --- the rules -----------------------------------------------------------------------------------


def decide(policy: Policy, view: FleetView) -> list[Directive]:
    """The policy's directives for a copy of the view, so that a policy that changes its input affects no other rule."""
    try:
        answer = policy(view.frozen)
    except Exception as error:
        raise NotJudged from error
    if type(answer) not in (list, tuple) or any(find_wrong_type(d) is not None for d in answer):
        raise NotJudged
    return list(answer)


def _returns_a_sequence(policy: Policy, view: FleetView) -> str | None:
    answer = policy(view.frozen)
    kind = type(answer)
    return None if kind in (list, tuple) else f"returns {kind.__name__}, must be a list or a tuple of directives"


def _keeps_bounds(policy: Policy, view: FleetView) -> str | None:
    try:
        answer = policy(view.frozen)
    except Exception as error:
        raise NotJudged from error
    check_directives(answer, view)
    return None


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
    decide(policy, _ANOTHER)
    return None if as_tuples(decide(policy, view)) == first else "differs after another view: it has a memory"


def _order_is_irrelevant(policy: Policy, view: FleetView) -> str | None:
    usual = by_peer(decide(policy, view))
    ids = list(view.descriptors)
    for order in (ids[::-1], sorted(ids), ids[1:] + ids[:1]):
        if by_peer(decide(policy, _with_drones(view, order))) != usual:
            return f"drones in the order {order} get other directives than in the order {ids}"
    return None


def _accepts_small_views(policy: Policy, view: FleetView) -> str | None:
    for ids in ([i for i in view.descriptors if i == view.ego], []):
        try:
            directives = list(policy(_with_drones(view, ids).frozen))
        except Exception as error:
            return f"{len(ids)} drones in the view: raises {type(error).__name__}: {error}"
        if directives:
            return f"{len(ids)} drones in the view: {len(directives)} directives, must be none"
    return None


def _accepts_stale_views(policy: Policy, view: FleetView) -> str | None:
    stale = view._replace(age_s=dict.fromkeys(view.age_s, _STALE_PERIODS * view.period_s))
    try:
        check_directives(policy(stale.frozen), stale)
    except Exception as error:
        return f"every descriptor {_STALE_PERIODS:g} periods old: {type(error).__name__}: {error}"
    return None


def _age_monotone(policy: Policy, view: FleetView) -> str | None:
    decide(policy, view)
    return only_falls_with_age(partial(decide, policy), RepeatableView(view))


def _ignores_the_clock(policy: Policy, view: FleetView) -> str | None:
    """Stamps are the publishers' clocks; how old a descriptor is, `age_s` says."""
    later = {i: d._replace(stamp_ns=d.stamp_ns + _LATER_NS) for i, d in view.descriptors.items()}
    if by_peer(decide(policy, view)) == by_peer(decide(policy, view._replace(descriptors=later))):
        return None
    return f"decides otherwise when the sortie is {_LATER_NS * 1e-9:g} s older and nothing else differs"


def _keeps_no_memory(policy: Policy, view: FleetView) -> str | None:
    """After many decisions it decides as it does from the file loaded anew."""
    anew = with_function(policy, _loaded_anew)
    if as_tuples(decide(policy, view)) == as_tuples(decide(anew, view)):
        return None
    return "the same view gets other directives from the file loaded anew"


def _loaded_anew(function: Guarded) -> Policy:
    if function.source is None:
        return function
    return Guarded(getattr(load(function.source.file), function.source.name), function.source)


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
    """A viewpoint keeps the same rules: bounds, input unchanged, deterministic, any order of drones."""
    viewpoint = viewpoint_of(policy)
    if viewpoint is None:
        decide(policy, view)
        return None
    shown, ids = copied(view), list(view.descriptors)
    request = viewpoint(shown)
    check_reposition(request, view)
    if shown != view:
        return "its viewpoint changed its input"
    if viewpoint(copied(view)) != request:
        return "its viewpoint: two calls with the same view differ"
    if viewpoint(_with_drones(view, ids[::-1])) != request:
        return "its viewpoint: drones in another order get another place"
    for few in ([i for i in ids if i == view.ego], []):
        fewer = _with_drones(view, few)
        check_reposition(viewpoint(fewer), fewer)
    return None


def _raising(rule: OnView, begin: str = "") -> OnView:
    """A rule of which an error is a complaint."""

    def complaint(policy: Policy, view: FleetView) -> str | None:
        try:
            return rule(policy, view)
        except NotJudged:
            raise
        except PolicyError as error:
            return str(error)
        except Exception as error:
            return f"{begin}raises {type(error).__name__}: {error}"

    return complaint


RULES: dict[str, Rule] = {
    "returns directives": Rule("must", "it returns a list or a tuple", _raising(_returns_a_sequence)),
    "bounds kept": Rule("must", "every field is of its type and within its bounds", _raising(_keeps_bounds)),
    "one directive per link": Rule("must", "each peer has one directive", lambda p, v: missing_links(decide(p, v), v)),
    "gives reasons": Rule("must", "each directive has a reason", _gives_reasons),
    "input unchanged": Rule("must", "the view stays as it is", _keeps_its_input),
    "deterministic": Rule("must", "the same view gets the same answer, after another view too", _is_deterministic),
    "order of drones irrelevant": Rule("must", "their order in the view changes nothing", _order_is_irrelevant),
    "one drone and empty views": Rule("must", "without peers it returns no directives", _accepts_small_views),
    "stale views": Rule("must", "it decides when all descriptors are old", _accepts_stale_views),
    "age-monotone": Rule("must", "older descriptors raise nothing", _age_monotone, MANY_DECISIONS),
    "maps within one network": Rule("must", "maps go where they can be fused", _sends_maps_where_they_are_fused),
    "budget kept": Rule("must", "the fleet keeps each budget that it takes", _keeps_budget, ALL_EGOS),
    "viewpoint kept": Rule(
        "must", "its viewpoint keeps the same rules", _raising(_viewpoint_keeps_rules, "its viewpoint ")
    ),
    "no memory": Rule("must", "the file loaded anew decides the same", _keeps_no_memory, LOADS_ANEW),
    "clock irrelevant": Rule("unusual", "the time since the sortie began changes nothing", _ignores_the_clock),
}
"""The kit's rules by name. A policy without a parameter of `_SPENT` always keeps `budget kept`."""


def copied(view: FleetView) -> FleetView:
    """The view with new mappings; everything in them is immutable."""
    return view._replace(descriptors=dict(view.descriptors), age_s=dict(view.age_s))


def _with_drones(view: FleetView, ids: Sequence[int]) -> FleetView:
    """The view with these of its drones, in this order."""
    descriptors: Mapping[int, Descriptor] = {i: view.descriptors[i] for i in ids}
    return view._replace(descriptors=descriptors, age_s={i: view.age_s[i] for i in ids})


def as_tuples(directives: Iterable[Directive]) -> list[tuple[object, ...]]:
    """The directives with their reasons, which `==` ignores."""
    return [tuple(d) for d in directives]
