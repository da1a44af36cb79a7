"""The conformance kit: rules that every policy must keep, tested on drawn views. No policy is exempt.

    checks = conform(my_policy)
    assert all(c.holds for c in checks)

`policy_rules` has the rules that need one view at a time. Two rules are here: no memory, which needs many views, and the
time of a decision. A check that fails has the smallest failing view that was found.
"""

from __future__ import annotations

import random
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from sortie.policies.contract import FleetView, Policy
from sortie.policies.verification.policy_rules import RULES, NoDirectives, Rule, as_tuples, copied, decide
from sortie.policies.verification.search import BUDGET_S, LEAST_VIEWS, Budget, drawn_budget
from sortie.policies.verification.subject import with_function
from sortie.policies.verification.views import draw_views, shrink
from sortie.scenarios.plugins.user_calls import Guarded, text_of
from sortie.scenarios.plugins.user_code import load

VIEWS = 300
DECISION_LIMIT_S = 0.010
"""A tenth of a frame at 10 Hz, at 20 drones. The limit is generous, because machines differ; the time is reported."""
SHUFFLED = 100
"""How many of the views are decided twice, in two orders."""
TIMED = 50
"""How many decisions are timed at each size."""
LEAST_TIMED = 10
"""So many of them are timed however long they take."""


@dataclass(frozen=True, slots=True)
class Check:
    """The verdict of one rule on one policy."""

    name: str
    holds: bool
    what: str
    """The complaint if the rule fails, otherwise what was tested."""
    counterexample: FleetView | None = None
    """The smallest failing view found; None if the rule holds or needs no view."""


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
            return rule(policy, copied(view))
        except NoDirectives:
            return None

    judged, of_all = 0, ""
    for number, view in enumerate(views):
        if number >= LEAST_VIEWS and budget.is_spent:
            of_all = _of(len(views))
            break
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
        f"{judged}{of_all} views" if judged else "no view could be checked: see returns directives, bounds kept",
    )


def _of(count: int) -> str:
    """Of how many views or decisions the time allowed fewer."""
    return f" of {count}"


def _keeps_no_memory(policy: Policy, views: Sequence[FleetView], budget: Budget) -> Check:
    """The same answers in another order of the views, and from the file loaded anew."""
    name = "no memory"
    few = [v.frozen for v in views[:SHUFFLED]]
    try:
        first: list[list[tuple[object, ...]]] = []
        for view in few:
            if len(first) >= LEAST_VIEWS and budget.is_spent:
                break
            first.append(as_tuples(decide(policy, view)))
        order = list(range(len(first)))
        random.Random(len(first)).shuffle(order)  # noqa: S311
        for instance, what in (
            (policy, "after other views"),
            (with_function(policy, _loaded_anew), "from the file loaded anew"),
        ):
            for k in order:
                if as_tuples(decide(instance, few[k])) != first[k]:
                    return Check(name, False, f"the same view gets other directives {what}", few[k])
    except NoDirectives:
        return Check(name, False, "no view could be checked: see returns directives, bounds kept")
    of_all = _of(len(few)) if len(first) < len(few) else ""
    return Check(name, True, f"{len(first)}{of_all} views in two orders, and from the file loaded anew")


def _loaded_anew(function: Guarded) -> Policy:
    if function.source is None:
        return function
    return Guarded(getattr(load(function.source.file), function.source.name), function.source)


def _decides_in_time(policy: Policy, budget: Budget) -> Check:
    """CPU time of the fastest decision, at 5 and at 20 drones: other programs make decisions slower, and none faster."""
    name, took_s, timed = "time per decision", {}, 0
    for drones in (5, 20):
        view = full_view(drones)
        try:
            for _ in range(3):
                policy(view)
            marks_ns = [time.thread_time_ns()]
            for _ in range(TIMED):
                if len(marks_ns) > LEAST_TIMED and budget.is_spent:
                    break
                policy(view)
                marks_ns.append(time.thread_time_ns())
        except Exception as error:
            return Check(name, False, f"raises {type(error).__name__}: {text_of(error, str)}", view)
        took_s[drones] = min(b - a for a, b in pairwise(marks_ns)) * 1e-9
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
