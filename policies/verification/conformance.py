"""The conformance kit: rules that every policy must keep, tested on drawn views. No policy is exempt.

    checks = conform(my_policy)
    assert all(c.holds for c in checks)

A rule is a function of a policy and a view. It returns a complaint, or None if the policy keeps the rule. A check that
fails has the smallest failing view that was found.
"""

from __future__ import annotations

import contextlib
import functools
import random
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

from sortie.policies.checks import check_directives, check_reposition, find_wrong_type
from sortie.policies.contract import Descriptor, Directive, FleetView, Policy, PolicyError, Representation
from sortie.policies.registry import parameters, viewpoint_of
from sortie.policies.verification.confine import Reached, confined
from sortie.policies.verification.invariants import just_heard
from sortie.policies.verification.search import BUDGET_S, LEAST_VIEWS, Budget, drawn_budget
from sortie.policies.verification.subject import searchable
from sortie.policies.verification.symbols import Refused
from sortie.policies.verification.views import draw_view, draw_views, shrink
from sortie.scenarios.plugins.user_calls import Guarded, guarded, text_of
from sortie.scenarios.plugins.user_code import load

VIEWS = 300
BUDGETS = (0.02, 0.25, 1.0)
DECISION_LIMIT_S = 0.010
"""A tenth of a frame at 10 Hz, at 20 drones. The limit is generous, because machines differ; the time is reported."""
SHUFFLED = 100
"""How many of the views are decided twice, in two orders."""
TIMED = 50
"""How many decisions are timed at each size."""
_STALE_PERIODS = 20.0  # beyond the plane's ten, at which a peer is detached
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Check:
    """The verdict of one rule on one policy."""

    name: str
    holds: bool
    what: str
    """The complaint if the rule fails, otherwise what was tested."""
    counterexample: FleetView | None = None
    """The smallest failing view found; None if the rule holds or needs no view."""


Rule = Callable[[Policy, FleetView], str | None]


class _Raised(Exception):
    """The policy itself raised, or returned no directives. Only the rules `returns directives` and `bounds kept` report it."""


def conform(
    policy: Policy,
    views: Iterable[FleetView] | None = None,
    *,
    seed: int = 0,
    count: int = VIEWS,
    budget_s: float = BUDGET_S,
) -> list[Check]:
    """Check a policy against every rule of the kit.

    Args:
        policy: any callable of the contract. The keyword parameters `rho`, `sent_budget` and `received_budget` limit its cells.
        views: the views to test it on; without them, the first `count` views of `seed`.
        seed: of the drawn views.
        count: how many.
        budget_s: wall-clock time for all rules together, at least `LEAST_DRAWN_S`. Each rule gets a share.

    Returns:
        One check for each rule, always in the same order. A rule that no view could check does not hold. Where the time
        ended, the check names the number of views.
    """
    tried = list(draw_views(seed, count) if views is None else views)
    # no memory decides three times on each view
    *of_rules, of_memory, _, _, of_timing = drawn_budget(budget_s).shares(len(RULES) + 4)
    rules = zip(RULES.items(), of_rules, strict=True)
    checks = [_check_rule(name, rule, policy, tried, budget) for (name, rule), budget in rules]
    return [*checks, _keeps_no_memory(policy, tried, of_memory), _decides_in_time(policy, of_timing)]


def failing(checks: Sequence[Check]) -> list[Check]:
    """The checks that do not hold."""
    return [c for c in checks if not c.holds]


def _check_rule(name: str, rule: Rule, policy: Policy, views: Sequence[FleetView], budget: Budget) -> Check:
    def complaint(view: FleetView) -> str | None:
        try:
            return rule(policy, _copied(view))
        except _Raised:
            return None

    judged, of_all = 0, ""
    for number, view in enumerate(views):
        if number >= LEAST_VIEWS and budget.is_spent:
            of_all = _of(len(views))
            break
        try:
            found = rule(policy, _copied(view))
        except _Raised:
            continue
        judged += 1
        if found is not None:
            small = shrink(view, lambda v: not budget.is_spent and complaint(v) is not None)
            return Check(name, False, complaint(small) or found, small)
    return Check(
        name,
        judged > 0,
        f"{judged}{of_all} views" if judged else "no view could be checked: see returns directives, bounds kept",
    )


def _of(count: int) -> str:
    """Of how many views or decisions the time allowed fewer."""
    return f" of {count}"


