"""A shield: wraps a policy so that it keeps its invariants at run time, and reports each intervention.

    decide = shield(worked, parse("when battery < 0.3: rate_hz <= 1"))

A directive that breaks an invariant is replaced: each of its fields is moved into the range that the invariants allow, to
the nearest value there. An `or` and an `any_link(…)` leave a choice of ranges; of those that keep all invariants, the one
with the fewest changed fields is taken, then that with the smallest change. A step of representation counts as a quarter,
a number as a share of its bounds. Where no range is left, a safe directive takes its place: nothing, or detections at the
lowest rate. Where that does not help either, the directive stays, and its reason says so.

The reason of a replaced directive begins with "shield:", so the record shows each intervention and `interventions` counts
them. A line `within T s: …` is kept at once. A condition on the directive itself is made false only where nothing else
helps.

In flight the shield acts twice: here, on the policy's output, and at the gate, on what the staleness rules and damping
left of it (`policies.verification.enforced`). There a limit keeps it from giving a link more than its age allows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from sortie.policies.checks import check_directives
from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, Disc, FleetView, Policy, Representation
from sortie.policies.staleness import Ceilings, Limit
from sortie.policies.verification.invariants.language import (
    COMPARE,
    Binary,
    Invariant,
    InvariantError,
    LinksTerm,
    Logic,
    Name,
    Node,
    Recent,
    evaluate,
    just_heard,
    walk,
)
from sortie.policies.verification.invariants.words import CHANGES, DECISIONS, Scope, link_of
from sortie.scenarios.representation import AT_LEVEL, NAME_OF

MARK = "shield: "
MOST_STEPS = 200
"""So many choices of ranges are followed at most, for each link and for the lines about several links."""
LEAST_RATE_HZ = 2.0
"""The rate of a link that a shield makes carry something, if no invariant names a rate."""
HIGHEST = {word: 1.0 if word in ("duty", "roi") else DIRECTIVE_BOUNDS[word].high for word in DECISIONS}
"""The upper bound of each field; the lower one is 0."""
_NOT_SHIELDED = ("sum_links", "count_links", "every_link", *CHANGES)
_MIRRORED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}
_OPPOSITE = {"<": ">=", "<=": ">", ">": "<=", ">=": "<", "==": "!=", "!=": "=="}


def shield(policy: Policy, invariants: Iterable[Invariant]) -> Policy:
    """A policy that decides as the given one but keeps the invariants. It is as pure; shielding it again changes nothing.

    An invariant may contradict another one, or depend on the view alone. Then it is not kept, and the reasons of the
    directives that break it say so.

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
            if name in _NOT_SHIELDED:
                what = f"a shield cannot keep {name}(…); `sortie verify` can only prove it"
                raise InvariantError(f"{rule.text!r}: {what}")
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


_Way = tuple[tuple[int, Limit], ...]
"""Limits on links, by their place, that together make an expression true or false."""


