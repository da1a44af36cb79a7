"""A shield: wraps a policy so that it keeps its invariants at run time, and reports each intervention.

    decide = shield(worked, parse("when battery < 0.3: rate_hz <= 1"))

A directive that breaks an invariant is replaced. Each of its fields is moved into the range that the invariants allow. Where
that is not enough (an `or`, several fields in one comparison), values at the numbers that the invariants name are tried in
up to `MOST_FIELDS` fields at once: fewest fields first, then the smallest change. A step of representation counts as a
quarter, a number as a share of its bounds. A condition on the directive itself is made false only where nothing else helps.
Where nothing helps, the directive stays, and its reason says so.

The reason of a replaced directive begins with "shield:", so the record shows each intervention and `interventions` counts
them. A line `within T s: …` is kept at once. Lines about several links are kept by one link after the other.

In flight the shield acts twice: here, on the policy's output, and at the gate, on what the staleness rules and damping
left of it (`policies.verification.enforced`). There a limit keeps it from giving a link more than its age allows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

from sortie.policies.checks import check_directives
from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, Disc, FleetView, Policy, Representation
from sortie.policies.verification.invariants.language import (
    COMPARE,
    Binary,
    Fresh,
    Invariant,
    InvariantError,
    LinksTerm,
    Logic,
    Name,
    Node,
    Recent,
    evaluate,
    just_heard,
    violations,
    walk,
)
from sortie.policies.verification.invariants.words import CHANGES, DECISIONS, WORDS, Scope
from sortie.scenarios.representation import AT_LEVEL, NAME_OF

MARK = "shield: "
MOST_FIELDS = 3
MOST_TRIED, MOST_IN_ALL = 250, 6000
"""So many changes of a directive are tried at most, from each of four begins; and so many in a decision."""
MOST_ORDERS = 6
"""So many orders of the invariants about several links are tried, if not all are kept in the first one."""
LEAST_RATE_HZ = 2.0
"""The rate of a link that a shield makes carry something, if no invariant names a rate."""
HIGHEST = {word: 1.0 if word in ("duty", "roi") else DIRECTIVE_BOUNDS[word].high for word in DECISIONS}
"""The upper bound of each field; the lower one is 0."""
_LEVELS = (0.0, 1.0, 2.0, 3.0, 4.0)
_PLAIN = frozenset({float, int, bool, type(None), Disc, Representation})
"""Types of fields that are no symbols of a proof."""
_NOT_SHIELDED = ("sum_links", "count_links", "every_link")
_MIRRORED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}
_OPPOSITE = {"<": ">=", "<=": ">", ">": "<=", ">=": "<", "==": "!=", "!=": "=="}

Limit = tuple[str, str, Any]
"""A field, a sign, and the other side."""
Ceiling = tuple[Limit, ...]
"""What a link may carry at most, for instance by the age of what is known about its peer."""
Ceilings = Mapping[int, Ceiling]
"""By peer."""


def nothing_but_duty() -> Ceiling:
    """The ceiling of a link that carries nothing. Its sender's duty cycle is still free."""
    rests = Directive(0, 0)
    return tuple((word, "==", float(_value(rests, word))) for word in DECISIONS if word != "duty")


