"""Proofs of lines about time: every sequence of views through the policy, the staleness rules and damping.

A policy whose directives take few values, together with damping, has few states: what each link enforces, what waits for
its dwell time, and how long the line has been broken. The search of cells (`policies.verification.proof.search`) finds every
combination of directives that the policy can decide, and what the line's condition is there. A search over the states then
follows every sequence of these combinations, one a frame, with `damp` itself.

A proof covers all sequences of views of fleets up to a size, even those that no flight has: a charge may rise, an age may
jump. Drones may come into view one by one; none leaves it. While a region exists, it keeps its place and radius. Decisions
are exactly a frame apart, no shield stands between, no drone publishes a roster, and one policy decides for the whole flight.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from sortie.fleet.staleness import cap_by_age, health
from sortie.policies.checks import check_directives
from sortie.policies.contract import DETACHED_AFTER_PERIODS, Directive, Disc, Policy, PolicyError, nothing
from sortie.policies.damping import EPSILON_S, DampedLink, damp, is_climb, is_switch, lower_of
from sortie.policies.verification.budget import Budget
from sortie.policies.verification.enforced import effective
from sortie.policies.verification.invariants.language import Invariant, LinksTerm, Recent, violations
from sortie.policies.verification.invariants.past import ROUNDING_S
from sortie.policies.verification.invariants.words import DWELL, Span
from sortie.policies.verification.proof.allowed import why_not_provable
from sortie.policies.verification.proof.ranges import FleetOfRanges, region_axes
from sortie.policies.verification.proof.search import Run, rosters
from sortie.policies.verification.proof.symbols import Path, Ranged, Refused, explore
from sortie.scenarios.plugins.user_calls import text_of
from sortie.sim.check.closed_loop import PlaneTimes

MOST_STATES = 200_000
MOST_TUPLES = 400
"""Combinations of directives of all links on which a line over all links is judged in one cell."""
MOST_DIRECTIVES = 40
MOST_COUNT = 9
"""Up to so many changes of a link are judged; a sequence that has more within the span ends the proof."""
_REGION = Disc(0.0, 0.0, 32.0)


class NotFinite(Exception):
    """Why a line is not proved."""


class Letter(NamedTuple):
    """What one decision brings: each peer's directive within what its age allows, and where the line is then broken."""

    links: tuple[tuple[int, Directive], ...]
    broken: frozenset[Any]
    """By the directives that the gates enforce: those of one link and its count of changes, or those of all links."""


def prove_over_time(policy: Policy, rule: Invariant, times: PlaneTimes, drones: int, budget: Budget) -> str:
    """Prove a line about time, and say what the proof covers.

    Raises:
        NotFinite: it is not proved; the text says why.
    """
    unfollowed = {
        "a shield": times.shielded,
        "rosters": times.has_rosters,
        "fresh directives": rule.needs_fresh,
        "another limit of attachment": times.detached_after_periods != DETACHED_AFTER_PERIODS,
    }
    for what, is_so in unfollowed.items():
        if is_so:
            raise NotFinite(f"no proof follows {what}")
    counts = any(isinstance(n, Recent) for n in rule.nodes)
    alone = rule.of_link and not any(isinstance(n, LinksTerm) for n in rule.nodes)
    if counts and (not alone or rule.within is not None):
        raise NotFinite("no proof follows counts of changes together with functions over links or a time")
    covered, states, why = 1, 0, ""
    done: set[tuple[frozenset[Letter], tuple[Directive, ...]]] = set()
    for size in range(2, drones + 1):
        try:
            states += _prove_size(policy, rule, times, size, alone, budget, done)
        except Refused as refused:
            raise NotFinite(f"it {refused}") from None
        except NotFinite as error:
            if covered < 2:
                raise
            why = f"; fleets of {size}: {error}"
            break
        covered = size
    if covered < 2:
        raise NotFinite("a drone alone has no links")
    return f"all sequences of views of up to {covered} drones, at a dwell time of {times.dwell_s:g} s, {states} states{why}"


