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

import heapq
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, cast

from sortie.policies.checks import check_directives
from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, FleetView, Policy, Representation
from sortie.policies.verification.compiled import Context, Rule, compiled
from sortie.policies.verification.invariants import Invariant, InvariantError, LinksTerm, Recent, just_heard
from sortie.policies.verification.nearest import Box, Far, distance, nearest
from sortie.policies.verification.words import CHANGES
from sortie.scenarios.representation import LEVELS, NAME_OF

MARK = "shield: "
MOST_CHANGES = 128
"""How many changes of links are tried for each broken line about several links; all links are tried once in any case."""
Cap = Callable[[Directive], Directive]
"""A directive as far as something allows it, such as the age of its peer's descriptor."""
_NOT_SHIELDED = ("sum_links", "count_links", "every_link")


def shield(policy: Policy, invariants: Iterable[Invariant]) -> Policy:
    """A policy that decides as the given one but keeps the invariants. It is as pure; shielding it again changes nothing.

    An invariant may contradict another one, depend on the view alone, or need a change of two links for itself. Then it
    is not kept, and the reasons of the directives that break it state it. One that holds is not given up for another.

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
    several = [line for line in lines if line.of_links]
    failed = False
    for _ in lines:  # a line that cannot be kept at first may be kept after other links have changed
        before = tuple(directives)
        failed = not _keep_alone(context, directives, boxes)
        failed = not _keep_together(context, directives, several, boxes) or failed
        if not failed or all(now is then for now, then in zip(directives, before, strict=True)):
            break
    for k, directive in enumerate(directives) if failed else ():
        lost = [line.invariant for line in lines if not line.holds(context, directive)]
        directives[k] = _not_replaced(directive, lost) if lost else directive
    return directives


def _keep_alone(context: Context, directives: list[Directive], boxes: _Boxes) -> bool:
    """Change each link that breaks a line about one link; False if a link has no directive that keeps all of them."""
    solved: dict[Any, Directive | None] = {}
    all_kept = True
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
        if after is None:
            all_kept = False
        else:
            directives[k] = _replaced(directive, after, [box.rules[i].invariant for i in sorted(set(broken))])
    return all_kept


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


_Asked = tuple[Rule, int | None]
"""A line about several links, and the link that must keep it; None for all links together."""


class _Plan(NamedTuple):
    """Changed links."""

    far: Far
    """How many fields change, and by how much in all."""
    number: int
    links: tuple[Directive, ...]
    keeps: dict[int, tuple[Rule, ...]]
    """The lines for which a link is changed."""
    broken: _Asked | None
    """A line that is still broken."""


def _keep_together(context: Context, directives: list[Directive], lines: Sequence[Rule], boxes: _Boxes) -> bool:
    """Change links so that lines about several links hold too; False if one of them cannot be kept.

    Args:
        context: has these same directives.
        directives: keep the lines about one link each, where they can.
        lines: those about several links.
        boxes: what the lines about one link each allow.
    """
    kept: list[_Asked] = []
    broken: list[_Asked] = []
    for line in lines:
        for k in range(len(directives)) if line.of_link else (None,):
            (kept if line.holds(context, directives[k or 0]) else broken).append((line, k))
    if not broken:
        return True
    before, count = tuple(directives), len(kept) + len(broken)
    links, keeps = before, dict[int, tuple[Rule, ...]]()
    for asked in broken:
        if links is before or not _holds(asked, links, context):
            plan = _plan(context, before, [asked, *kept], boxes)
            if plan is None:
                continue
            links, keeps = plan.links, plan.keeps
        kept.append(asked)
    context.directives = directives
    for k, rules in keeps.items():
        if links[k] is not before[k]:
            directives[k] = _replaced(before[k], links[k], [rule.invariant for rule in rules])
    return len(kept) == count


def _holds(asked: _Asked, links: Sequence[Directive], context: Context) -> bool:
    rule, k = asked
    context.directives = links
    return rule.holds(context, links[k or 0])


def _plan(context: Context, before: tuple[Directive, ...], asked: Sequence[_Asked], boxes: _Boxes) -> _Plan | None:
    """The nearest change of links that keeps all lines that are asked for; None if none was found.

    A broken line is kept by a change of one link. If that breaks another line, one more link changes, or the same one
    changes so that it keeps both.

    Args:
        context: what the lines are judged on; its directives are replaced.
        before: the links.
        asked: the lines, the first of them broken.
        boxes: what the lines about one link each allow.
    """
    queue, count = [_Plan((0, 0.0), 0, before, {}, asked[0])], 0
    best: _Plan | None = None
    while queue and count < MOST_CHANGES:
        this = heapq.heappop(queue)
        if best is not None and this.far >= best.far:
            break
        rule, only = cast(_Asked, this.broken)
        alike, seen = not any(part.of_peer for each, _ in asked for part in each.parts), set()
        for k in range(len(before)) if only is None else (only,):
            box = boxes.capped(before[k], boxes.of(before[k]))
            key = _key(before[k], box) if alike and k not in this.keeps else None
            if key is not None and key in seen:
                continue  # another link would change by as much
            seen.add(key)
            count += 1
            now = this.links[k]
            changed, far = distance(before[k], now) if k in this.keeps else (0, 0.0)
            others = this.far[0] - changed, this.far[1] - far
            nearer: Far | None = None if best is None else (best.far[0] - others[0], best.far[1] - others[1])
            rules = tuple(dict.fromkeys((*this.keeps.get(k, ()), rule)))
            parts = [part for each in rules for part in each.parts]
            context.directives = this.links
            after = nearest(before[k], box, parts, context, boxes.allowed, nearer)
            if after is None or (k in this.keeps and after == now):
                continue
            changed, far = distance(before[k], after)
            # A hundredth of the bounds is no reason for another link.
            at, links = (others[0] + changed, round(others[1] + far, 2)), (*this.links[:k], after, *this.links[k + 1 :])
            if best is not None and at >= best.far:
                continue
            still = next((a for a in asked if not _holds(a, links, context)), None)
            plan = _Plan(at, count, links, {**this.keeps, k: rules}, still)
            if still is None:
                best = plan
            else:
                heapq.heappush(queue, plan)
    return best


def _replaced(before: Directive, after: Directive, broken: Sequence[Invariant]) -> Directive:
    because = "; ".join([rule.text for rule in broken])
    was = f"{NAME_OF[before.representation]} at {before.rate_hz:g} Hz"
    return after._replace(destination=before.destination, reason=f"{MARK}{because} (decided {was}: {before.reason})")


def _not_replaced(before: Directive, broken: Sequence[Invariant]) -> Directive:
    note = f"{MARK}cannot keep {'; '.join(rule.text for rule in broken)} "
    return before if before.reason.startswith(note) else before._replace(reason=f"{note}({before.reason})")