def shield(policy: Policy, invariants: Iterable[Invariant]) -> Policy:
    """A policy that decides as the given one but keeps the invariants. It is as pure; shielding it again changes nothing.

    An invariant may contradict another one, depend on the view alone, or need a change of two links at once. Then it is not
    kept, and the reasons of the directives that break it state it.

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
    """The directives; those that break a rule are replaced by near ones that keep all rules.

    Args:
        rules: the invariants.
        view: the policy's input.
        decided: its output.
        fresh: its output at age 0, if a rule needs it.
        ceilings: what the replacements may carry; None allows all.
    """
    if view.me is None or not rules or not decided:
        return list(decided)
    return _Enforcing(rules, view, decided, fresh, ceilings).directives()


class _Enforcing:
    """One decision's directives, as they are changed so that they keep the rules."""

    def __init__(
        self,
        rules: Sequence[Invariant],
        view: FleetView,
        decided: Sequence[Directive],
        fresh: Sequence[Directive],
        ceilings: Ceilings | None,
    ) -> None:
        self._view, self._decided, self._fresh = view, list(decided), fresh
        self._links, self._ceilings = list(decided), ceilings or {}
        self._because: list[dict[str, None]] = [{} for _ in decided]
        """For each link, the texts of the rules for which it was changed."""
        assert view.me is not None  # noqa: S101 - `enforce` has no other ones
        self._scope = Scope(view, view.me, self._decided, {d.destination: d for d in fresh})
        self._of_links = [rule for rule in rules if _is_of_links(rule)]
        self._alone = [rule for rule in rules if not _is_of_links(rule) and self._may_apply(rule)]

        self._of_peer = [rule.when for rule in self._alone if rule.when is not None and _is_about_peer(rule.when)]
        self._differ = any(_is_about_peer(rule.then) for rule in self._alone)
        """Whether equal links to different peers may be corrected otherwise."""

    def directives(self) -> list[Directive]:
        """The directives that keep the rules."""
        self._left = MOST_IN_ALL
        unkept, known = set[int](), dict[Any, tuple[list[str], Directive | None]]()
        for k, link in enumerate(self._decided):
            key = self._key(link)
            texts, after = known.get(key) or self._corrected(link)
            if key is not None:
                known[key] = texts, after
            if texts and after is None:
                unkept.add(k)
            elif texts and after is not None:
                self._links[k] = after._replace(destination=link.destination, reason=link.reason)
                self._because[k].update(dict.fromkeys(texts))
        lost = self._keep_together() if self._of_links else []
        found = [self._replaced(k) for k in range(len(self._links))]
        for k in range(len(self._links)) if lost else sorted(unkept):
            link = self._links[k]
            texts = [rule.text for rule in self._alone if self._breaks(rule, link)]
            texts += [rule.text for rule in lost if not rule.of_link or link in self._broken(rule, self._links)]
            note = f"{MARK}cannot keep {'; '.join(texts)} "
            if texts and not found[k].reason.startswith(note):
                found[k] = found[k]._replace(reason=f"{note}({found[k].reason})")
        return found

    def _key(self, link: Directive) -> Any:
        """What links of this decision have in common that are corrected alike; None if nothing can be said."""
        fields = tuple(link)[2:9]
        parts = (*fields, *(link.roi or ()))
        if self._differ or not all(type(x) in _PLAIN for x in parts):
            return None
        scope = self._scope._replace(link=link)
        return fields, self._ceilings.get(link.destination), *[bool(evaluate(when, scope)) for when in self._of_peer]

    def _corrected(self, link: Directive) -> tuple[list[str], Directive | None]:
        """The rules about one link that a link breaks, as texts, and the nearest directive that keeps them."""
        broken = [rule.text for rule in self._alone if self._breaks(rule, link)]
        return broken, self._nearest(link, link, self._alone, self._keeps_alone) if broken else None

    def _broken(self, rule: Invariant, links: Sequence[Directive]) -> list[Directive | None]:
        return violations(rule, self._view, links, self._fresh)

    def _breaks(self, rule: Invariant, link: Directive) -> bool:
        """Whether a link breaks a rule about one link."""
        view, me, links, fresh, *_ = self._scope
        scope = Scope(view, me, links, fresh, link)
        applies = rule.when is None or not rule.when_of_link or evaluate(rule.when, scope)
        return bool(applies) and not evaluate(rule.then, scope)

    def _keeps_alone(self, link: Directive) -> bool:
        return not any(self._breaks(rule, link) for rule in self._alone)

    def _may_apply(self, rule: Invariant) -> bool:
        """Whether the view alone does not decide against a rule's condition."""
        return rule.when is None or rule.when_of_link or bool(evaluate(rule.when, self._scope))

    def _replaced(self, k: int) -> Directive:
        before, after = self._decided[k], self._links[k]
        if after is before or after == before:
            return before
        decided = f"{NAME_OF[Representation(before.representation)]} at {before.rate_hz:g} Hz: {before.reason}"
        return after._replace(reason=f"{MARK}{'; '.join(self._because[k])} (decided {decided})")

    def _keep_together(self) -> list[Invariant]:
        """Change links so that rules about several links hold; those that cannot be kept."""
        begin, texts = list(self._links), [dict(one) for one in self._because]
        broken = [rule for rule in self._of_links if self._broken(rule, self._links)]
        best: tuple[int, list[Directive], list[dict[str, None]], list[Invariant]] | None = None
        for order in itertools.islice(itertools.permutations(broken), MOST_ORDERS):
            self._links, self._because = list(begin), [dict(one) for one in texts]
            left = [rule for rule in order if not self._keep_one(rule)]
            left = [rule for rule in left if not self._keep_one(rule)]  # it may be kept after others have changed
            if best is None or len(left) < best[0]:
                best = len(left), self._links, self._because, left
            if not left:
                break
        if best is None:
            return []
        _, self._links, self._because, lost = best
        return lost

    def _keep_one(self, rule: Invariant) -> bool:
        """Keep one more rule about several links by changes of one link after the other."""
        before, texts = list(self._links), [dict(one) for one in self._because]
        kept = [r for r in self._of_links if not self._broken(r, self._links)]
        for _ in self._links:
            broken = self._broken(rule, self._links)
            if not broken:
                return True

            def improves(k: int, link: Directive, broken: Sequence[object] = broken) -> bool:
                links = [*self._links[:k], link, *self._links[k + 1 :]]
                if any(self._breaks(r, link) and not self._breaks(r, self._links[k]) for r in self._alone):
                    return False
                if any(self._broken(r, links) for r in kept):
                    return False
                left = self._broken(rule, links)
                return len(left) < len(broken) if rule.of_link else not left

            changes = []
            for k in range(len(self._links)):
                if rule.of_link and self._links[k] not in broken:
                    continue
                found = self._nearest(
                    self._decided[k], self._links[k], [*self._alone, rule], lambda d, k=k: improves(k, d)
                )
                if found is not None:
                    changes.append((_distance(self._decided[k], found), k, found))
            if not changes:
                break
            _, k, self._links[k] = min(changes, key=lambda change: change[:2])
            self._because[k][rule.text] = None
        if self._broken(rule, self._links):
            self._links, self._because = before, texts
            return False
        return True

    # --- the nearest directive

    def _nearest(self, decided: Directive, link: Directive, rules: Sequence[Invariant], keeps: Any) -> Directive | None:
        """The nearest directive that is below its ceiling and keeps what `keeps` asks for."""
        ceiling = self._ceilings.get(link.destination, ())

        def is_kept(d: Directive) -> bool:
            return all(COMPARE[sign](_value(d, word), side) for word, sign, side in ceiling) and keeps(d)

        always = [*ceiling, *(limit for rule in rules for limit in self._limits(rule, link, own_conditions=False))]
        also = [limit for rule in rules for limit in self._limits(rule, link, own_conditions=True)]
        least = self._moved(link, always)
        if least is None:
            return None
        if is_kept(least):
            return least
        applied = [rule for rule in rules if _has_own_condition(rule) and self._applies(rule, link)]
        spare = None
        for base in (self._moved(link, [*always, *also]), least):
            if base is None:
                continue
            if is_kept(base):
                return base
            broken = [rule for rule in rules if _is_of_links(rule) or self._breaks(rule, base)]
            for some in (broken, rules):  # fields that broken rules name are mostly enough
                for candidate in itertools.islice(self._around(decided, base, [*always, *also], some), MOST_TRIED):
                    self._left -= 1
                    if self._left < 0:
                        return spare
                    if is_kept(candidate):
                        if all(self._applies(rule, candidate) for rule in applied):
                            return candidate
                        spare = spare or candidate
                if spare is not None or len(some) == len(rules):
                    break
        return spare

    def _applies(self, rule: Invariant, link: Directive) -> bool:
        return rule.when is None or bool(evaluate(rule.when, self._of(link)))

    def _of(self, link: Directive) -> Scope:
        return self._scope._replace(link=link, directives=self._links)

    def _limits(self, rule: Invariant, link: Directive, *, own_conditions: bool) -> Iterator[Limit]:
        """The bounds of single fields that a rule sets; those whose condition is about the directive itself, or the others."""
        if _has_own_condition(rule) == own_conditions and self._applies(rule, link):
            yield from self._bounds(rule.then, link)

    def _bounds(self, node: Node, link: Directive) -> Iterator[Limit]:
        match node:
            case Logic(word="and", parts=parts):
                for part in parts:
                    yield from self._bounds(part, link)
            case Name(word=word) if word in DECISIONS:
                yield word, "==", 1.0
            case Logic(word="not", parts=(Name(word=word),)) if word in DECISIONS:
                yield word, "==", 0.0
            case Logic(word="not", parts=(Binary(sign=sign, left=left, right=right),)) if sign in _OPPOSITE:
                yield from self._bounds(Binary(_OPPOSITE[sign], left, right), link)
            case Binary(sign=sign, left=left, right=right) if sign in COMPARE:
                for side, other, how in ((left, right, sign), (right, left, _MIRRORED[sign])):
                    if isinstance(side, Name) and side.word in DECISIONS and not _is_about_link(other):
                        yield side.word, how, evaluate(other, self._of(link))

    def _moved(self, link: Directive, limits: Sequence[Limit]) -> Directive | None:
        """A directive with each field moved into its limits; None where one has no value within them."""
        wanted = {}
        for word in dict.fromkeys(word for word, _, _ in limits):
            mine = [(sign, side) for of, sign, side in limits if of == word]
            now = _value(link, word)
            if all(COMPARE[sign](now, side) for sign, side in mine):
                continue
            values = [v for v in _near(word, mine) if all(COMPARE[sign](v, side) for sign, side in mine)]
            if not values:
                return None
            wanted[word] = min(values, key=lambda v: abs(v - now))
        return self._with(link, wanted)

    def _with(self, link: Directive, wanted: Mapping[str, Any]) -> Directive | None:
        """A directive with other values of some fields; None if there is no such one."""
        me = self._view.me
        return _changed(link, wanted, None if me is None else me.region)

    def _around(
        self, decided: Directive, base: Directive, limits: Sequence[Limit], rules: Sequence[Invariant]
    ) -> Iterator[Directive]:
        """Directives that differ from `base` in a few fields that rules name, the nearest to what was decided first."""
        named = sorted({n.word for rule in rules for n in rule.nodes if isinstance(n, Name) and n.word in DECISIONS})
        sides = [*limits, *(limit for rule in rules for limit in self._named_limits(rule, base))]
        was = {word: _value(decided, word) for word in named}
        now = {word: _value(base, word) for word in named}
        values = {w: _near(w, [(sign, side) for of, sign, side in sides if of == w]) for w in named}
        for word in {"rho", "rate_hz"} & set(named):  # as it is, where it would follow the representation
            values[word] = [now[word], *values[word]]
        for count in range(1, MOST_FIELDS + 1):
            found: list[tuple[int, float, int, dict[str, Any]]] = []
            for words in itertools.combinations(named, count):
                for chosen in itertools.product(*(values[word] for word in words)):
                    after = dict(zip(words, chosen, strict=True))
                    if "representation" in words or all(after[word] != now[word] for word in words):
                        away = [abs(x - was[w]) / HIGHEST[w] for w, x in (now | after).items()]
                        found.append((sum(1 for x in away if x > 0), sum(away), len(found), after))
            for *_, after in sorted(found, key=lambda one: one[:3]):
                changed = self._with(base, after)
                if changed is not None:
                    yield changed

    def _named_limits(self, rule: Invariant, link: Directive) -> Iterator[Limit]:
        """Every comparison of a field in a rule, wherever it stands; of one that ties fields together, where it is tight."""
        for node in rule.nodes:
            if not isinstance(node, Binary) or node.sign not in COMPARE:
                continue
            limits = list(self._bounds(node, link))
            yield from limits
            tied = {n.word for n in walk(node) if isinstance(n, Name) and n.word in DECISIONS}
            for word in tied if not limits and not _is_of_links(rule) else ():
                gaps = []
                for value in (0.0, HIGHEST[word]):
                    other = self._with(link, {word: value} if word != "representation" else {word: round(value)})
                    scope = self._of(link if other is None else other)
                    gaps.append(evaluate(node.left, scope) - evaluate(node.right, scope))
                if gaps[0] * gaps[1] < 0:
                    yield word, node.sign, HIGHEST[word] * gaps[0] / (gaps[0] - gaps[1])


