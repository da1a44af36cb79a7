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
from functools import partial
from typing import Any, NamedTuple

from sortie.policies.checks import check_directives
from sortie.policies.contract import DETACHED_AFTER_PERIODS, Directive, Disc, FleetView, Policy, PolicyError, nothing
from sortie.policies.damping import EPSILON_S, DampedLink, damp, is_climb, is_switch, lower_of
from sortie.policies.plane_rules import PlaneRules
from sortie.policies.staleness import cap_by_age
from sortie.policies.verification.enforced import effective
from sortie.policies.verification.invariants.language import Invariant, Recent, violations
from sortie.policies.verification.invariants.past import ROUNDING_S
from sortie.policies.verification.invariants.words import Span, seconds
from sortie.policies.verification.proof.allowed import why_not_provable
from sortie.policies.verification.proof.ranges import FleetOfRanges, region_axes
from sortie.policies.verification.proof.search import Run, rosters
from sortie.policies.verification.proof.symbols import Path, Ranged, Refused, explore

MOST_CELLS, MOST_STATES = 3_000, 100_000
MOST_TUPLES = 400
"""Combinations of directives of all links on which a line over all links is judged in one cell."""
MOST_DIRECTIVES = 40
MOST_COUNT = 9
"""Up to so many changes of a link are judged; a sequence that has more within the span ends the proof."""
_REGION = Disc(0.0, 0.0, 32.0)
_AT_REST = nothing(0, 0, "")


class NotFinite(Exception):
    """Why a line is not proved."""


class Letter(NamedTuple):
    """What one decision brings; directives by their numbers."""

    links: tuple[tuple[int, int], ...]
    """Each peer's directive within what its age allows."""
    broken: frozenset[tuple[int, ...]]
    """Enforced directives by which the line is then broken: those of all links, or that of one link with its peer's number
    before it and its count of changes after it."""


def prove_over_time(policy: Policy, rule: Invariant, plane: PlaneRules, drones: int) -> str:
    """Prove a line about time for fleets of two drones and more, and say what the proof covers.

    Raises:
        NotFinite: it is not proved; the text says why.
    """
    for what, is_so in (
        ("a shield", plane.shielded),
        ("rosters", plane.roster),
        ("fresh directives", rule.needs_fresh),
        ("another limit of attachment", plane.detached_after_periods != DETACHED_AFTER_PERIODS),
    ):
        if is_so:
            raise NotFinite(f"no proof follows {what}")
    proof, covered, states, why = _Proof(policy, rule, plane), 1, 0, why_not_provable(policy)
    if why:
        raise NotFinite(f"it {why}")
    for size in range(2, drones + 1):
        try:
            states += proof.follow(size)
        except Refused as refused:
            raise NotFinite(f"it {refused}") from None
        except NotFinite as error:
            if covered < 2:
                raise
            why = f"; fleets of {size}: {error}"
            break
        covered = size
    return f"all sequences of views of up to {covered} drones, at a dwell time of {plane.dwell_s:g} s, {states} states{why}"


