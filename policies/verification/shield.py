"""A shield: wraps a policy so that it keeps its invariants at run time, and reports each intervention.

    decide = shield(worked, parse("when battery < 0.3: rate_hz <= 1"))

A directive that breaks an invariant is replaced by the nearest one that keeps them all. Its reason then begins with
"shield:", so the record shows each intervention and `interventions` counts them. Nearest means: fewest fields changed,
then the smallest change. A step of representation counts as a quarter, a number as a share of its bounds. A line
`within T s: …` is kept at once.

In flight the shield acts twice: here, on the policy's output, and at the gate, on what the staleness rules and damping
left of it (`policies.verification.enforced`). There a limit keeps it from giving a link more than its age allows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, FleetView, Policy, Representation, check_directives
from sortie.policies.verification.compiled import Context, Part, Rule, compiled
from sortie.policies.verification.invariants import Invariant, InvariantError, LinksTerm, Recent, just_heard
from sortie.policies.verification.nearest import LEAST_RATE_HZ, distance, least_distance, nearest
from sortie.policies.verification.words import CHANGES
from sortie.scenarios.representation import NAME_OF

MARK = "shield: "
_NOT_SHIELDED = ("sum_links", "count_links", "every_link")


def shield(policy: Policy, invariants: Iterable[Invariant]) -> Policy:
    """A policy that decides as the given one but keeps the invariants. It is as pure; shielding it again changes nothing.

    An invariant may contradict another one, or depend on the view alone. If no change of one link keeps it, the
    directives stay as decided, and each one's reason states it.

    Raises:
        InvariantError: an invariant uses `sum_links` or `count_links`, so it does not determine the link to change;
            `every_link`, which means the same as its requirement alone; or counts a link's changes.
    """
    return Shielded(policy, check_shieldable(invariants))


class Shielded:
    """A shielded policy."""

    def __init__(self, policy: Policy, rules: tuple[Invariant, ...]) -> None:
        self.policy, self.rules = policy, rules
        self._asks_fresh = any(rule.needs_fresh for rule in rules)
        self.__name__ = f"{getattr(policy, '__name__', 'a policy')}, shielded"

    def __call__(self, view: FleetView, /) -> list[Directive]:
        """The policy's directives, those that break an invariant replaced.

        Raises:
            PolicyError: the policy returned something else than valid directives.
        """
        view = view.frozen  # nothing that the policy does to its view may reach the rules
        decided = self._checked(view)
        fresh = self._checked(just_heard(view)) if self._asks_fresh else ()
        return enforce(self.rules, view, decided, fresh)

    def _checked(self, view: FleetView) -> tuple[Directive, ...]:
        answer = self.policy(view)
        check_directives(answer, view)
        return tuple(answer)


def check_shieldable(invariants: Iterable[Invariant]) -> tuple[Invariant, ...]:
    """Check that a shield can keep these invariants, and return them.

    Raises:
        InvariantError: as `shield` does.
    """
    rules = tuple(invariants)
    for rule in rules:
        for node in rule.nodes:
            name = node.function if isinstance(node, LinksTerm) else node.change if isinstance(node, Recent) else ""
            if name in (*_NOT_SHIELDED, *CHANGES):
                raise InvariantError(
                    f"{rule.text!r}: a shield cannot keep {name}(…); `sortie verify` can only prove it"
                )
    return rules


def interventions(directives: Iterable[Directive]) -> int:
    """How many of a policy's directives a shield replaced."""
    return sum(d.reason.startswith(MARK) for d in directives)


def _anything(_: Directive) -> bool:
    return True


def enforce(
    rules: Sequence[Invariant],
    view: FleetView,
    decided: Sequence[Directive],
    fresh: Sequence[Directive] = (),
    allowed: Callable[[Directive], bool] = _anything,
) -> list[Directive]:
    """The directives; those that break a rule are replaced by the nearest ones that keep all rules.

    Args:
        rules: the invariants.
        view: the policy's input.
        decided: its output.
        fresh: its output at age 0, if a rule needs it.
        allowed: which directives may replace others.
    """
    me, directives = view.me, list(decided)
    if me is None or not rules:
        return directives
    context = Context(view, me, directives, {d.destination: d for d in fresh})
    lines = [compiled(rule) for rule in rules]
    of_link = _in_force([line for line in lines if line.invariant.of_link], context)
    # Links with equal directives under the same lines get the same correction, unless a line names the peer.
    shared = _is_shared(of_link)
    solved: dict[Any, tuple[Directive | None, list[Invariant]]] = {}
    for k, directive in enumerate(directives):
        if all(r.holds(context, directive) for r in of_link):
            continue
        applies = [r for r in of_link if r.when is None or r.when(context, directive)]
        key = _key(directive, applies, allowed) if shared else None
        if key is None or key not in solved:
            parts = [part for r in applies for part in r.parts]
            lost = [r.invariant for r in applies if not r.holds(context, directive)]
            found = nearest(directive, parts, of_link, context, allowed), lost
            if key is not None:
                solved[key] = found
        else:
            found = solved[key]
        after, lost = found
        if after is None:
            directives[k] = _not_replaced(directive, lost)
        else:
            directives[k] = _replaced(directive, after._replace(destination=directive.destination), lost)
    for line in lines:
        if not line.invariant.of_link and directives and not line.holds(context, directives[0]):
            _replace_one_link(context, directives, line, of_link, allowed)
    return directives


