"""The conformance kit: rules that every policy must keep, each tested on drawn views. No policy is exempt.

    checks = conform(my_policy)
    assert all(c.holds for c in checks)

A check that fails has the smallest failing view that was found. Two rules are no test of one view: no memory, and the time
of a decision.
"""

from __future__ import annotations

import contextlib
import random
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

from sortie.policies.checks import check_directives, check_reposition, find_wrong_type
from sortie.policies.contract import Descriptor, Directive, FleetView, Policy, PolicyError, Representation
from sortie.policies.geometry import rank_loop
from sortie.policies.registry import parameters, viewpoint_of
from sortie.policies.verification.budget import Budget
from sortie.policies.verification.invariants.language import by_peer, just_heard, listed
from sortie.policies.verification.kit.age_rule import older_views, raised_part, without_detached
from sortie.policies.verification.kit.views import draw_view, draw_views, shrink
from sortie.policies.verification.subject import with_function
from sortie.scenarios.plugins.user_calls import Guarded, text_of
from sortie.scenarios.plugins.user_code import load

VIEWS, LONG_VIEWS = 300, 100
SHRINK_VIEWS = 1000
"""So many smaller views are tried at most, for all rules together, to make failing ones smaller."""
DECISION_LIMIT_S = 0.010
"""A tenth of a frame at 10 Hz, at 20 drones. The limit is generous, because machines differ; the time is reported."""
SHUFFLED = 100
"""How many of the views are decided twice, in two orders."""
TIMED = 50
"""How many decisions are timed at each size."""
BUDGETS = (0.02, 0.25, 1.0)
_STALE_PERIODS = 20.0  # beyond the plane's ten, at which a peer is detached
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Check:
    """The verdict of one rule on one policy or model."""

    name: str
    holds: bool
    what: str
    """The complaint if the rule fails, otherwise what was tested."""
    counterexample: FleetView | None = None
    """The smallest failing view found; None if the rule holds or needs no view."""
    unfinished: bool = False
    """Whether nothing failed, but fewer views than promised were tried."""


Rule = Callable[[Policy, FleetView], str | None]
"""Tests a policy on one view. Returns a complaint, or None if the policy keeps the rule."""


class NoDirectives(Exception):
    """The policy itself raised, or returned no directives. Only the rules `returns directives` and `bounds kept` report it."""


def conform(
    policy: Policy, views: Iterable[FleetView] | None = None, *, seed: int = 0, count: int = VIEWS
) -> list[Check]:
    """Check a policy against every rule of the kit.

    Args:
        policy: any callable of the contract. The keyword parameters `rho`, `sent_budget` and `received_budget` limit its cells.
        views: the views to test it on; without them, the first `count` views of `seed`.
        seed: of the drawn views.
        count: how many; rules that take many decisions a view are tried on the first `LONG_VIEWS` of them.

    Returns:
        One check for each rule, always in the same order. A rule that no view could check does not hold.
    """
    tried = list(draw_views(seed, count) if views is None else views)
    rank_loop()  # compiled before anything is measured
    budget = Budget(SHRINK_VIEWS)
    some = tried[:LONG_VIEWS] if views is None else tried
    checks = [_check_rule(n, rule, policy, some if n in _LONG else tried, budget) for n, rule in RULES.items()]
    return [*checks, _keeps_no_memory(policy, tried), _decides_in_time(policy)]


def failing(checks: Sequence[Check]) -> list[Check]:
    """The checks of rules that are broken."""
    return [c for c in checks if not c.holds and not c.unfinished]


def _check_rule(name: str, rule: Rule, policy: Policy, views: Sequence[FleetView], budget: Budget) -> Check:
    def complaint(view: FleetView) -> str | None:
        budget.spend()
        try:
            return rule(policy, copied(view))
        except NoDirectives:
            return None

    judged = 0
    for view in views:
        try:
            found = rule(policy, copied(view))
        except NoDirectives:
            continue
        judged += 1
        if found is not None:
            small = shrink(view, lambda v: not budget.is_spent and complaint(v) is not None)
            return Check(name, False, complaint(small) or found, small)
    return Check(
        name,
        judged > 0,
        f"{judged} views" if judged else "no view could be checked: see returns directives, bounds kept",
    )