class _Proof:
    """A line and the directives that links may enforce, which larger fleets add to."""

    def __init__(self, policy: Policy, rule: Invariant, plane: PlaneRules) -> None:
        recent = {(n.change, n.span) for n in rule.nodes if isinstance(n, Recent)}
        self._alone = rule.of_link and not rule.over_links
        if recent and (not self._alone or rule.within is not None):
            raise NotFinite("no proof follows counts of changes together with functions over links or a time")
        if len(recent) > 1:
            raise NotFinite("no proof follows two counts of changes")
        self._policy, self._rule, self._plane, self._cells = policy, rule, plane, 0
        self._change, span = next(iter(recent), ("", 0.0))
        self._span_s = seconds(span, plane.dwell_s)
        self._limit_s = None if rule.within is None else seconds(rule.within, plane.dwell_s) + ROUNDING_S
        self._known: dict[Directive, int] = {_AT_REST: 0}
        """Directives without their ends, and their numbers."""
        self._done = set[tuple[frozenset[Letter], int]]()

    def follow(self, size: int) -> int:
        """Follow every sequence of views of fleets of one size; how many states there are that are not done yet."""
        by_ego, states = self._letters(size), 0
        links = _Links(self._plane, tuple(self._known))
        for letters in by_ego.values():
            peers = sorted({peer for letter in letters for peer, _ in letter.links})
            each = [frozenset(_of_link(letter, p) for letter in letters) for p in peers] if self._alone else [letters]
            for mine in map(frozenset, each):
                if (mine, len(self._known)) not in self._done:
                    self._done.add((mine, len(self._known)))
                    states += self._follow(mine, links)
        return states

    # --- what one decision can bring

    def _letters(self, size: int) -> dict[int, set[Letter]]:
        """By ego, all letters."""
        while True:
            before = len(self._known)
            by_ego: dict[int, set[Letter]] = {}
            for ego, heard in rosters(size):
                found = by_ego.setdefault(ego, set())
                for path, decided in explore(partial(self._run, size, ego, heard)):
                    decided.compare()
                    found.update(path.within(partial(self._letter, decided)))
                    self._cells += 1
                    if self._cells > MOST_CELLS:
                        raise NotFinite(f"more than {MOST_CELLS} cells of views")
            self._close()
            if len(self._known) == before:
                return by_ego

    def _run(self, size: int, ego: int, heard: tuple[int, ...], path: Path) -> Run:
        return Run(self._policy, FleetOfRanges(path, size, ego, heard, self._plane.descriptor_period_s))

    def _letter(self, decided: Run) -> Letter:
        """The letter of one cell of the policy, which ages and the line divide further."""
        view = decided.now()
        try:
            answer = decided.decide(view)
            check_directives(answer, view)
        except PolicyError as error:
            raise NotFinite(f"it breaks the contract: {error}") from None
        except Exception as error:
            raise NotFinite(f"it raises {type(error).__name__}: {error}") from None
        asked, links = {d.destination: _plain(d, view.ego) for d in answer}, list[tuple[int, int]]()
        for peer in decided.system.peers:
            capped = cap_by_age(asked.get(peer, _AT_REST), self._plane.health(view.age_s[peer]), None)
            links.append((peer, self._known.setdefault(capped._replace(reason=""), len(self._known))))
        return Letter(tuple(links), frozenset(self._broken(view, [peer for peer, _ in links])))

    def _broken(self, view: FleetView, peers: Sequence[int]) -> Iterator[tuple[int, ...]]:
        """By which of the known directives the line is broken on a view."""
        known, ends = tuple(self._known), [partial(Directive._replace, source=view.ego, destination=p) for p in peers]
        if self._alone:
            counts = range(MOST_COUNT + 1 if self._change else 1)
            for (peer, with_ends), (number, one), count in itertools.product(
                zip(peers, ends, strict=True), enumerate(known), counts
            ):
                if violations(self._rule, view, [effective(with_ends(one))], (), _Fixed(count)):
                    yield peer, number, count
            return
        if len(known) ** len(peers) > MOST_TUPLES:
            raise NotFinite(f"{len(known)} directives of {len(peers)} links are too many combinations")
        for numbers in itertools.product(range(len(known)), repeat=len(peers)):
            acting = [effective(with_ends(known[k])) for with_ends, k in zip(ends, numbers, strict=True)]
            if violations(self._rule, view, acting):
                yield numbers

    def _close(self) -> None:
        """Add the lower ones of all pairs of directives, until there are no more."""
        while True:
            known = tuple(self._known)
            for a, b in itertools.product(known, repeat=2):
                self._known.setdefault(lower_of(a, b)._replace(reason=""), len(self._known))
            if len(self._known) > MOST_DIRECTIVES:
                raise NotFinite("its directives take too many values")
            if len(self._known) == len(known):
                return

    # --- all sequences

    def _follow(self, letters: frozenset[Letter], links: _Links) -> int:
        """How many states there are, from links that carry nothing.

        Raises:
            NotFinite: a state breaks the line, or there are too many.
        """
        first: _State = ((), (), -1)
        met, waiting = {first}, [first]
        while waiting:
            state = waiting.pop()
            for letter in letters:
                after = self._after(state, letter, links)
                if after is not None and after not in met:
                    met.add(after)
                    waiting.append(after)
            if len(met) > MOST_STATES:
                raise NotFinite(f"more than {MOST_STATES} states")
        return len(met)

    def _after(self, state: _State, letter: Letter, links: _Links) -> _State | None:
        """The next state; None where a drone would leave the view."""
        before, changes, since = dict(state[0]), state[1], state[2]
        if not before.keys() <= {peer for peer, _ in letter.links}:
            return None
        frame_s, moves = self._plane.period_s, [links.move(before.get(peer, 0), d) for peer, d in letter.links]
        key = tuple([move.enforced for move in moves])
        if self._alone and moves:
            changed = moves[0].climbs if self._change == "climbs_in" else moves[0].switches
            changes = (*changes, 0) if self._change and changed else changes
            if len(changes) > MOST_COUNT:
                raise NotFinite(f"a link changes more than {MOST_COUNT} times within {self._span_s:g} s")
            key = (*key, len(changes))
        broken = key in letter.broken
        if broken if self._limit_s is None else since * frame_s > self._limit_s:
            raise NotFinite("a sequence of views breaks it, though with jumps that courses do not have")
        since = max(since, 0) + 1 if broken else -1
        changes = tuple([a + 1 for a in changes if (a + 1) * frame_s < self._span_s - ROUNDING_S])
        then = tuple([(peer, move.then) for (peer, _), move in zip(letter.links, moves, strict=True)])
        return then, changes, since