# --- the rules -----------------------------------------------------------------------------------


def _decide(policy: Policy, view: FleetView) -> list[Directive]:
    """The policy's directives for a copy of the view, so that a policy that changes its input affects no other rule."""
    directives = _decide_unchecked(policy, view)
    if any(find_wrong_type(d) is not None for d in directives):
        raise _Raised
    return directives


def _decide_unchecked(policy: Policy, view: FleetView) -> list[Directive]:
    """The same, without a check of the directives' types."""
    try:
        answer = policy(view.frozen)
    except Exception as error:
        raise _Raised from error
    if type(answer) not in (list, tuple):
        raise _Raised
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
        raise _Raised from error
    try:
        check_directives(answer, view)
    except PolicyError as error:
        return str(error)
    return None


def _one_directive_per_link(policy: Policy, view: FleetView) -> str | None:
    return missing_links(_decide(policy, view), view)


def missing_links(directives: Iterable[Directive], view: FleetView) -> str | None:
    """A complaint if the directives are not exactly one for each peer."""
    decided, peers = sorted(d.destination for d in directives), list(view.peers)
    return None if decided == peers else f"directives for {decided}, must be for each of {peers}"


def _gives_reasons(policy: Policy, view: FleetView) -> str | None:
    silent = [f"{d.source}→{d.destination}" for d in _decide(policy, view) if not d.reason]
    return f"no reason given for {', '.join(silent)}" if silent else None


def _keeps_its_input(policy: Policy, view: FleetView) -> str | None:
    before = _copied(view)
    with contextlib.suppress(Exception):  # a policy that raises may have changed its input before
        policy(view)
    if view == before and list(view.descriptors) == list(before.descriptors) and list(view.age_s) == list(before.age_s):
        return None
    changed = [n for n in ("descriptors", "age_s") if getattr(view, n) != getattr(before, n)]
    return f"the policy changed its input: {', '.join(changed) or 'the order of drones'}"


def _is_deterministic(policy: Policy, view: FleetView) -> str | None:
    first = _as_tuples(_decide(policy, view))
    if _as_tuples(_decide(policy, view)) != first:
        return "two calls with the same view differ"
    _decide(policy, draw_view(1, 0))
    return None if _as_tuples(_decide(policy, view)) == first else "differs after another view: it has a memory"


def _reads_only_its_view(policy: Policy, view: FleetView) -> str | None:
    usual = _as_tuples(_decide(policy, view))
    try:
        try:
            alone = _as_tuples(_decide(_alone(policy), view))  # type: ignore[arg-type]
        except Refused:  # here it goes where no search can follow
            alone = _as_tuples(_decide(confined(policy), view))
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


def _keeps_no_memory(policy: Policy, views: Sequence[FleetView], budget: Budget) -> Check:
    """The same answers in another order of the views, and from the file loaded anew."""
    name = "no memory"
    few = [v.frozen for v in views[:SHUFFLED]]
    try:
        first: list[list[tuple[object, ...]]] = []
        for view in few:
            if len(first) >= LEAST_VIEWS and budget.is_spent:
                break
            first.append(_as_tuples(_decide(policy, view)))
        order = list(range(len(first)))
        random.Random(len(first)).shuffle(order)  # noqa: S311
        for instance, what in ((policy, "after other views"), (_loaded_anew(policy), "from the file loaded anew")):
            for k in order:
                if _as_tuples(_decide(instance, few[k])) != first[k]:
                    return Check(name, False, f"the same view gets other directives {what}", few[k])
    except _Raised:
        return Check(name, False, "no view could be checked: see returns directives, bounds kept")
    of_all = _of(len(few)) if len(first) < len(few) else ""
    return Check(name, True, f"{len(first)}{of_all} views in two orders, and from the file loaded anew")


def _loaded_anew(policy: Policy) -> Policy:
    if isinstance(policy, partial):
        return partial(_loaded_anew(policy.func), *policy.args, **policy.keywords)
    if isinstance(policy, Guarded) and policy.source is not None:
        fresh: Policy = getattr(load(policy.source.file), policy.source.name)
        return Guarded(fresh, policy.source)
    return policy