def _keeps_no_memory(policy: Policy, views: Sequence[FleetView]) -> Check:
    """The same answers in another order of the views, and from the file loaded anew."""
    name = "no memory"
    few = [v.frozen for v in views[:SHUFFLED]]
    try:
        first = [as_tuples(decide(policy, view)) for view in few]
        order = list(range(len(first)))
        random.Random(len(first)).shuffle(order)  # noqa: S311
        anew = with_function(policy, _loaded_anew)
        for instance, what in ((policy, "after other views"), (anew, "from the file loaded anew")):
            for k in order:
                if as_tuples(decide(instance, few[k])) != first[k]:
                    return Check(name, False, f"the same view gets other directives {what}", few[k])
    except NoDirectives:
        return Check(name, False, "no view could be checked: see returns directives, bounds kept")
    return Check(name, True, f"{len(first)} views in two orders, and from the file loaded anew")


def _loaded_anew(function: Guarded) -> Policy:
    if function.source is None:
        return function
    return Guarded(getattr(load(function.source.file), function.source.name), function.source)


def _decides_in_time(policy: Policy) -> Check:
    """CPU time of the fastest decision, at 5 and at 20 drones: other programs make decisions slower, and none faster."""
    name, took_s = "time per decision", {}
    for drones in (5, 20):
        view = full_view(drones)
        try:
            for _ in range(3):
                policy(view)
            marks_ns = [time.thread_time_ns()]
            for _ in range(TIMED):
                policy(view)
                marks_ns.append(time.thread_time_ns())
                if marks_ns[-1] - marks_ns[0] > 1e9 * TIMED * DECISION_LIMIT_S * 2:  # too slow in any case
                    break
        except Exception as error:
            return Check(name, False, f"raises {type(error).__name__}: {text_of(error, str)}", view)
        took_s[drones] = min(b - a for a, b in pairwise(marks_ns)) * 1e-9
    what = ", ".join(f"{s * 1e6:.0f} µs at {n} drones" for n, s in took_s.items())
    slow = took_s[20] > DECISION_LIMIT_S
    return Check(name, not slow, what + (f", must be at most {DECISION_LIMIT_S * 1e3:g} ms" if slow else ""))


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
        raise NoDirectives from error
    if type(answer) not in (list, tuple) or any(find_wrong_type(d) is not None for d in answer):
        raise NoDirectives
    return list(answer)


def _returns_a_sequence(policy: Policy, view: FleetView) -> str | None:
    answer = policy(view.frozen)
    kind = type(answer)
    return None if kind in (list, tuple) else f"returns {kind.__name__}, must be a list or a tuple of directives"


def _keeps_bounds(policy: Policy, view: FleetView) -> str | None:
    try:
        answer = policy(view.frozen)
    except Exception as error:
        raise NoDirectives from error
    check_directives(answer, view)
    return None


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
            return f"{len(ids)} drones in the view: raises {type(error).__name__}: {text_of(error, str)}"
        if directives:
            return f"{len(ids)} drones in the view: {len(directives)} directives, must be none"
    return None


def _accepts_stale_views(policy: Policy, view: FleetView) -> str | None:
    stale = view._replace(age_s=dict.fromkeys(view.age_s, _STALE_PERIODS * view.period_s))
    try:
        check_directives(policy(stale.frozen), stale)
    except Exception as error:
        return f"every descriptor {_STALE_PERIODS:g} periods old: {type(error).__name__}: {text_of(error, str)}"
    return None


def _age_monotone(policy: Policy, view: FleetView) -> str | None:
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


def _raising(rule: Rule, begin: str = "") -> Rule:
    """A rule of which an error is a complaint."""

    def complaint(policy: Policy, view: FleetView) -> str | None:
        try:
            return rule(policy, view)
        except NoDirectives:
            raise
        except PolicyError as error:
            return str(error)
        except Exception as error:
            return f"{begin}raises {type(error).__name__}: {text_of(error, str)}"

    return complaint


RULES: dict[str, Rule] = {
    "returns directives": _raising(_returns_a_sequence),
    "bounds kept": _raising(_keeps_bounds),
    "one directive per link": lambda policy, view: missing_links(decide(policy, view), view),
    "gives reasons": _gives_reasons,
    "input unchanged": _keeps_its_input,
    "deterministic": _is_deterministic,
    "order of drones irrelevant": _order_is_irrelevant,
    "one drone and empty views": _accepts_small_views,
    "stale views": _accepts_stale_views,
    "age-monotone": _age_monotone,
    "maps within one network": _sends_maps_where_they_are_fused,
    "budget kept": _keeps_budget,
    "viewpoint kept": _raising(_viewpoint_keeps_rules, "its viewpoint "),
}
"""The kit's rules by name. A policy without a parameter of `_SPENT` always keeps `budget kept`."""


_LONG = ("age-monotone", "budget kept")
"""Rules that take many decisions a view."""


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