@dataclass(frozen=True)
class _Fixed:
    """A past in which every link changed so often."""

    times: int

    def count(self, change: str, peer: int, span: Span) -> int:
        """So often."""
        return self.times


def _of_link(letter: Letter, peer: int) -> Letter:
    """One link's part of a letter, without the peer's number."""
    links = tuple((0, number) for p, number in letter.links if p == peer)
    return Letter(links, frozenset(b[1:] for b in letter.broken if b[0] == peer) if links else frozenset())


def _plain(d: Directive, ego: int) -> Directive:
    """A directive of plain values without its ends; the ego's own region, as it is, is the one region."""
    roi: Any = d.roi
    if roi is not None:
        own = [(axis, ()) for axis in region_axes(ego)]
        if [(part._axis, part._steps) for part in roi if isinstance(part, Ranged)] != own:
            raise NotFinite("its directives have regions other than the drone's own")
        d = d._replace(roi=_REGION)
    d = d._replace(source=0, destination=0, reason="")
    if any(isinstance(value, Ranged) for value in tuple.__iter__(d)):
        raise NotFinite("its directives take too many values: a number of the view goes into them")
    return d


_State = tuple[tuple[tuple[int, int], ...], tuple[int, ...], int]
"""Each peer's link, how many frames ago the only link changed, and how long the line is broken, frames (−1: it holds)."""


class _Move(NamedTuple):
    """What one decision makes of a link."""

    enforced: int
    then: int
    """The link a frame later."""
    climbs: bool
    switches: bool


class _Links:
    """The states of one link, numbered; 0 carries nothing. States that `damp` cannot tell apart have one number."""

    def __init__(self, plane: PlaneRules, known: Sequence[Directive]) -> None:
        self._plane, self._known = plane, known
        self._frames = math.ceil((plane.dwell_s - EPSILON_S) / plane.period_s)
        self._merges = len({d._replace(deadline_s=0.1) for d in known}) == len(known)
        self._place = {d: k for k, d in enumerate(known)}
        self._lower = [[self._place[lower_of(a, b)._replace(reason="")] for b in known] for a in known]
        self._links: list[tuple[int, tuple[tuple[int, int], ...]]] = []
        """What a link enforces, and its proposals with their ages in frames; directives by their numbers."""
        self._numbers: dict[Any, int] = {}
        self._moves: dict[tuple[int, int], _Move] = {}
        self._number(0, ())

    def move(self, link: int, asked: int) -> _Move:
        """A link's next move where this is asked of it."""
        if (link, asked) not in self._moves:
            self._moves[link, asked] = self._damped(link, asked)
        return self._moves[link, asked]

    def _damped(self, link: int, asked: int) -> _Move:
        place, proposals = self._links[link]
        known, frame_s, enforced = self._known, self._plane.period_s, self._known[place]
        waits = tuple([(-age * frame_s, known[waiting]) for age, waiting in proposals])
        after = damp(DampedLink(enforced, waits), known[asked], 0.0, self._plane.dwell_s)
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
        return self._numbers[key]