def _is_shared(lines: Sequence[Rule], more: Sequence[Part] = ()) -> bool:
    """Whether links with equal directives, to which the same lines apply, get the same correction."""
    parts = [*more, *(part for rule in lines for part in rule.parts if rule.invariant.of_link)]
    return not any(rule.when_mixed for rule in lines) and not any(part.of_peer for part in parts)


def _key(directive: Directive, applies: Sequence[Rule], allowed: Callable[[Directive], bool]) -> Any:
    """What two directives have in common if a shield corrects them alike; None if a number is not a plain one.

    What a link is allowed depends on the age of its peer: it is asked for the highest directive and for the lowest rung.
    """
    _, _, rung, rho, roi, rate_hz, deadline_s, weight, duty, _ = directive
    numbers = (rung, rho, rate_hz, deadline_s, weight, duty)
    if not all(type(x) in _PLAIN for x in numbers):
        return None
    if allowed is _anything:
        return (*numbers, id(roi), *map(id, applies))
    caps = [allowed(directive._replace(representation=r, rate_hz=hz, rho=0.0)) for r, hz in _PROBES]
    return (*numbers, id(roi), *map(id, applies), *caps)


_PROBES = (
    (Representation.RAW, DIRECTIVE_BOUNDS["rate_hz"].high),
    (Representation.DETECTIONS, LEAST_RATE_HZ),
    (Representation.NONE, 0.0),
)
_PLAIN = (float, int, Representation)


def _in_force(lines: Sequence[Rule], context: Context) -> list[Rule]:
    """The lines about links, without those that do not apply to any link now."""
    some = Directive(context.view.ego, context.view.ego)
    return [r for r in lines if r.when is None or r.when_of_link or r.when(context, some)]


def _replace_one_link(
    context: Context,
    directives: list[Directive],
    rule: Rule,
    of_link: Sequence[Rule],
    allowed: Callable[[Directive], bool],
) -> None:
    """Change one link, by the smallest change of any, so that a rule about all links holds.

    Args:
        context: has these same directives.
    """
    best: tuple[tuple[int, float], int, Directive] | None = None
    shared = bool(rule.any_link) and _is_shared([*of_link, rule], rule.any_link)
    seen = set()
    for k, before in enumerate(list(directives)):
        applies = [r for r in of_link if r.when is None or r.when(context, before)]
        key = _key(before, applies, allowed) if shared else None
        if key is not None:
            if key in seen or (best is not None and least_distance(before, rule.any_link, context) >= best[0]):
                continue
            seen.add(key)
        after = _one_link(context, directives, k, rule, applies, of_link, allowed)
        if after is None:
            continue
        changed, far = distance(before, after)
        if (
            best is None or (changed, round(far, 2)) < best[0]
        ):  # a hundredth of the bounds is no reason for another link
            best = (changed, round(far, 2)), k, after
    if best is None:
        directives[:] = [_not_replaced(d, [rule.invariant]) for d in directives]
    else:
        _, k, after = best
        directives[k] = _replaced(directives[k], after, [rule.invariant])


def _one_link(
    context: Context,
    directives: list[Directive],
    k: int,
    rule: Rule,
    applies: Sequence[Rule],
    of_link: Sequence[Rule],
    allowed: Callable[[Directive], bool],
) -> Directive | None:
    """The nearest directive for one link with which a rule about all links holds, and the rules about links too."""
    before = directives[k]
    parts = [part for r in applies for part in r.parts]
    if rule.any_link:
        return nearest(before, [*parts, *rule.any_link], of_link, context, allowed)

    def holds(after: Directive) -> bool:
        directives[k] = after
        kept = rule.holds(context, after)
        directives[k] = before
        return kept and allowed(after)

    return nearest(before, [*parts, *rule.parts], of_link, context, holds, only_all=rule)


def _replaced(before: Directive, after: Directive, broken: Sequence[Invariant]) -> Directive:
    because = "; ".join([rule.text for rule in broken])
    was = f"{NAME_OF[Representation(before.representation)]} at {before.rate_hz:g} Hz"
    return after._replace(reason=f"{MARK}{because} (decided {was}: {before.reason})")


def _not_replaced(before: Directive, broken: Sequence[Invariant]) -> Directive:
    note = f"{MARK}cannot keep {'; '.join(rule.text for rule in broken)} "
    return before if before.reason.startswith(note) else before._replace(reason=f"{note}({before.reason})")
