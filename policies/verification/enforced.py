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
from sortie.policies.verification.invariants.language import Invariant, describe_directives, violations
from sortie.policies.verification.invariants.past import Past
from sortie.policies.verification.shield import Ceilings, enforce

POLICY, STALENESS, DAMPING, NO_PEER = "policy", "staleness", "damping", "no peer"
CAUSES = (POLICY, STALENESS, DAMPING, NO_PEER)


class Steps(NamedTuple):
    """One link's directive on its way to the gate."""

    asked: Directive
    """From the policy."""
    by_age: Directive
    """After the staleness rules."""
    damped: Directive
    """After damping: what the gate enforces unless a shield steps in."""


class Violation(NamedTuple):
    """A line that the enforced directives break."""

    line: str
    peer: int
    """Of the link that breaks it; −1 where a drone's links break it together."""
    cause: str
    what: str
    """The directives that break it, in words."""


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