class _State(NamedTuple):
    """Links on their way to keeping the rules."""

    links: tuple[Directive, ...]
    limits: tuple[tuple[Limit, ...], ...]
    """Of each link."""
    changes: tuple[tuple[int, float], ...]
    """Of each link: how many fields the limits change, and by how much."""
    made_false: int = 0
    because: tuple[tuple[int, str], ...] = ()
    """Which link was changed for which rule."""

    @property
    def cost(self) -> tuple[int, int, float]:
        """How many conditions on directives are made false, how many fields change, and by how much in all."""
        return self.made_false, sum(n for n, _ in self.changes), math.fsum(away for _, away in self.changes)


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
        self._decided, self._base = tuple(decided), list(decided)
        self._ceilings = [(ceilings or {}).get(link.destination, ()) for link in decided]
        assert view.me is not None  # noqa: S101 - `enforce` has no other ones
        self._region = view.me.region
        self._scope = Scope(view, view.me, self._decided, {d.destination: d for d in fresh})
        self._alone = [rule for rule in rules if not rule.over_links]
        self._together = [rule for rule in rules if rule.over_links]

    def directives(self) -> list[Directive]:
        """The directives that keep the rules."""
        state = _State(self._decided, tuple(self._ceilings), ((0, 0.0),) * len(self._decided))
        broken = [[r for r in self._alone if self._breaks(r, k, state)] for k in range(len(self._decided))]
        unkept = set[int]()
        for k, rules in enumerate(broken):
            after = self._keep_alone(state, k) if rules else state
            if after is None:
                unkept.add(k)
            else:
                state = after
        state, lost = self._keep_together(state)
        found = []
        for k, (before, link) in enumerate(zip(self._decided, state.links, strict=True)):
            texts = dict.fromkeys(rule.text for rule in broken[k] if k not in unkept)
            texts |= dict.fromkeys(text for place, text in state.because if place == k)
            found.append(before if link == before else link._replace(reason=_reason(texts, before)))
            if lost or k in unkept:
                found[k] = self._with_note(found[k], k, state, lost)
        return found

    def _with_note(self, link: Directive, k: int, state: _State, lost: Sequence[Invariant]) -> Directive:
        """The directive at a place, its reason with the rules that are not kept."""
        texts = [rule.text for rule in self._alone if self._breaks(rule, k, state)]
        texts += [rule.text for rule in lost if not rule.of_link or self._breaks(rule, k, state)]
        note = f"{MARK}cannot keep {'; '.join(texts)} "
        return link if not texts or link.reason.startswith(note) else link._replace(reason=f"{note}({link.reason})")

    def _breaks(self, rule: Invariant, k: int, state: _State) -> bool:
        """Whether a rule is broken at a link's place."""
        scope = self._scope._replace(link=state.links[k], directives=state.links)
        return (rule.when is None or bool(evaluate(rule.when, scope))) and not evaluate(rule.then, scope)

    def _keep_alone(self, state: _State, k: int) -> _State | None:
        """The state with a link that keeps the rules about one link; None if there is none."""
        found = self._settle([(rule, k) for rule in self._alone], state)
        if found is not None:
            return found._replace(because=state.because)
        for rung, rate_hz in ((Representation.NONE, 0.0), (Representation.DETECTIONS, LEAST_RATE_HZ)):
            safe = self._decided[k]._replace(representation=rung, rho=0.0, rate_hz=rate_hz)
            after = state._replace(links=(*state.links[:k], safe, *state.links[k + 1 :]))
            is_below = all(COMPARE[sign](_value(safe, word), side) for word, sign, side in self._ceilings[k])
            if is_below and not any(self._breaks(rule, k, after) for rule in self._alone):
                self._base[k] = safe
                return after
        return None

    def _keep_together(self, begin: _State) -> tuple[_State, list[Invariant]]:
        """The state in which rules about several links hold as well, and those of them that cannot be kept."""
        kept = [rule for rule in self._together if not any(self._breaks(*one, begin) for one in self._places([rule]))]
        if len(kept) == len(self._together):
            return begin, []
        held = [(r, k) for r in self._alone for k in range(len(begin.links)) if not self._breaks(r, k, begin)]
        # from where no link has moved: the nearest way to keep a line alone may bar another line
        unmoved = _State(tuple(self._base), tuple(self._ceilings), ((0, 0.0),) * len(self._base))
        state = self._settle([*held, *self._places(self._together)], unmoved)
        if state is not None:
            return state, []
        state = begin
        for rule in self._together:
            found = None if rule in kept else self._settle([*held, *self._places([*kept, rule])], unmoved)
            if found is not None:
                kept.append(rule)
                state = found
        return state, [rule for rule in self._together if rule not in kept]

    def _places(self, rules: Sequence[Invariant]) -> list[tuple[Invariant, int]]:
        """Where rules are judged: at each link, or once."""
        return [(rule, k) for rule in rules for k in range(len(self._decided) if rule.of_link else 1)]

    # --- the nearest directives

    def _settle(self, required: Sequence[tuple[Invariant, int]], begin: _State) -> _State | None:
        """The nearest links found that keep rules at places; None if there are none."""
        best: _State | None = None
        waiting, left = [begin], MOST_STEPS
        while waiting and left:
            state = waiting.pop()
            if best is not None and not state.cost < best.cost:
                continue
            left -= 1
            broken = next((one for one in required if self._breaks(*one, state)), None)
            if broken is None:
                best = state
                continue
            further = [after for after in self._ways_out(state, *broken) if after is not None]
            # the nearest, and of equals the first, is next
            waiting += sorted(further, key=lambda after: after.cost)[::-1]
        return best

    def _ways_out(self, state: _State, rule: Invariant, k: int) -> Iterator[_State | None]:
        """The states in which a rule that is broken at a place is kept for itself."""
        for way in self._ways(rule.then, k, state.links, wanted=True):
            yield self._narrowed(state, way, rule.text)
        if rule.when is not None:
            for way in self._ways(rule.when, k, state.links, wanted=False):
                yield self._narrowed(state._replace(made_false=state.made_false + 1), way, rule.text)

    def _ways(self, node: Node, k: int, links: Sequence[Directive], *, wanted: bool) -> list[_Way]:
        """The ways to make an expression about the link at a place true or false. The empty one: it is so already."""
        scope = self._scope._replace(link=links[k], directives=links)
        if bool(evaluate(node, scope)) == wanted:
            return [()]
        match node:
            case Logic(word="not", parts=(part,)):
                return self._ways(part, k, links, wanted=not wanted)
            case Logic(word=word, parts=parts):
                each = [self._ways(part, k, links, wanted=wanted) for part in parts]
                return _of_all(each) if (word == "and") == wanted else [way for ways in each for way in ways]
            case LinksTerm(function="any_link", body=body):
                each = [self._ways(body, place, links, wanted=wanted) for place in range(len(links))]
                return [way for ways in each for way in ways] if wanted else _of_all(each)
            case Name(word=word) if word in DECISIONS:
                return [((k, (word, "==", float(wanted))),)]
            case Binary(sign=sign, left=left, right=right) if sign in COMPARE:
                how = sign if wanted else _OPPOSITE[sign]
                return [((k, limit),) for limit in self._bounds(how, left, right, scope)]
        return []

    def _bounds(self, sign: str, left: Node, right: Node, scope: Scope) -> Iterator[Limit]:
        """The bounds of single fields by which a comparison holds, the other fields as they are."""
        for side, other, how in ((left, right, sign), (right, left, _MIRRORED[sign])):
            if isinstance(side, Name) and side.word in DECISIONS and not _is_about_link(other):
                yield side.word, how, evaluate(other, scope)
                return
        link = link_of(scope)
        tied = sorted({n.word for side in (left, right) for n in walk(side) if isinstance(n, Name)} & DECISIONS.keys())
        for word in tied:
            ends = [_changed(link, {word: end}, self._region) or link for end in (0.0, HIGHEST[word])]
            scopes = [scope._replace(link=end) for end in ends]
            low, high = [evaluate(left, one) - evaluate(right, one) for one in scopes]
            if low * high < 0:  # as if it were linear in the field
                yield word, sign if high > low else _MIRRORED[sign], HIGHEST[word] * low / (low - high)

    def _narrowed(self, state: _State, way: _Way, text: str) -> _State | None:
        """The state with more limits; None if a link has no value within its own."""
        links, limits, changes = list(state.links), list(state.limits), list(state.changes)
        for k, limit in way:
            limits[k] = (*limits[k], limit)
        for k in {k for k, _ in way}:
            moved = self._moved(self._base[k], limits[k])
            if moved is None:
                return None
            links[k], changes[k] = moved
        because = (*state.because, *((k, text) for k in dict.fromkeys(k for k, _ in way)))
        return state._replace(links=tuple(links), limits=tuple(limits), changes=tuple(changes), because=because)

    def _moved(self, link: Directive, limits: Sequence[Limit]) -> tuple[Directive, tuple[int, float]] | None:
        """A directive with each field moved into its limits, and what that changes; None if a field has no value there."""
        wanted, moved = dict[str, Any](), link
        for _ in range(2):  # what a lower or higher rung takes with it has limits, too
            for word in dict.fromkeys(word for word, _, _ in limits):
                mine = [(sign, side) for of, sign, side in limits if of == word]
                if all(COMPARE[sign](_value(moved, word), side) for sign, side in mine):
                    continue
                near = _value(link if word == "rho" else moved, word)
                values = [v for v in (near, *_near(word, mine)) if all(COMPARE[sign](v, side) for sign, side in mine)]
                if not values:
                    return None
                wanted[word] = min(values, key=lambda v, near=near: abs(v - near))  # type: ignore[misc]
            found = _changed(link, wanted, self._region)
            if found is None:
                return None
            moved = found
        away = [abs(x - _value(link, word)) / HIGHEST[word] for word, x in wanted.items()]
        return moved, (sum(1 for x in away if x > 0), math.fsum(away))


