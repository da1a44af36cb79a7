"""What one drone's gates enforce, from decision to decision: staleness, then damping, then the guard.

    policy ─► Directive ─► staleness ─► damping ─► guard ─► gates

The fleet's agents, live drones and the proofs over time all use this one loop. It has no clock, no radio and no random draw:
equal calls give equal directives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from sortie.policies.contract import Directive, FleetView, nothing
from sortie.policies.damping import DampedLink, damp
from sortie.policies.plane_rules import PlaneRules
from sortie.policies.staleness import LinkHealth, cap_by_age

_NOTHING = nothing(0, 1, "")[2:8]


class Steps(NamedTuple):
    """One link's directive on its way to the gate."""

    asked: Directive
    """From the policy."""
    by_age: Directive
    """After the staleness rules."""
    damped: Directive
    """After damping: what the gate enforces unless a shield steps in."""
    health: LinkHealth = LinkHealth.FRESH


Guard = Callable[[FleetView, float, Sequence[Steps]], Sequence[Directive]]
"""Judges at a time in s what staleness and damping left of every link's directive, and returns what the gates enforce."""


class OutgoingLink:
    """An outgoing link: its state of damping, what its gate enforces, and what was last asked while its peer was fresh."""

    __slots__ = ("asked", "enforced", "health", "is_at_rest", "is_busy", "peer", "state")

    def __init__(self, me: int, peer: int) -> None:
        self.peer = peer
        self.state = DampedLink(nothing(me, peer, ""))
        self.enforced = self.state.enforced
        """Before the wire rounds it."""
        self.asked: Directive | None = None
        self.health = LinkHealth.FRESH
        self.is_at_rest = False
        """Whether it carries nothing, so that age has nothing to reduce."""
        self.is_busy = False
        """Whether it may change at the next decision although the policy asks for nothing new."""


class Change(NamedTuple):
    """A gate's new directive."""

    asked: Directive
    enforced: Directive
    health: LinkHealth


class Decided(NamedTuple):
    """What one decision changed."""

    stepped: list[OutgoingLink]
    """The links that age or damping may have changed."""
    changes: list[Change]


class DecisionLoop:
    """One drone's outgoing links.

    Args:
        ego: the drone.
        rules: the plane's rules.
        guard: has the last word before the gates; None where there are no invariants.
    """

    def __init__(self, ego: int, rules: PlaneRules, guard: Guard | None = None) -> None:
        self.links: dict[int, OutgoingLink] = {}
        """By peer, in the order in which they came into view."""
        self._ego, self._rules, self._guard, self._fresh_s = ego, rules, guard, rules.fresh_s

    def decide(
        self, view: FleetView, asked_of: Mapping[int, Directive], now_s: float, peers: Iterable[int] | None = None
    ) -> Decided:
        """Take in a policy's answer to a view.

        Args:
            view: that the policy decided on.
            asked_of: the policy's directives by peer; nothing is asked of a peer that is left out.
            now_s: the drone's clock.
            peers: those whose directive is new, or whose link is busy or became too old; None: all in the view.
        """
        ego, links, fresh_s = self._ego, self.links, self._fresh_s
        stepped, changes = list[OutgoingLink](), list[Change]()
        for peer in view.age_s if peers is None else peers:
            if peer == ego:
                continue
            link = links.get(peer)
            if link is None:
                link = links[peer] = OutgoingLink(ego, peer)
            asked, age_s = self._asked(asked_of, peer), view.age_s[peer]
            is_new = asked is not link.asked and asked != link.asked
            if is_new or age_s > fresh_s or link.state.proposals:
                stepped.append(link)
                before = link.state.enforced
                self._step(link, asked, age_s, now_s)
                if self._guard is None and link.state.enforced is not before:
                    self._put_in_force(link, asked, link.state.enforced, link.health, changes)
        if self._guard is not None:
            self._keep(self._guard, view, asked_of, now_s, changes)
        return Decided(stepped, changes)

    def come_back(self) -> list[Change]:
        """Begin every link with nothing: the drone asked for nothing while it was away."""
        changes = list[Change]()
        for peer, link in self.links.items():
            rest = link.state.enforced
            if rest[2:8] != _NOTHING:
                rest = nothing(self._ego, peer, "came back")
                if self._guard is None:
                    self._put_in_force(link, rest, rest, LinkHealth.DETACHED, changes)
            link.state, link.asked = DampedLink(rest), None
        return changes

    def _asked(self, asked_of: Mapping[int, Directive], peer: int) -> Directive:
        return asked_of.get(peer) or nothing(self._ego, peer, "the policy gave no directive")

    def _step(self, link: OutgoingLink, asked: Directive, age_s: float, now_s: float) -> None:
        """Staleness, then damping."""
        before, is_aged = link.state, age_s > self._fresh_s
        link.health = self._rules.health(age_s) if is_aged else LinkHealth.FRESH
        link.asked = None if is_aged else asked
        link.is_at_rest = not before.proposals and asked[2:8] == _NOTHING and asked == before.enforced
        if link.is_at_rest:
            link.is_busy = False
            return
        link.state = damp(before, cap_by_age(asked, link.health, age_s), now_s, self._rules.dwell_s)
        link.is_busy = is_aged or bool(link.state.proposals)

    def _keep(
        self, guard: Guard, view: FleetView, asked_of: Mapping[int, Directive], now_s: float, changes: list[Change]
    ) -> None:
        """What the guard leaves of all links' directives goes to the gates, also where the policy asked nothing new."""
        steps = []
        for peer, age_s in view.age_s.items():
            if peer != self._ego:
                asked, link_health = self._asked(asked_of, peer), self._rules.health(age_s)
                damped = self.links[peer].state.enforced
                steps.append(Steps(asked, cap_by_age(asked, link_health, age_s), damped, link_health))
        for step, directive in zip(steps, guard(view, now_s, steps), strict=True):
            self._put_in_force(self.links[directive.destination], step.asked, directive, step.health, changes)

    @staticmethod
    def _put_in_force(
        link: OutgoingLink, asked: Directive, directive: Directive, link_health: LinkHealth, changes: list[Change]
    ) -> None:
        before, link.enforced = link.enforced, directive
        if directive != before:
            changes.append(Change(asked, directive, link_health))
