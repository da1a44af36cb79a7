"""Lines about several links, as the shield keeps them: what each link alone is allowed, and which links change together."""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence
from itertools import repeat
from typing import Any, NamedTuple

from sortie.policies.contract import Directive, Disc
from sortie.policies.verification.boxes import Box, box_of
from sortie.policies.verification.compiled import Context, Rule
from sortie.policies.verification.links import Ceiling, Far, Link, as_directive, distance
from sortie.policies.verification.nearest import nearest
from sortie.scenarios.representation import NAME_OF

MARK = "shield: "
MOST_CHANGES = 128
"""How many changes of links are tried in a decision, beside one of each link for each line about several links that is broken."""
Ceilings = Mapping[int, Ceiling]
"""What the link to each peer may carry at most."""


class Boxes:
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


class Together:
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

    def __init__(self, context: Context, decided: Sequence[Link], lines: Sequence[Rule], boxes: Boxes) -> None:
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
                directives[k] = replaced(decided[k], was, after, self._start.me.region, texts)
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


def replaced(before: Directive, was: Link, after: Link, region: Disc | None, texts: str) -> Directive:
    decided = f"{NAME_OF[before.representation]} at {before.rate_hz:g} Hz: {before.reason}"
    return as_directive(before, was, after, region, f"{MARK}{texts} (decided {decided})")
