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
import operator
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import compress
from typing import Any

from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, FleetView, Policy
from sortie.policies.verification.boxes import Box, Correction, Known
from sortie.policies.verification.compiled import Context, Rule, compiled
from sortie.policies.verification.invariants import Invariant, InvariantError, LinksTerm, Recent, just_heard
from sortie.policies.verification.links import HIGHEST, Link, as_link
from sortie.policies.verification.nearest import nearest
from sortie.policies.verification.shield_together import MARK, Boxes, Ceilings, Together, replaced
from sortie.policies.verification.words import CHANGES

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
    boxes = Boxes([line for line in lines if not line.of_links], context, ceilings)
    directives, links, all_kept = _keep_alone(context, decided, boxes)
    several = [line for line in lines if line.of_links]
    if several:
        if any(line.of_link for line in several):
            boxes = Boxes([line for line in lines if line.of_link], context, ceilings)
        together = Together(Context(view, me, links, known), was, several, boxes)
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
    context: Context, decided: Sequence[Directive], boxes: Boxes
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
            directives[k] = replaced(decided[k], link, after, region, texts)
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


def _not_replaced(before: Directive, broken: Sequence[Invariant]) -> Directive:
    note = f"{MARK}cannot keep {'; '.join(rule.text for rule in broken)} "
    return before if before.reason.startswith(note) else before._replace(reason=f"{note}({before.reason})")
