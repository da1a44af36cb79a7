"""A shield: wraps a policy so that it keeps its invariants at run time, and reports each intervention.

    decide = shield(worked, parse("when battery < 0.3: rate_hz <= 1"))

A directive that breaks an invariant is replaced by the nearest one that keeps them all. Its reason then begins with
"shield:", so the record shows each intervention and `interventions` counts them. Nearest means: fewest fields changed,
then the smallest change. A step of representation counts as a quarter, a number as a share of its bounds. A condition
on the directive itself is made false only where nothing else helps. A line `within T s: …` is kept at once.

In flight the shield acts twice: here, on the policy's output, and at the gate, on what the staleness rules and damping
left of it (`policies.verification.enforced`). There a limit keeps it from giving a link more than its age allows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from sortie.policies.checks import check_directives
from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, FleetView, Policy, Representation
from sortie.policies.verification.compiled import Context, Rule, compiled
from sortie.policies.verification.invariants import Invariant, InvariantError, LinksTerm, Recent, just_heard
from sortie.policies.verification.nearest import Box, Far, distance, nearest
from sortie.policies.verification.words import CHANGES
from sortie.scenarios.representation import LEVELS, NAME_OF

MARK = "shield: "
Cap = Callable[[Directive], Directive]
"""A directive as far as something allows it, such as the age of its peer's descriptor."""
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


def enforce(
    rules: Sequence[Invariant],
    view: FleetView,
    decided: Sequence[Directive],
    fresh: Sequence[Directive] = (),
    cap: Cap | None = None,
) -> list[Directive]:
    """The directives; those that break a rule are replaced by the nearest ones that keep all rules.

    Args:
        rules: the invariants.
        view: the policy's input.
        decided: its output.
        fresh: its output at age 0, if a rule needs it.
        cap: gives a directive as far as it is allowed; None allows all.
    """
    me, directives = view.me, list(decided)
    if me is None or not rules or not directives:
        return directives
    context = Context(view, me, directives, {d.destination: d for d in fresh})
    lines = [compiled(rule) for rule in rules]
    boxes = _Boxes([line for line in lines if line.of_link], context, directives[0], cap)
    solved: dict[Any, Directive | None] = {}
    for k, directive in enumerate(directives):
        box = boxes.of(directive)
        broken = box.broken(context, directive)
        if not broken:
            continue
        within = boxes.capped(directive, box)
        key = _key(directive, within)
        if key is None or key not in solved:
            after = nearest(directive, within, (), context, boxes.allowed)
            if key is not None:
                solved[key] = after
        else:
            after = solved[key]
        lost = [box.rules[i].invariant for i in sorted(set(broken))]
        directives[k] = _not_replaced(directive, lost) if after is None else _replaced(directive, after, lost)
    for line in lines:
        if not line.of_link and not line.holds(context, directives[0]):
            _replace_one_link(context, directives, line, boxes)
    return directives


def _key(directive: Directive, box: Box) -> Any:
    """What two directives have in common that are corrected alike; None if nothing can be said."""
    if not box.shared:
        return None
    _, _, rung, rho, roi, rate_hz, deadline_s, weight, duty, _ = directive
    for x in (rung, rho, rate_hz, deadline_s, weight, duty):
        if type(x) not in _PLAIN:
            return None
    return id(box), rung, rho, id(roi), rate_hz, deadline_s, weight, duty


_PLAIN = (float, int, Representation)


class _Boxes:
    """What the lines about links allow each link. Links to which the same lines apply share a box."""

    def __init__(self, lines: Sequence[Rule], context: Context, some: Directive, cap: Cap | None) -> None:
        self._lines = [r for r in lines if r.when is None or r.when_of_peer or r.when(context, some)]
        self._asked = [r.when for r in self._lines if r.when is not None and r.when_of_peer]
        self._context, self._some, self._cap = context, some, cap
        self._boxes: dict[Any, Box] = {}

    def of(self, link: Directive) -> Box:
        """The box of a link."""
        context = self._context
        return self._box(tuple([bool(when(context, link)) for when in self._asked]), None)

    def capped(self, link: Directive, box: Box) -> Box:
        """The link's box within what it is allowed at most."""
        if self._cap is None:
            return box
        most = self._cap(_FULLEST._replace(source=link.source, destination=link.destination))
        return self._box(box.applies, (most.representation, most.rate_hz))

    def _box(self, applies: tuple[bool, ...], most: tuple[Representation, float] | None) -> Box:
        key = applies, most
        if key not in self._boxes:
            answers = iter(applies)
            rules = [r for r in self._lines if not (r.when is not None and r.when_of_peer) or next(answers)]
            bounds = None if most is None else {"representation": float(LEVELS[most[0]]), "rate_hz": most[1]}
            self._boxes[key] = Box(rules, applies, self._context, self._some, bounds)
        return self._boxes[key]

    def allowed(self, directive: Directive) -> bool:
        """Whether a directive may replace another one."""
        return self._cap is None or self._cap(directive) == directive


_FULLEST = Directive(-1, -1, Representation.RAW, rho=1.0, rate_hz=DIRECTIVE_BOUNDS["rate_hz"].high)


def _replace_one_link(context: Context, directives: list[Directive], rule: Rule, boxes: _Boxes) -> None:
    """Change one link, by the smallest change of any, so that a rule about all links holds.

    Args:
        context: has these same directives.
        rule: the rule, which is broken.
        boxes: what the rules about links allow.
    """
    best: tuple[Far, int, Directive] | None = None
    alike, seen = not any(part.of_peer for part in rule.parts), set()
    for k, before in enumerate(directives):
        box = boxes.capped(before, boxes.of(before))
        key = _key(before, box) if alike else None
        if key is not None and key in seen:
            continue  # another link would change by as much
        seen.add(key)
        nearer = None if best is None else best[0]
        after = nearest(before, box, rule.parts, context, boxes.allowed, nearer)
        if after is None:
            continue
        changed, far = distance(before, after)
        if (
            nearer is None or (changed, round(far, 2)) < nearer
        ):  # a hundredth of the bounds is no reason for another link
            best = (changed, round(far, 2)), k, after
    if best is None:
        directives[:] = [_not_replaced(d, [rule.invariant]) for d in directives]
    else:
        _, k, after = best
        directives[k] = _replaced(directives[k], after, [rule.invariant])


def _replaced(before: Directive, after: Directive, broken: Sequence[Invariant]) -> Directive:
    because = "; ".join([rule.text for rule in broken])
    was = f"{NAME_OF[before.representation]} at {before.rate_hz:g} Hz"
    return after._replace(destination=before.destination, reason=f"{MARK}{because} (decided {was}: {before.reason})")


def _not_replaced(before: Directive, broken: Sequence[Invariant]) -> Directive:
    note = f"{MARK}cannot keep {'; '.join(rule.text for rule in broken)} "
    return before if before.reason.startswith(note) else before._replace(reason=f"{note}({before.reason})")