def _of_all(each: Sequence[Sequence[_Way]]) -> list[_Way]:
    """The ways that take one way of each."""
    chosen = itertools.islice(itertools.product(*each), MOST_STEPS)
    return [tuple(limit for way in ways for limit in way) for ways in chosen]


def _reason(texts: Iterable[str], decided: Directive) -> str:
    was = f"{NAME_OF[Representation(decided.representation)]} at {decided.rate_hz:g} Hz: {decided.reason}"
    return f"{MARK}{'; '.join(texts)} (decided {was})"


def _is_about_link(node: Node) -> bool:
    """Whether it depends on directives that may change."""
    return any(isinstance(n, LinksTerm) or (isinstance(n, Name) and n.word in DECISIONS) for n in walk(node))


def _value(directive: Directive, word: str) -> Any:
    """A field as invariants compare it."""
    raw = DECISIONS[word].raw
    assert raw is not None  # noqa: S101 - every decision has it
    return raw(directive)


def _near(word: str, limits: Sequence[tuple[str, Any]]) -> list[Any]:
    """Values of a field at its limits, on both sides of them, and at the bounds of the contract."""
    edges = [side for _, side in limits if math.isfinite(side)]
    if word == "representation":  # uncertain boxes and codes only where an invariant names them
        return sorted({0.0, 1.0, 2.0, 3.0, 4.0, *(float(edge) for edge in edges if edge in AT_LEVEL)})
    if word == "roi":
        return [0.0, 1.0]
    if word == "duty":
        edges = [math.floor(edge * 100 + by) / 100 for edge in edges for by in (-1, 0, 1, 2)]
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