def _prove_size(
    policy: Policy,
    rule: Invariant,
    times: PlaneTimes,
    size: int,
    alone: bool,
    budget: Budget,
    done: set[tuple[frozenset[Letter], tuple[Directive, ...]]],
) -> int:
    """Follow every sequence of views of fleets of one size; how many states there are that are not done yet."""
    by_ego, directives = _letters(policy, rule, times, size, alone, budget)
    states = 0
    for letters in by_ego.values():
        peers = sorted({peer for letter in letters for peer, _ in letter.links})
        groups = [(peer,) for peer in peers] if alone else [tuple(peers)]
        for group in groups:
            mine = frozenset(_projected(letter, group) for letter in letters) if alone else frozenset(letters)
            if (mine, directives) not in done:
                done.add((mine, directives))
                states += _Checker(rule, times, directives, alone, budget).follow(mine)
    return states


def _projected(letter: Letter, group: Sequence[int]) -> Letter:
    """One link's part of a letter, without the peer's number."""
    (peer,) = group
    links = tuple((0, d) for p, d in letter.links if p == peer)
    return Letter(links, frozenset(b[1:] for b in letter.broken if b[0] == peer) if links else frozenset())


# --- what one decision can bring -----------------------------------------------------------------


def _letters(
    policy: Policy, rule: Invariant, times: PlaneTimes, size: int, alone: bool, budget: Budget
) -> tuple[dict[int, set[Letter]], tuple[Directive, ...]]:
    """By ego, all letters; and all directives that a link may enforce, without their ends."""
    why = why_not_provable(policy)
    if why:
        raise NotFinite(f"it {why}")
    known: dict[Directive, None] = {_bare(nothing(0, 0, "")): None}
    while True:
        before = len(known)
        by_ego: dict[int, set[Letter]] = {}
        for ego, heard in rosters(size):
            found: set[Letter] = by_ego.setdefault(ego, set())

            def run(path: Path, ego: int = ego, heard: tuple[int, ...] = heard) -> Run:
                return Run(policy, FleetOfRanges(path, size, ego, heard, times.period_s))

            for path, decided in explore(run):
                decided.compare()
                found.update(_letters_of(path, decided, rule, times, alone, known))
                if budget.is_spent:
                    raise NotFinite(f"the time of {budget.budget_s:g} s ended")
        _close(known)
        if len(known) == before:
            return by_ego, tuple(known)


def _letters_of(
    path: Path, decided: Run, rule: Invariant, times: PlaneTimes, alone: bool, known: dict[Directive, None]
) -> Iterator[Letter]:
    """The letters of one cell of the policy, which ages and the line divide further."""

    def act() -> Letter:
        view = decided.now()
        try:
            answer = decided.decide(view)
            check_directives(answer, view)
        except PolicyError as error:
            raise NotFinite(f"it breaks the contract: {error}") from None
        except Exception as error:
            raise NotFinite(f"it raises {type(error).__name__}: {text_of(error, str)}") from None
        asked = {d.destination: _plain(d, view.ego) for d in answer}
        links = []
        for peer in decided.system.peers:
            fidelity = health(
                view.age_s[peer], times.period_s, times.degraded_after_periods, times.detached_after_periods
            )
            one = asked.get(peer) or nothing(view.ego, peer, "")
            links.append((peer, cap_by_age(one, fidelity, None)._replace(reason="")))
        for _, one in links:
            known.setdefault(_bare(one))
        return Letter(
            tuple((p, _bare(one)) for p, one in links),
            frozenset(_broken(rule, view, [p for p, _ in links], tuple(known), alone)),
        )

    for letter in path.within(act):
        if path.refusal is not None:
            why, path.refusal = path.refusal, None
            raise Refused(why)
        yield letter


def _broken(rule: Invariant, view: Any, peers: Sequence[int], known: Sequence[Directive], alone: bool) -> Iterator[Any]:
    """Where a line is broken on a view, by what its links enforce."""
    me = view.ego
    if not alone:
        if len(known) ** len(peers) > MOST_TUPLES:
            raise NotFinite(f"{len(known)} directives of {len(peers)} links are too many combinations")
        for combination in itertools.product(known, repeat=len(peers)):
            acting = [effective(d._replace(source=me, destination=p)) for p, d in zip(peers, combination, strict=True)]
            if violations(rule, view, acting):
                yield combination
        return
    counts = range(MOST_COUNT + 1) if any(isinstance(n, Recent) for n in rule.nodes) else (0,)
    for peer, one, count in itertools.product(peers, known, counts):
        if violations(rule, view, [effective(one._replace(source=me, destination=peer))], (), _Fixed(count)):
            yield peer, one, count


