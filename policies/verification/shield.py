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
import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import compress, repeat
from typing import Any, NamedTuple

from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, Disc, FleetView, Policy
from sortie.policies.verification.boxes import Box, Correction, Known, box_of
from sortie.policies.verification.compiled import Context, Rule, compiled
from sortie.policies.verification.invariants import Invariant, InvariantError, LinksTerm, Recent, just_heard
from sortie.policies.verification.links import HIGHEST, Ceiling, Far, Link, as_directive, as_link, distance
from sortie.policies.verification.nearest import nearest
from sortie.policies.verification.words import CHANGES
from sortie.scenarios.representation import NAME_OF

MARK = "shield: "
MOST_CHANGES = 128
"""How many changes of links are tried in a decision, beside one of each link for each line about several links that is broken."""
Ceilings = Mapping[int, Ceiling]
"""What the link to each peer may carry at most."""
_MOST_KNOWN = 512
"""Corrections that a box remembers, of senders with a region and without one each."""
_AS_GOOD = 1e-9
"""Two changes that differ by less are compared by a search, which rounds otherwise."""
_NOT_SHIELDED = ("sum_links", "count_links", "every_link")


def shield(policy: Policy, invariants: Iterable[Invariant]) -> Policy:
    """A policy that decides as the given one but keeps the invariants. It is as pure; shielding it again changes nothing.

    An invariant may contradict another one, depend on the view alone, or need a change of two links for itself. Then it
    is not kept, and the reasons of the directives that break it state it. One that holds is not given up for another,
    except one about several links for one about one link: these come first.

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
    ceilings: Ceilings | None = None,
) -> list[Directive]:
    """The directives; those that break a rule are replaced by the nearest ones that keep all rules.

    Args:
        rules: the invariants.
        view: the policy's input.
        decided: its output.
        fresh: its output at age 0, if a rule needs it.
        ceilings: what the replacements may carry; None allows all.
    """
    me = view.me
    if me is None or not rules or not decided:
        return list(decided)
    lines = _compiled(tuple(rules))
    known = {d.destination: as_link(d) for d in fresh}
    was = [as_link(d) for d in decided]
    context = Context(view, me, was, known)
    boxes = _Boxes([line for line in lines if not line.of_links], context, ceilings)
    directives, links, all_kept = _keep_alone(context, decided, boxes)
    several = [line for line in lines if line.of_links]
    if several:
        if any(line.of_link for line in several):
            boxes = _Boxes([line for line in lines if line.of_link], context, ceilings)
        together = _Together(Context(view, me, links, known), was, several, boxes)
        all_kept = together.keep_all() and all_kept
        links = together.change(directives, decided)
    if not all_kept:
        context = Context(view, me, links, known)
        for k, link in enumerate(links):
            lost = [line.invariant for line in lines if not line.holds(context, link)]
            directives[k] = _not_replaced(directives[k], lost) if lost else directives[k]
    return directives


@lru_cache(maxsize=64)
def _compiled(rules: tuple[Invariant, ...]) -> tuple[Rule, ...]:
    return tuple([compiled(rule) for rule in rules])


def _keep_alone(
    context: Context, decided: Sequence[Directive], boxes: _Boxes
) -> tuple[list[Directive], list[Link], bool]:
    """The directives, those changed that break a line about one link; as links too; and whether all of these lines are kept."""
    directives, links, all_kept = list(decided), list(context.links), True
    region = context.me.region
    seen: dict[Box, Known] = {}
    for k, link in enumerate(context.links):
        box = boxes.of[k]
        known = seen.setdefault(box, {}) if box.known is None else box.known[region is not None]
        texts, changes = _correction(context, link, box, known)
        if changes is None:
            all_kept = False
        elif texts:
            fields: list[Any] = list(link)
            for at, value in changes:
                fields[at] = value
            links[k] = after = tuple.__new__(Link, fields)
            directives[k] = _replaced(decided[k], link, after, region, texts)
    return directives, links, all_kept


def _correction(context: Context, link: Link, box: Box, known: Known) -> Correction:
    """The lines that a link breaks, and its changes; None for those if nothing keeps the lines."""
    key = box.key(link)
    if key is None:
        return _searched(context, link, box)[0]
    found = known.get(key)
    if found is None:
        if len(known) >= _MOST_KNOWN:
            known.clear()
        found = known[key] = (_shared(context, link, box, known),)
    return found[0]


def _shared(context: Context, link: Link, box: Box, known: Known) -> Correction:
    """The same, by a search that was made for another link in the same brackets, if there was one."""
    if box.brackets is None:
        return _searched(context, link, box)[0]
    brackets = box.brackets.of(context, link)
    choices = known.get(brackets)
    if choices is not None:
        found = choices[0] if len(choices) == 1 else _nearest_of(link, choices)
        if found is not None:
            return found
    found, others = _searched(context, link, box)
    if others is not None:
        known[brackets] = found, *others
    return found


def _nearest_of(link: Link, choices: Sequence[Correction]) -> Correction | None:
    """Of corrections that change equally many fields, that with the smallest change; None if two are as good."""
    far = [sum([abs(value - link[at]) / HIGHEST[at] for at, value in changes or ()]) for _, changes in choices]
    least, second = heapq.nsmallest(2, far)
    return choices[far.index(least)] if second - least > _AS_GOOD else None


def _searched(context: Context, link: Link, box: Box) -> tuple[Correction, list[Correction] | None]:
    """The same, and those that change as many fields; None where not all were found."""
    broken = box.broken(context, link)
    if not broken:
        return ("", ()), []
    after, others = nearest(link, box, (), context, with_others=box.brackets is not None)
    texts = _texts(box, broken)
    if after is None:
        return (texts, None), None if others is None else []
    each: list[Correction] = [
        (texts, tuple(compress(enumerate(a), map(operator.is_not, a, link)))) for a in (after, *(others or ()))
    ]
    return each[0], None if others is None else each[1:]


@lru_cache(maxsize=1024)
def _texts(box: Box, broken: tuple[int, ...]) -> str:
    return "; ".join([box.rules[n].invariant.text for n in sorted(set(broken))])


class _Boxes:
    """What the lines about one link each allow each link. Links to which the same lines apply share a box."""

    def __init__(self, lines: Sequence[Rule], context: Context, ceilings: Ceilings | None) -> None:
        some = context.links[0]
        lines = [r for r in lines if r.when_of_view is None or r.when_of_view(context, some)]
        asked = [r.when_of_peer for r in lines if r.when_of_peer is not None]
        answers = [map(bool, map(when, repeat(context), context.links)) for when in asked]
        applies_to = list(zip(*answers, strict=True)) if asked else [()] * len(context.links)
        own: list[Ceiling] = [() if ceilings is None else ceilings[link.destination] for link in context.links]

        def box(applies: tuple[bool, ...], ceiling: Ceiling) -> Box:
            yes = iter(applies)
            rules = tuple([r for r in lines if r.when_of_peer is None or next(yes)])
            return box_of(rules, tuple([side(context, some) for r in rules for side in r.sides]), ceiling)

        keys = list(
            zip(applies_to, map(id, own), strict=True)
        )  # most ceilings are few objects, and their hashes are slow
        boxes = {key: box(key[0], ceiling) for key, ceiling in dict(zip(keys, own, strict=True)).items()}
        self.of = [boxes[key] for key in keys]
        """Each link's box, below its ceiling."""


