"""Invariants judged on what a drone's gates enforce, with the step that broke them.

A directive goes from the policy through the staleness rules and damping to the gate. Each step may break a line that the
policy keeps. A violation names the first step after which the line is broken:

| cause | the line is broken |
|---|---|
| `policy` | by what the policy decided about attached peers, after its shield |
| `staleness` | by the caps on links to degraded and detached peers |
| `damping` | by a link that still waits for its dwell time, or by links of which only some were lowered |
| `no peer` | a line over all links, while no peer is attached |

A line `within T s: …` names the step that broke it at the last decision with the break. A line that counts changes
names the policy, which asked for them.

The shield at the gate (`put_right`) may lower and raise links at once, without the dwell time. It never gives a link more
than the age of the peer's descriptor allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.decision_loop import Steps
from sortie.policies.staleness import CEILING, Ceilings
from sortie.policies.verification.invariants.language import Invariant, describe_directives, violations
from sortie.policies.verification.invariants.past import Past
from sortie.policies.verification.shield import enforce

POLICY, STALENESS, DAMPING, NO_PEER = "policy", "staleness", "damping", "no peer"
CAUSES = (POLICY, STALENESS, DAMPING, NO_PEER)


class Violation(NamedTuple):
    """A line that the enforced directives break."""

    line: str
    peer: int
    """Of the link that breaks it; −1 where a drone's links break it together."""
    cause: str
    what: str
    """The directives that break it, in words."""


class Keeper:
    """The guard of one drone's decision loop: judges its invariants, and with a shield keeps them.

    Args:
        rules: the invariants.
        dwell_s: the flight's dwell time, which lines about time may name.
        shielded: whether directives that break an invariant are replaced.
    """

    def __init__(self, rules: Sequence[Invariant], dwell_s: float, shielded: bool) -> None:
        self.rules, self.shielded = tuple(rules), shielded
        self.needs_fresh = any(rule.needs_fresh for rule in rules)
        self.past = Past(self.rules, dwell_s)
        self.replaced: dict[int, Directive] = {}
        """What the shield put in force at the latest decision in place of what damping left, by peer."""
        self.broken: list[Violation] = []
        """What the gates break since the latest decision."""
        self._fresh: Sequence[Directive] = ()

    def correct(
        self, view: FleetView, decided: Sequence[Directive], fresh: Sequence[Directive] = ()
    ) -> Sequence[Directive]:
        """A policy's answer; with a shield, its directives that break an invariant are replaced.

        Args:
            view: the policy's input.
            decided: its answer, checked against the contract.
            fresh: its answer at age 0, if `needs_fresh`.
        """
        self._fresh = fresh
        return enforce(self.rules, view, decided, fresh) if self.shielded else decided

    def __call__(self, view: FleetView, now_s: float, links: Sequence[Steps]) -> list[Directive]:
        """What the gates enforce, of what staleness and damping left. The shield gives no link more than its age allows."""
        enforced = damped = [link.damped for link in links]
        if self.shielded:
            ceilings = {link.damped.destination: CEILING[link.health] for link in links}
            enforced = put_right(self.rules, view, damped, self._fresh, ceilings)
        self.replaced = {d.destination: d for before, d in zip(damped, enforced, strict=True) if d is not before}
        self.past.note(now_s, [effective(d) for d in enforced])
        self.broken = judge(self.rules, view, links, enforced, self._fresh, self.past)
        return enforced


def effective(directive: Directive) -> Directive:
    """The directive as the gate acts on it: at a rate of 0 nothing is sent, whatever the representation."""
    if directive.rate_hz > 0 or directive.representation == Representation.NONE:
        return directive
    return directive._replace(representation=Representation.NONE, rho=0.0)


def put_right(
    rules: Sequence[Invariant],
    view: FleetView,
    damped: Sequence[Directive],
    fresh: Sequence[Directive],
    ceilings: Ceilings | None,
) -> list[Directive]:
    """The nearest directives that keep the rules below their ceilings; those that nothing can mend stay as they are."""
    acting = [effective(d) for d in damped]
    shielded = enforce(rules, view, acting, fresh, ceilings)
    return [before if after == seen else after for before, seen, after in zip(damped, acting, shielded, strict=True)]


def judge(
    rules: Sequence[Invariant],
    view: FleetView,
    links: Sequence[Steps],
    enforced: Sequence[Directive],
    fresh: Sequence[Directive] = (),
    past: Past | None = None,
) -> list[Violation]:
    """The rules that the enforced directives break, each with its cause.

    Args:
        rules: the invariants.
        view: what the drone knows at this moment.
        links: how each link's directive came about.
        enforced: what the gates hold, in the order of `links`, before the wire rounds it.
        fresh: the policy's directives at age 0, if a rule needs them.
        past: the drone's past until `past.now_s`, this decision noted in it, if a rule is about time.
    """
    acting = [effective(d) for d in enforced]
    found: list[Violation] = []
    for rule in rules:
        broken = violations(rule, view, acting, fresh, past)
        named = _with_causes(rule, view, links, acting, broken, fresh, past) if broken else []
        found += named if past is None else past.overdue(rule, named)
    return found


def _with_causes(
    rule: Invariant,
    view: FleetView,
    links: Sequence[Steps],
    acting: Sequence[Directive],
    broken: Sequence[Directive | None],
    fresh: Sequence[Directive],
    past: Past | None,
) -> list[Violation]:
    near, found = view.attached, []
    asked = _who_breaks(rule, near, [s.asked for s in links if s.asked.destination in near.age_s], fresh, past)
    by_age = _who_breaks(rule, view, [s.by_age for s in links], fresh, past)
    alone = not rule.of_link and not near.peers
    for directive in broken:
        peer = None if directive is None else directive.destination
        cause = POLICY if peer in asked else STALENESS if peer in by_age else DAMPING
        what = describe_directives(acting if directive is None else [directive])
        found.append(Violation(rule.text, -1 if peer is None else peer, NO_PEER if alone else cause, what))
    return found


def _who_breaks(
    rule: Invariant,
    view: FleetView,
    directives: Sequence[Directive],
    fresh: Sequence[Directive],
    past: Past | None,
) -> set[int | None]:
    """The peers of the links that break a rule; None for all links together."""
    broken = violations(rule, view, [effective(d) for d in directives], fresh, past)
    return {None if d is None else d.destination for d in broken}