def _is_about_link(node: Node) -> bool:
    """Whether it depends on directives that may change."""
    return any(isinstance(n, LinksTerm) or (isinstance(n, Name) and n.word in DECISIONS) for n in walk(node))


def _is_about_peer(node: Node) -> bool:
    """Whether it depends on the peer otherwise than through the link's directive."""
    of_peer = (n.word not in DECISIONS and WORDS[n.word].of_link for n in walk(node) if isinstance(n, Name))
    return any(of_peer) or any(isinstance(n, Fresh) for n in walk(node))


@lru_cache(maxsize=1024)
def _is_of_links(rule: Invariant) -> bool:
    return any(isinstance(n, LinksTerm) for n in rule.nodes)


@lru_cache(maxsize=1024)
def _has_own_condition(rule: Invariant) -> bool:
    """Whether its condition is about the directive itself."""
    return rule.when is not None and _is_about_link(rule.when)


def _value(directive: Directive, word: str) -> Any:
    """A field as invariants compare it."""
    raw = DECISIONS[word].raw
    assert raw is not None  # noqa: S101 - every decision has it
    return raw(directive)


def _near(word: str, limits: Sequence[tuple[str, Any]]) -> list[Any]:
    """Values of a field at its limits, on both sides of them, and at the bounds of the contract."""
    edges = [side for _, side in limits if math.isfinite(side)]
    if word == "representation":  # uncertain boxes and codes only where an invariant names them
        return sorted({*_LEVELS, *(float(edge) for edge in edges if edge in AT_LEVEL)})
    if word == "roi":
        return [0.0, 1.0]
    if word == "duty":
        edges = [
            percent / 100 for edge in edges for percent in range(math.floor(edge * 100) - 1, math.floor(edge * 100) + 3)
        ]
    else:  # steps large enough to survive the wire's rounding
        edges = [edge + by * max(abs(edge), 0.01) * 0.01 for edge in edges for by in (0, -1, 1)]
        edges += [(a + b) / 2 for (_, a), (_, b) in itertools.combinations(limits[:4], 2) if math.isfinite(a + b)]
    return sorted({v for v in (0.0, *edges, HIGHEST[word]) if 0 <= v <= HIGHEST[word]})


def _changed(link: Directive, wanted: Mapping[str, Any], region: Disc | None) -> Directive | None:
    fields: dict[str, Any] = dict(wanted)
    if fields.get("roi") and region is None and link.roi is None:
        return None
    if "roi" in fields:
        fields["roi"] = (link.roi or region) if fields["roi"] else None
    if "duty" in fields:
        fields["duty_percent"] = round(fields.pop("duty") * 100)
    if "representation" in fields:
        level, was = fields["representation"], _value(link, "representation")
        fields["representation"] = AT_LEVEL[level]
        if level < Representation.CODES.level and link.rho:
            fields.setdefault("rho", 0.0)  # only codes and features have cells
        if level > was and link.rate_hz <= 0:
            fields.setdefault("rate_hz", LEAST_RATE_HZ)  # a link at 0 Hz carries nothing
    return link._replace(**fields) if fields else link


def _distance(a: Directive, b: Directive) -> tuple[int, float]:
    """How many fields differ, and by how much in all."""
    away = [abs(_value(a, word) - _value(b, word)) / HIGHEST[word] for word in DECISIONS]
    return sum(1 for x in away if x > 0), math.fsum(away)
