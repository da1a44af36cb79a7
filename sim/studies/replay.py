"""Decide again over the views that a run kept, and compare with what was decided in flight.

The recorded world does not answer: a directive that differs changes no later view. So the first difference of a drone
shows what the other policy would have done there, and later ones what it would have done on the flight as it was flown.
What is compared is a policy's own answer. Staleness and damping come after it, and may hide a short difference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, PolicyError, Reposition, nothing
from sortie.policies.registry import viewpoint_of
from sortie.scenarios.representation import NAME_OF
from sortie.sim.engine.pilot import NamedPolicy, PolicyPlan, ask, ask_viewpoint
from sortie.sim.folders import RunError
from sortie.sim.results.disagreement import figures, measure
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.views import DECISIONS, Decision, decisions
from sortie.sim.studies.replayed import NO_PEER, Difference, Replay

_FIELDS = tuple(name for name in Directive._fields if name not in ("source", "destination", "reason"))
Choose = Callable[[Decision], NamedPolicy]
"""Which policy decides again."""


def replay(record: SortieRecord, plan: PolicyPlan, *, as_flown: bool, disagreement: bool = False) -> Replay:
    """Decide again over a run's views, in the order of flight.

    Args:
        record: of a run that kept its views.
        plan: the policies.
        as_flown: each decision by the policy that made it in flight; else all by the plan's first.
        disagreement: also measure how often two drones' views lead these policies to different choices.

    Raises:
        RunError: the run kept no views, or the plan lacks a policy that decided in flight.
        PolicyError: the policy fails on a view, or breaks the contract.
    """
    chosen = _chooser(plan) if as_flown else lambda _: plan.first
    flown, again = dict[str, None](), dict[str, None]()  # in the order of their first decision
    differences: list[Difference] = []
    decided, directives = Counter[int](), 0
    kept = list(kept_decisions(record))
    measured = None
    for decision in kept:
        policy = chosen(decision)
        flown[decision.policy] = again[policy.name] = None
        directives += len(decision.view.peers)
        differences += compare(decision, decided[decision.drone], *decide_again(policy, decision))
        decided[decision.drone] += 1
    if disagreement:
        measured = figures(measure(kept, lambda decision: chosen(decision).decide, record.scenario.frame_s))
    return Replay(", ".join(flown), ", ".join(again), len(kept), directives, tuple(differences), measured)


def kept_decisions(record: SortieRecord) -> Iterator[Decision]:
    """The decisions of a run that kept its views.

    Raises:
        RunError: it kept none.
    """
    if DECISIONS not in record.tables:
        raise RunError("the run kept no views; fly it with --set record.views=true")
    return decisions(record.tables)


def decide_again(policy: NamedPolicy, decision: Decision) -> tuple[Sequence[Directive], Reposition | None]:
    """What a policy answers to a recorded view, in the order in which a drone in flight asks.

    Raises:
        PolicyError: it fails, or breaks the contract.
    """
    viewpoint = viewpoint_of(policy.decide)
    try:
        asked = None if viewpoint is None else ask_viewpoint(policy, viewpoint, decision.view)
        directives = ask(policy, decision.view)
        check_directives(directives, decision.view)
    except PolicyError as error:
        raise PolicyError(f"at {decision.t_s:.2f} s: {error}") from error
    return directives, asked


def compare(
    decision: Decision, number: int, directives: Iterable[Directive], viewpoint: Reposition | None
) -> Iterator[Difference]:
    """The links of one decision on which another answer differs; a link without a directive carries nothing.

    Args:
        decision: as in flight.
        number: of the decision among its drone's, from 0.
        directives, viewpoint: the other answer.
    """
    t_s, me, _, view, flown_directives, flown_viewpoint = decision
    flown, again = ({d.destination: d for d in several} for several in (flown_directives, directives))
    for peer in view.peers:
        a, b = (one.get(peer) or nothing(me, peer, "the policy gave no directive") for one in (flown, again))
        if a != b:
            fields = tuple(name for name in _FIELDS if getattr(a, name) != getattr(b, name))
            yield Difference(t_s, me, number, peer, fields, _words(a, fields), _words(b, fields), a.reason, b.reason)
    if _place(flown_viewpoint) != _place(viewpoint):
        reasons = [one.reason if one is not None else "" for one in (flown_viewpoint, viewpoint)]
        words = [
            "its slot" if one is None else f"({one.x_m:.1f}, {one.y_m:.1f}) m" for one in (flown_viewpoint, viewpoint)
        ]
        yield Difference(t_s, me, number, NO_PEER, ("viewpoint",), *words, *reasons)


def _chooser(plan: PolicyPlan) -> Choose:
    known = plan.policies

    def choose(decision: Decision) -> NamedPolicy:
        if decision.policy not in known:
            raise RunError(f"{decision.policy!r} decided in flight, a function that was passed to it; name a policy")
        return known[decision.policy]

    return choose


def _place(request: Reposition | None) -> tuple[float, float] | None:
    return None if request is None else (request.x_m, request.y_m)


def _words(directive: Directive, fields: Sequence[str]) -> str:
    """The named fields of a directive: `representation features, rate_hz 10`."""
    return ", ".join(f"{name} {_value(name, getattr(directive, name))}" for name in fields)


def _value(name: str, value: object) -> str:
    if name == "representation":
        return NAME_OF[value]  # type: ignore[index]
    if name == "roi":
        return "everywhere" if value is None else "({:.1f}, {:.1f}) m, {:.1f} m".format(*value)  # type: ignore[misc]
    return f"{value:.4g}"