_Asked = tuple[int, int | None]
"""The number of a line about several links, and the link that must keep it; None for all links together."""


class _Plan(NamedTuple):
    """Changed links."""

    far: Far
    """How many fields change for lines about several links, and by how much in all."""
    context: Context
    """Has the changed links."""
    keeps: dict[int, tuple[int, ...]]
    """The numbers of the lines for which a link is changed."""


class _Change(NamedTuple):
    """One more link of a plan is changed, or the same one otherwise."""

    far: Far
    """As of the plan that it leads to."""
    number: int
    plan: _Plan
    link: int
    after: Link
    lines: tuple[int, ...]

    def made(self) -> _Plan:
        """The plan with the change."""
        _, context, keeps = self.plan
        return _Plan(self.far, context.having(self.link, self.after), {**keeps, self.link: self.lines})


class _Together:
    """Changes links so that lines about several links hold too, one line after the other.

    A broken line is kept by a change of one link, beside those of the plan so far. If that breaks a line that is kept
    already, one more link changes, or the same one changes so that it keeps both. So a link may pass a line on to another
    one. Distances are from what was decided.

    Args:
        context: has the links, which keep the lines about one link alone, where they can.
        decided: what was decided for them.
        lines: those about several links.
        boxes: what all lines about each link allow.
    """

    def __init__(self, context: Context, decided: Sequence[Link], lines: Sequence[Rule], boxes: _Boxes) -> None:
        self._start, self._decided, self._lines, self._boxes = context, decided, lines, boxes
        self._plan = _Plan((0, 0.0), context, {})
        self._count = self._further = 0
        self._alike = not any(part.of_peer for line in lines for part in line.parts)
        self._fields: dict[int, dict[int, int]] = {}
        """How many fields of a link must change for a line, by the line's number, as far as it was tried."""
        self._kept: list[_Asked] = []
        self._broken: list[_Asked] = []
        for n, line in enumerate(lines):
            for k in range(len(decided)) if line.of_link else (None,):
                (self._kept if self._holds((n, k), context) else self._broken).append((n, k))

    def keep_all(self) -> bool:
        """Keep all lines that can be kept; False if one cannot."""
        broken: list[_Asked] = []
        left = self._broken
        while len(left) != len(broken):
            broken = left  # a line that cannot be kept at first may be kept after other links have changed
            left = [asked for asked in broken if not self._keep(asked)]
        return not left

    def change(self, directives: list[Directive], decided: Sequence[Directive]) -> list[Link]:
        """Replace the directives of the links that change, and return the links."""
        links = list(self._start.links)
        for k, numbers in self._plan.keeps.items():
            was, after = self._decided[k], self._plan.context.links[k]
            if after != was:
                box = self._boxes.of[k]
                broken = [box.rules[n] for n in sorted(set(box.broken(self._start, was)))]
                because = dict.fromkeys([rule.invariant for rule in [*broken, *[self._lines[n] for n in numbers]]])
                texts = "; ".join([invariant.text for invariant in because])
                links[k] = after
                directives[k] = _replaced(decided[k], was, after, self._start.me.region, texts)
        return links

    def _holds(self, asked: _Asked, context: Context) -> bool:
        n, k = asked
        return self._lines[n].holds(context, context.links[k or 0])

    def _keep(self, asked: _Asked) -> bool:
        """Keep one more line by the nearest change that was found of the plan so far."""
        this, wanted, still = self._plan, [asked, *self._kept], asked
        queue, seen = list[_Change](), set[Any]()
        kept = self._holds(asked, this.context)
        while not kept:
            key = frozenset(this.keeps.items())
            if key not in seen and (not seen or self._further < MOST_CHANGES):
                tried = self._count
                for change in self._changes(this, *still):
                    heapq.heappush(queue, change)
                if seen:
                    self._further += self._count - tried
            seen.add(key)
            if not queue:
                return False
            this = heapq.heappop(queue).made()
            broken = next((a for a in wanted if not self._holds(a, this.context)), None)
            kept, still = broken is None, broken or still
        self._plan = this
        self._kept.append(asked)
        return True

    def _changes(self, this: _Plan, n: int, only: int | None) -> list[_Change]:
        """The changes by which one link keeps a line that is still broken."""
        links = range(len(self._decided)) if only is None else (only,)
        alike, fields = set[Any](), self._fields.setdefault(n, {})
        found: list[_Change] = []
        for k in links:
            if k not in this.keeps:
                box = self._boxes.of[k]
                key = id(box), box.key(self._decided[k]) if self._alike else None
                if key[1] is None or key not in alike:  # another link would change by as much
                    alike.add(key)
                    for change in self._change(this, k, (n,)):
                        found.append(change)
                        fields[k] = change.far[0] - this.far[0]
        taken = [k for k in links if k in this.keeps]
        for k in taken:
            found += self._change(this, k, tuple(dict.fromkeys((*this.keeps[k], n))))
        fewest = min([change.far[0] for change in found], default=math.inf)
        for k in taken:  # another link takes what this one keeps, if fewer fields change then
            more = max(
                [min([x for j, x in self._fields.get(m, {}).items() if j != k], default=0) for m in this.keeps[k]]
            )
            found += [change for change in self._change(this, k, (n,)) if change.far[0] + more < fewest]
        return found

    def _change(self, this: _Plan, k: int, numbers: tuple[int, ...]) -> list[_Change]:
        """The nearest change by which a link keeps these lines, if there is one."""
        self._count += 1
        before, now, box = self._decided[k], this.context.links[k], self._boxes.of[k]
        parts = tuple([part for n in numbers for part in self._lines[n].parts])
        after, _ = nearest(before, box, parts, this.context)
        if after is None or after == now:
            return []
        was, is_now = (0, 0.0) if now is before else distance(before, now), distance(before, after)
        # A hundredth of the bounds is no reason for another link.
        far = this.far[0] - was[0] + is_now[0], round(this.far[1] - was[1] + is_now[1], 2)
        return [_Change(far, self._count, this, k, after, numbers)]


def _replaced(before: Directive, was: Link, after: Link, region: Disc | None, texts: str) -> Directive:
    decided = f"{NAME_OF[before.representation]} at {before.rate_hz:g} Hz: {before.reason}"
    return as_directive(before, was, after, region, f"{MARK}{texts} (decided {decided})")


def _not_replaced(before: Directive, broken: Sequence[Invariant]) -> Directive:
    note = f"{MARK}cannot keep {'; '.join(rule.text for rule in broken)} "
    return before if before.reason.startswith(note) else before._replace(reason=f"{note}({before.reason})")