def _order_is_irrelevant(policy: Policy, view: FleetView) -> str | None:
    usual = _by_peer(_decide(policy, view))
    ids = list(view.descriptors)
    for order in (ids[::-1], sorted(ids), ids[1:] + ids[:1]):
        other = view._replace(
            descriptors={i: view.descriptors[i] for i in order}, age_s={i: view.age_s[i] for i in order}
        )
        if _by_peer(_decide(policy, other)) != usual:
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
    before = _decide(policy, view)
    for who, add_s, older in older_views(view):
        raised = raised_part(before, _decide(policy, older), _decide(policy, without_detached(view, older)))
        if raised is not None:
            return f"drone {', '.join(map(str, who))} {add_s:g} s older: {raised}"
    return None


def older_views(view: FleetView) -> Iterator[tuple[tuple[int, ...], float, FleetView]]:
    """Views in which one descriptor, or all, are older: whose age is raised, by how many seconds, and the view."""
    for periods in (1.0, 3.5, 10.5, 1000.0):
        add_s = periods * view.period_s
        for who in [*((i,) for i in view.age_s), tuple(view.age_s)]:
            yield who, add_s, view._replace(age_s={i: a + add_s * (i in who) for i, a in view.age_s.items()})


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
    usual, instead = _by_peer(before), _by_peer(without)
    for d in after:
        raised = _rise(usual.get(d.destination), d)
        if raised and (d.destination not in instead or _rise(instead[d.destination], d)):
            return f"directive {d.source}→{d.destination}: {raised}"
    return None


def _rise(old: Directive | None, d: Directive) -> str | None:
    """In what a directive is higher than the one before."""
    if old is None:
        return "there was none before" if d.representation > 0 else None
    if d.representation > old.representation:
        return f"representation rises from {old.representation:d} to {d.representation:d}"
    if d.representation == old.representation and d.rho > old.rho:
        return f"rho rises from {old.rho} to {d.rho}"
    if d.rate_hz > old.rate_hz:
        return f"rate_hz rises from {old.rate_hz} to {d.rate_hz}"
    return None


_SENDS_BOXES = "put @sortie.boxes_across_networks above the policy, which sends boxes there"


def _sends_maps_where_they_are_fused(policy: Policy, view: FleetView) -> str | None:
    """A drone with another network cannot fuse the ego's feature maps, so their bytes would be spent in vain."""
    for d in _decide(policy, view):
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
                for d in _decide(bound, view._replace(ego=ego)):
                    maps[whose(d)] += d.rho  # type: ignore[assignment]  # a counter of maps, not whole ones
            allowed = budget * (view.full_sharing_maps if full_maps else 1)
            for who, spent in maps.items():
                if not spent <= allowed * (1 + _ROUNDING):
                    return f"{name}={budget:g}: {who} {spent:g} maps, at most {allowed:g} is allowed"
    _decide(policy, view)
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
        _decide(policy, view)
        return None
    shown, alone = _copied(view), {i: d for i, d in view.descriptors.items() if i == view.ego}
    try:
        request = viewpoint(shown)
        check_reposition(request, view)
        if shown != view:
            return "its viewpoint changed its input"
        others = {
            "two calls with the same view differ": viewpoint(_copied(view)),
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


def _decides_in_time(policy: Policy, budget: Budget) -> Check:
    """Median CPU time of a decision, at 5 and at 20 drones."""
    name, took_s, timed = "time per decision", {}, 0
    for drones in (5, 20):
        view = full_view(drones)
        try:
            for _ in range(3):
                policy(view)
            marks_ns = [time.thread_time_ns()]
            for _ in range(TIMED):
                if len(marks_ns) > 1 and budget.is_spent:
                    break
                policy(view)
                marks_ns.append(time.thread_time_ns())
        except Exception as error:
            return Check(name, False, f"raises {type(error).__name__}: {text_of(error, str)}", view)
        took_s[drones] = statistics.median(b - a for a, b in pairwise(marks_ns)) * 1e-9
        timed += len(marks_ns) - 1
    what = ", ".join(f"{s * 1e6:.0f} µs at {n} drones" for n, s in took_s.items())
    what += "" if timed == 2 * TIMED else f", {timed}{_of(2 * TIMED)} decisions"
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


def _copied(view: FleetView) -> FleetView:
    """The view with new mappings; everything in them is immutable."""
    return view._replace(descriptors=dict(view.descriptors), age_s=dict(view.age_s))


def _as_tuples(directives: Iterable[Directive]) -> list[tuple[object, ...]]:
    return [tuple(d) for d in directives]  # with the reasons, which `==` ignores


def _by_peer(directives: Iterable[Directive]) -> dict[int, Directive]:
    return {d.destination: d for d in directives}
