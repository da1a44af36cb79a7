"""What stands between a drone's view and its policy: views that are shown, changes of policy, and who counts what."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import simpy
from policies_examples import fleet_of

from sortie.policies.contract import Directive, FleetView, Reposition, Representation, TaskPhase
from sortie.policies.verification.enforced import Violation
from sortie.policies.verification.invariants.language import parse
from sortie.scenarios.schema import PolicyChange
from sortie.sim.engine.audit import Audit
from sortie.sim.engine.pilot import NamedPolicy, Pilot, PolicyPlan, Replay
from sortie.sim.results.record import VIOLATIONS_OF, Recorder


class Reads:
    """A policy with a viewpoint; it notes whose view it read, by the charge that stands in it."""

    def __init__(self, name: str, looks: bool = True) -> None:
        self.name, self.read = name, list[tuple[str, float]]()
        if looks:
            self.viewpoint = self._look

    def __call__(self, view: FleetView) -> list[Directive]:
        self._note("decides", view)
        return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=5.0, reason="r") for p in view.peers]

    def _look(self, view: FleetView) -> Reposition:
        self._note("looks", view)
        return Reposition(*view.me.position_m[:2], "here")  # type: ignore[union-attr]

    def _note(self, what: str, view: FleetView) -> None:
        assert view.me is not None
        self.read.append((what, view.me.battery_soc))


def _pilot(plan: PolicyPlan, **parts: Any) -> tuple[Pilot, Audit]:
    audit = Audit(simpy.Environment(), Recorder())
    return Pilot(0, plan, audit, **parts), audit


def test_a_view_that_is_shown_is_read_by_all_that_read_the_drone_s_own() -> None:
    policy = Reads("p")
    steered, kept = list[float](), list[float]()
    pilot, _ = _pilot(
        PolicyPlan(NamedPolicy("p", policy)),
        viewpoints=SimpleNamespace(request=lambda drone, asked: None),
        planners=SimpleNamespace(read=lambda drone, view: steered.append(view.me.battery_soc)),
        journal=SimpleNamespace(decided=lambda drone, name, view, directives, asked: kept.append(view.me.battery_soc)),
    )
    pilot.show(Replay(0.0, 0, fleet_of(3, soc=0.25), to_drone=False))
    pilot(fleet_of(3, soc=0.75))
    pilot(fleet_of(3, soc=0.75))
    assert policy.read == [("looks", 0.25), ("decides", 0.25), ("looks", 0.75), ("decides", 0.75)]
    assert (steered, kept) == ([0.25, 0.75], [0.25, 0.75])


def test_who_takes_over_looks_from_its_own_viewpoint_or_from_its_slot() -> None:
    first, second, blind = Reads("first"), Reads("second"), Reads("blind", looks=False)
    asked: list[Reposition | None] = []
    pilot, audit = _pilot(
        PolicyPlan(NamedPolicy("first", first)),
        viewpoints=SimpleNamespace(request=lambda drone, wanted: asked.append(wanted)),
    )
    pilot(fleet_of(2))
    pilot.take_over(NamedPolicy("second", second, 7), "command", 0)
    assert len(asked) == 1
    pilot(fleet_of(2))
    assert (len(first.read), len(second.read), pilot.handshake_bytes) == (2, 2, 7)
    pilot.take_over(NamedPolicy("blind", blind), "command", 1)
    assert asked[2:] == [None], "back to its slot"
    pilot(fleet_of(2))
    assert (len(second.read), len(asked), pilot.handshake_bytes) == (2, 3, 0)
    assert audit.decisions == {"first": 1, "second": 1, "blind": 1}


def test_of_two_changes_before_one_decision_the_later_in_the_list_stays_and_the_next_decision_begins_anew() -> None:
    own, other = NamedPolicy("own", Reads("own", looks=False)), NamedPolicy("other", Reads("other", looks=False))
    late = NamedPolicy("late", Reads("late", looks=False))
    changes = tuple((PolicyChange(phase=phase, name=p.name), p) for phase, p in (("search", own), ("track", other)))
    pilot, audit = _pilot(PolicyPlan(own, changes))
    pilot(fleet_of(2))
    pilot.take_over(late, "time 1 s", 2)  # behind both in the list
    pilot(fleet_of(2, phase=TaskPhase.TRACK))
    assert pilot.policy.name == "late"
    pilot(fleet_of(2))
    assert pilot.policy.name == "own", "a change of phase alone"
    pilot.take_over(late, "time 2 s", 0)  # before the change to `track`
    pilot(fleet_of(2, phase=TaskPhase.TRACK))
    assert pilot.policy.name == "other"
    assert audit.decisions == {"own": 2, "late": 1, "other": 1}


def _failures(
    directives: Sequence[Sequence[Directive]], views: Sequence[FleetView], lines: str = "rate_hz <= 20"
) -> Any:
    """What breaks a rule on views that are shown one after the other; each is answered by the next of `directives`."""
    answers = iter(directives)
    pilot, audit = _pilot(PolicyPlan(NamedPolicy("p", lambda view: next(answers)), rules=parse(lines)))
    for view in views:
        pilot.show(Replay(0.0, 0, view, to_drone=False))
        pilot(view)
    return [(row[3], row[6]) for row in audit._rows["violations"]]


def _link(peer: int, rate_hz: float = 5.0) -> Directive:
    return Directive(0, peer, Representation.DETECTIONS, rate_hz=rate_hz, reason="r")


def test_on_views_that_are_shown_a_link_without_a_directive_and_a_rise_by_age_alone_are_failures() -> None:
    view = fleet_of(3)
    older = view._replace(age_s={0: 0.1, 1: 0.1, 2: 0.9})
    both = [_link(1), _link(2)]
    assert _failures([both], [view]) == []
    assert _failures([[_link(2)]], [view]) == [(1, "one directive a link")]
    assert _failures([[_link(1)]], [view]) == [(2, "one directive a link")]
    assert _failures([both, both], [view, older]) == []
    assert _failures([both, [_link(1), _link(2, 9.0)]], [view, older]) == [(-1, "age-monotone")]
    assert _failures([both, [_link(1), _link(2, 9.0)]], [older, view]) == [], "an age fell"
    other = fleet_of(3, soc=0.4)._replace(age_s=older.age_s)
    assert _failures([both, [_link(1), _link(2, 9.0)]], [view, other]) == [], "other descriptors"
    assert _failures([[_link(1), _link(2, 25.0)]], [view]) == [(2, "rate_hz <= 20")]


def test_a_decision_that_breaks_several_lines_is_one_violated_decision() -> None:
    """Violations are counted by line and link, decisions once; a violation that goes on is the same one."""
    env, recorder = simpy.Environment(), Recorder(classes=False)
    audit = Audit(env, recorder)
    one, other = (Violation(line, 1, "policy", "features") for line in ("rho <= 0.1", "rate_hz <= 5"))
    for broken in ([one, other], [one], [], [one]):
        audit.judged(0, "mine", broken)
        env.run(until=env.now + 0.1)
    audit.finish()
    counts = audit.totals()
    assert counts["violated_ticks"] == 3
    assert counts["invariant_violations"] == 3
    assert counts[f"{VIOLATIONS_OF}policy"] == 3