@dataclass(frozen=True)
class _Fixed:
    """A past in which every link changed so often."""

    times: int

    def count(self, change: str, peer: int, span: Span) -> int:
        """So often."""
        return self.times


def _bare(d: Directive) -> Directive:
    return d._replace(source=0, destination=0, reason="")


def _plain(d: Directive, ego: int) -> Directive:
    """A directive of plain values; the ego's own region, as it is, is the one region."""
    roi: Any = d.roi
    if roi is not None:
        own = [(axis, ()) for axis in region_axes(ego)]
        if [(part._axis, part._steps) for part in roi if isinstance(part, Ranged)] != own:
            raise NotFinite("its directives have regions other than the drone's own")
        d = d._replace(roi=_REGION)
    if any(isinstance(value, Ranged) for value in tuple.__iter__(d._replace(reason=""))):
        raise NotFinite("its directives take too many values: a number of the view goes into them")
    return d._replace(reason="")


def _close(known: dict[Directive, None]) -> None:
    """Add the lower ones of all pairs, until there are no more."""
    while True:
        lower = {lower_of(a, b)._replace(reason="") for a in known for b in known} - known.keys()
        if not lower:
            return
        known.update(dict.fromkeys(lower))
        if len(known) > MOST_DIRECTIVES:
            raise NotFinite("its directives take too many values")


# --- all sequences -------------------------------------------------------------------------------

_State = tuple[tuple[tuple[int, int], ...], tuple[int, ...], int]
"""Each peer's link by its number, how many frames ago the only link changed, and for how many frames the line has been
broken (−1: it holds)."""


class _Checker:
    """Follows every sequence of letters from links that carry nothing."""

    def __init__(
        self, rule: Invariant, times: PlaneTimes, known: Sequence[Directive], alone: bool, budget: Budget
    ) -> None:
        recent = {(n.change, n.span) for n in rule.nodes if isinstance(n, Recent)}
        if len(recent) > 1:
            raise NotFinite("no proof follows two counts of changes")
        self._change, span = next(iter(recent), ("", 0.0))
        self._times, self._alone, self._budget = times, alone, budget
        self._span_s = self._seconds(span)
        self._limit_s = None if rule.within is None else self._seconds(rule.within) + ROUNDING_S
        self._damping = _Damping(times, known)

    def _seconds(self, span: Span) -> float:
        return self._times.dwell_s if span == DWELL else span

    def follow(self, letters: frozenset[Letter]) -> int:
        """How many states there are.

        Raises:
            NotFinite: a state breaks the line, or there are too many.
        """
        first: _State = ((), (), -1)
        met, waiting, numbered = {first}, [first], [self._damping.numbered(letter) for letter in letters]
        while waiting:
            state = waiting.pop()
            for letter in numbered:
                after = self._after(state, letter)
                if after is not None and after not in met:
                    met.add(after)
                    waiting.append(after)
            if len(met) > MOST_STATES:
                raise NotFinite(f"more than {MOST_STATES} states")
            if self._budget.is_spent:
                raise NotFinite(f"the time of {self._budget.budget_s:g} s ended")
        return len(met)

    def _after(self, state: _State, letter: _Numbered) -> _State | None:
        """The next state; None where a drone would leave the view."""
        links, changes, since = state
        before, frame_s = dict(links), self._times.frame_s
        if len(before) > len(letter.links) or not before.keys() <= {peer for peer, _ in letter.links}:
            return None
        moves = [(peer, self._damping.move(before.get(peer, 0), asked)) for peer, asked in letter.links]
        if self._limit_s is not None and since * frame_s > self._limit_s:
            raise _broken_somewhere()
        if self._alone:
            for _, move in moves:
                changed = move.climbs if self._change == "climbs_in" else move.switches
                changes = (*changes, 0) if self._change and changed else changes
                if len(changes) > MOST_COUNT:
                    raise NotFinite(f"a link changes more than {MOST_COUNT} times within {self._span_s:g} s")
                broken = (move.enforced, len(changes)) in letter.broken
            broken = broken if moves else False
        else:
            broken = tuple([move.enforced for _, move in moves]) in letter.broken
        if broken and self._limit_s is None:
            raise _broken_somewhere()
        since = -1 if not broken else max(since, 0) + 1
        changes = tuple([a + 1 for a in changes if (a + 1) * frame_s < self._span_s - ROUNDING_S])
        return tuple([(peer, move.then) for peer, move in moves]), changes, since


