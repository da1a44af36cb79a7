"""What lines about time need to know of a drone's earlier decisions: its links' changes, and what is broken since when."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

from sortie.policies.contract import Directive, nothing
from sortie.policies.damping import is_climb, is_switch
from sortie.policies.verification.invariants.language import Invariant, Recent
from sortie.policies.verification.invariants.words import Span, seconds

ROUNDING_S = 1e-6
"""Tolerance of times: frames of 0.1 s are not exactly as long."""
_COUNTED = {"climbs_in": is_climb, "switches_in": is_switch}


class Broken(Protocol):
    """A line that is broken at one decision: by which link (−1: by all together)."""

    @property
    def line(self) -> str: ...
    @property
    def peer(self) -> int: ...


AnyBroken = TypeVar("AnyBroken", bound=Broken)


class _Lasting(NamedTuple):
    since_s: float
    latest: Broken


class Past:
    """One drone's past, as far as its lines about time reach back.

    Args:
        rules: the lines.
        dwell_s: the flight's dwell time.
    """

    def __init__(self, rules: Sequence[Invariant], dwell_s: float) -> None:
        self.now_s = 0.0
        self._dwell_s = dwell_s
        spans: dict[str, float] = {}
        for node in (n for rule in rules for n in rule.nodes):
            if isinstance(node, Recent):
                spans[node.change] = max(spans.get(node.change, 0.0), seconds(node.span, dwell_s))
        self._spans = spans
        self._links: dict[int, Directive] = {}
        self._changed_s: dict[tuple[str, int], list[float]] = {}
        self._lasting: dict[tuple[str, int], _Lasting] = {}

    def note(self, now_s: float, acting: Sequence[Directive]) -> None:
        """Take in what the gates enforce from now on; call once a decision, before lines are judged."""
        self.now_s = now_s
        if not self._spans:
            return
        for directive in acting:
            peer = directive.destination
            before = self._links.get(peer) or nothing(directive.source, peer, "")
            self._links[peer] = directive
            for change, span_s in self._spans.items():
                known = self._changed_s.setdefault((change, peer), [])
                if _COUNTED[change](before, directive):
                    known.append(now_s)
                while known and known[0] <= now_s - span_s + ROUNDING_S:
                    known.pop(0)

    def count(self, change: str, peer: int, span: Span) -> int:
        """How often a link changed in the last time, now included."""
        since_s = self.now_s - seconds(span, self._dwell_s) + ROUNDING_S
        return sum([1 for t_s in self._changed_s.get((change, peer), ()) if t_s > since_s])

    def overdue(self, rule: Invariant, broken: Sequence[AnyBroken]) -> list[AnyBroken]:
        """Of a line `within T s: …`, what has been broken for more than T s without a break.

        Args:
            rule: the line.
            broken: what breaks its requirement at this decision; call once a decision, also where nothing does.

        Returns:
            Those that are overdue; one that ends at this decision is among them if it lasted too long.
        """
        if rule.within is None:
            return list(broken)
        now = {(b.line, b.peer): b for b in broken}
        limit_s, found = seconds(rule.within, self._dwell_s) + ROUNDING_S, []
        for key, lasting in [(k, v) for k, v in self._lasting.items() if k[0] == rule.text]:
            if self.now_s - lasting.since_s > limit_s:
                found.append(now.get(key, lasting.latest))
            if key not in now:
                del self._lasting[key]
        for key, one in now.items():
            since_s = self._lasting[key].since_s if key in self._lasting else self.now_s
            self._lasting[key] = _Lasting(since_s, one)
        return found  # type: ignore[return-value]