class _Numbered(NamedTuple):
    """A letter with numbers in place of directives."""

    links: tuple[tuple[int, int], ...]
    broken: frozenset[Any]


class _Move(NamedTuple):
    """What one decision makes of a link."""

    enforced: int
    then: int
    """The link a frame later."""
    climbs: bool
    switches: bool


class _Damping:
    """The states of one link, numbered; 0 carries nothing. States that `damp` cannot tell apart have one number."""

    def __init__(self, times: PlaneTimes, known: Sequence[Directive]) -> None:
        self._times = times
        self._frames = math.ceil((times.dwell_s - EPSILON_S) / times.frame_s)
        self._merges = len({d._replace(deadline_s=0.1) for d in known}) == len(known)
        self._known, self._place = known, {d: k for k, d in enumerate(known)}
        self._lower = [[self._place[lower_of(a, b)] for b in known] for a in known]
        self._links: list[_Waiting] = []
        self._numbers: dict[Any, int] = {}
        self._moves: list[dict[int, _Move]] = []
        self._number(0, ())

    def numbered(self, letter: Letter) -> _Numbered:
        """A letter with numbers in place of directives."""
        place = self._place
        broken = frozenset(tuple([place.get(x, x) for x in b]) for b in letter.broken)
        return _Numbered(tuple([(peer, place[d]) for peer, d in letter.links]), broken)

    def move(self, number: int, asked: int) -> _Move:
        """A link's next move where this is asked of it."""
        moves = self._moves[number]
        if asked not in moves:
            moves[asked] = self._moved(number, asked)
        return moves[asked]

    def _moved(self, number: int, asked: int) -> _Move:
        place, proposals = self._links[number]
        known, frame_s, enforced = self._known, self._times.frame_s, self._known[place]
        waits = tuple([(-age * frame_s, known[waiting]) for age, waiting in proposals])
        after = damp(DampedLink(enforced, waits), known[asked], 0.0, self._times.dwell_s)
        aged = [(min(round(-since_s / frame_s) + 1, self._frames), self._place[d]) for since_s, d in after.proposals]
        then = self._place[after.enforced]
        acting = effective(enforced), effective(known[then])
        return _Move(then, self._number(then, tuple(aged)), is_climb(*acting), is_switch(*acting))

    def _number(self, enforced: int, aged: tuple[tuple[int, int], ...]) -> int:
        """The number of a link: `damp` reads of its proposals what is least since each moment of the dwell time.

        That is a fold from the oldest on, so what comes later adds to it; and which proposal was the last.
        """
        recent = [one for k, one in enumerate(aged) if k + 1 == len(aged) or aged[k + 1][0] < self._frames]
        key: Any = (enforced, tuple(recent))
        if self._merges and recent:
            least: list[tuple[int, int]] = []
            for k, (age, fold) in enumerate(recent):
                for _, later in recent[k + 1 :]:
                    fold = self._lower[fold][later]
                if not least or least[-1][1] != fold:
                    least.append((age, fold))
            key = (enforced, tuple(least), recent[-1][1])
        if key not in self._numbers:
            self._numbers[key] = len(self._links)
            self._links.append((enforced, tuple(recent)))
            self._moves.append({})
        return self._numbers[key]


_Waiting = tuple[int, tuple[tuple[int, int], ...]]
"""What a link enforces, and its proposals with their ages in frames; directives by their numbers."""


def _broken_somewhere() -> NotFinite:
    return NotFinite("a sequence of views breaks it, though with jumps that courses do not have")
