"""Between the engine's parts, asked one by one: what is detected ahead, when a refused move is decided again, and who reads a view that is shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import simpy
from agent_rig import capture
from policies_examples import fleet_of
from sim_examples import example

from sortie.fleet.flight.viewpoints import Move
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Directive, Disc, FleetView, Reposition, Representation, TaskPhase
from sortie.policies.verification.invariants.language import parse
from sortie.scenarios.plugins.reference import PluginError
from sortie.scenarios.schema import PolicyChange
from sortie.sim.engine import sortie as engine
from sortie.sim.engine.audit import Audit
from sortie.sim.engine.choreography import Choreography
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.own_boxes import OwnBoxes
from sortie.sim.engine.own_events import FleetHandle
from sortie.sim.engine.pilot import NamedPolicy, Pilot, PolicyPlan, Replay, plan_for
from sortie.sim.engine.sortie import build
from sortie.sim.engine.tracking import FleetTracking
from sortie.sim.engine.world import OwnSenses
from sortie.sim.results.record import Recorder

# --- own detections ----------------------------------------------------------------------------------


def _box(of: Capture) -> Boxes:
    """A box that names the capture it is of."""
    return Boxes(np.array([[of.t_s, float(of.drone)]]), np.array([[4.5, 1.9]]), np.zeros(1), np.ones(1))


class Many:
    """A detector of many moments; `asked` are the captures of each call."""

    calibration = "made up"

    def __init__(self) -> None:
        self.asked: list[list[tuple[int, float]]] = []

    def detect_many(self, moments: Sequence[Sequence[tuple[Capture, Any]]]) -> Iterable[Boxes]:
        self.asked.append([(c.drone, c.t_s) for moment in moments for c, _ in moment])
        assert all(not shares for moment in moments for _, shares in moment)
        return [_box(c) for moment in moments for c, _ in moment]

    def truth_many(self, t_s: Any, egos: Any) -> list[Boxes]:
        return []

    detect = truth = count_boxes = camera_views = None


def _told(boxes: Sequence[Boxes]) -> list[tuple[int, float]]:
    return [(int(b.xy_m[0, 1]), float(b.xy_m[0, 0])) for b in boxes]


def test_what_comes_next_is_detected_ahead_and_everything_once() -> None:
    ahead: list[float] = []

    def coming(after_s: float) -> list[Capture]:
        ahead.append(after_s)
        return [capture(d, after_s + t) for t in (1.0, 2.0) for d in (0, 1)]

    many = Many()
    own = OwnBoxes(many, coming)  # type: ignore[arg-type]
    assert _told(own([capture(1, 0.0), capture(0, 0.0)])) == [(1, 0.0), (0, 0.0)]
    assert many.asked == [[(1, 0.0), (0, 0.0), (0, 1.0), (1, 1.0), (0, 2.0), (1, 2.0)]]
    assert _told(own([capture(1, 1.0), capture(0, 2.0)])) == [(1, 1.0), (0, 2.0)]
    assert (len(many.asked), ahead) == (1, [0.0])
    # another than was expected is detected alone, while what is known reaches beyond it
    assert _told(own([capture(2, 1.5), capture(0, 1.0)])) == [(2, 1.5), (0, 1.0)]
    assert (many.asked[1:], ahead) == ([[(2, 1.5)]], [0.0])
    # beyond that, the next ones are asked for anew; of what was known what is wanted now stays
    assert _told(own([capture(1, 2.0), capture(2, 2.5)])) == [(1, 2.0), (2, 2.5)]
    assert ahead == [0.0, 2.5]
    assert many.asked[2:] == [[(2, 2.5), (0, 3.5), (1, 3.5), (0, 4.5), (1, 4.5)]]
    assert own._known.keys() == {capture(d, t) for t in (3.5, 4.5) for d in (0, 1)}, "what was asked for is not kept"


def test_a_detector_of_single_moments_detects_when_it_is_asked() -> None:
    class Single:
        def detect(self, jobs: Sequence[tuple[Capture, Any]]) -> list[Boxes]:
            return [_box(c) for c, _ in jobs]

    class Ahead(Single):
        def begin(self, jobs: Sequence[tuple[Capture, Any]]) -> Callable[[], list[Boxes]]:
            return lambda: [_box(c._replace(t_s=c.t_s + 100.0)) for c, _ in jobs]

    asked = [capture(1, 0.5), capture(0, 0.5)]
    assert _told(OwnBoxes(Single(), lambda _: [])(asked)) == [(1, 0.5), (0, 0.5)]  # type: ignore[arg-type]
    assert _told(OwnBoxes(Ahead(), lambda _: [])(asked)) == [(1, 100.5), (0, 100.5)]  # type: ignore[arg-type]


# --- moves -------------------------------------------------------------------------------------------


class Granting:
    """Stands for the rules of safety: answers by a script, and notes what it was asked."""

    def __init__(self, answer: Callable[[int, int], Move | str | None]) -> None:
        self.answer = answer
        self.asked: list[tuple[int, int]] = []
        self.gone: list[list[int]] = []

    def __call__(
        self, drone: int, wanted_m: Any, plans: Any, course: Any, bounds: Any, frame: int, gone: list[int]
    ) -> Any:
        self.asked.append((frame, drone))
        self.gone.append(list(gone))
        return self.answer(frame, drone)


def _choreography(monkeypatch: pytest.MonkeyPatch, grant: Granting, *sets: str) -> tuple[Choreography, Any]:
    scenario = example("duration_s=5", "fleet.drones=4", *sets)
    parts = build(scenario, plan_for(scenario), 1)
    monkeypatch.setattr("sortie.sim.engine.choreography.grant", grant)
    monkeypatch.setattr("sortie.sim.engine.choreography.displaced", lambda motion, *_: motion)
    return Choreography(scenario, parts.world, posed_by_trace=False), parts.world


def test_a_refused_request_is_decided_again_a_second_after_each_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    grant = Granting(lambda frame, drone: "too near")
    moves, world = _choreography(monkeypatch, grant)
    moves.request(2, Reposition(0.0, 0.0, "to see"))
    for frame in range(35):
        moves.renew(frame)
    assert grant.asked == [(0, 2), (10, 2), (20, 2), (30, 2)]
    assert [row[1:] for row in world._recorder.rows["events"]] == [(2, "viewpoint", "stays, too near: to see")]


def test_who_was_refused_is_decided_again_once_another_moved_out_of_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    met: list[int] = []

    def answer(frame: int, drone: int) -> Move | str:
        met.append(drone)
        return Move(0.0, 2.0, (0.0, 0.0), (3.0, 4.0)) if drone == 1 or 1 in met else "drone 1 is there"

    grant = Granting(answer)
    moves, world = _choreography(monkeypatch, grant)
    for drone in (0, 1):
        moves.request(drone, Reposition(0.0, 0.0, "to see"))
    moves.renew(0)
    assert grant.asked == [(0, 0), (0, 1), (0, 0)]
    assert [len(plan) for plan in moves.plans] == [1, 1, 0, 0]
    texts = {row[1]: row[3] for row in world._recorder.rows["events"]}
    assert texts == dict.fromkeys((0, 1), "moves 5.0 m in 2.0 s, to +3.0 m ahead and +4.0 m left of its slot: to see")


def test_a_refusal_is_told_again_after_a_move(monkeypatch: pytest.MonkeyPatch) -> None:
    move = Move(0.0, 1.0, (0.0, 0.0), (1.0, 0.0))
    grant = Granting(lambda frame, drone: move if frame == 10 else "too near")
    moves, world = _choreography(monkeypatch, grant)
    moves.request(0, Reposition(0.0, 0.0, "r"))
    for frame in range(25):
        moves.renew(frame)
    told = [row[3].partition(" ")[0] for row in world._recorder.rows["events"]]
    assert told == ["stays,", "moves", "stays,"]


def test_only_drones_that_fly_move_and_slots_stay_free_for_those_that_will_come(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    joins = "events=[{kind: drone_joins, at_s: 4, drone: 3}]"
    grant = Granting(lambda frame, drone: None)
    moves, world = _choreography(monkeypatch, grant, joins)
    for drone in range(4):
        moves.request(drone, Reposition(0.0, 0.0, "r"))
    world.homebound.add(2)
    moves.renew(0)
    assert grant.asked == [(0, 0), (0, 1)], "drone 2 goes home and drone 3 is on the ground"
    assert grant.gone == [[], []]
    world.remove(1, "drone_lost", "fell silent")
    moves.renew(1)
    assert (grant.asked[2:], grant.gone[2:]) == ([(1, 0)], [[1]])


# --- a view that is shown ----------------------------------------------------------------------------


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
        request_viewpoint=lambda drone, asked: None,
        keep=lambda drone, name, view, directives, asked: kept.append(view.me.battery_soc),  # type: ignore[union-attr]
        steer=lambda drone, view: steered.append(view.me.battery_soc),  # type: ignore[union-attr]
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
        PolicyPlan(NamedPolicy("first", first)), request_viewpoint=lambda drone, wanted: asked.append(wanted)
    )
    pilot(fleet_of(2))
    pilot.take_over(NamedPolicy("second", second, 7), "command", 0)
    assert len(asked) == 1
    pilot(fleet_of(2))
    assert (len(first.read), len(second.read), pilot.handshake_bytes()) == (2, 2, 7)
    pilot.take_over(NamedPolicy("blind", blind), "command", 1)
    assert asked[2:] == [None], "back to its slot"
    pilot(fleet_of(2))
    assert (len(second.read), len(asked), pilot.handshake_bytes()) == (2, 3, 0)
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


# --- the world ---------------------------------------------------------------------------------------


def _world(*sets: str) -> Any:
    scenario = example("duration_s=1", "fleet.drones=3", "mission.phases=[{at_s: 0, phase: search}]", *sets)
    return build(scenario, plan_for(scenario), 1).world


@pytest.mark.parametrize(("at_s", "frame"), [(0.2, 2), (0.25, 2), (0.299, 2), (0.3, 3)])
def test_a_drone_stays_where_it_was_in_the_frame_in_which_it_left_the_air(at_s: float, frame: int) -> None:
    world = _world()
    world.env.run(until=at_s)
    world.ground(1)
    world.ground(1)  # it is down already
    assert world._down == {1: [(frame, 10)]}


def test_losses_of_events_and_of_a_user_s_events_add_up() -> None:
    world = _world()
    assert world._loss_db() is None
    world.add_loss(0, 1, 10.0)
    world.own_losses_db[0] = np.full((3, 3), 5.0)
    world.own_losses_db[4] = np.full((3, 3), 2.0)
    assert world._loss_db()[[0, 1, 0, 2], [1, 0, 2, 1]].tolist() == [17.0, 17.0, 7.0, 7.0]
    world.add_loss(0, 1, -10.0)
    assert world.extra_loss_db is None


def test_people_that_are_sent_are_those_within_the_region() -> None:
    world = _world()
    found = Boxes(np.array([[0.0, 0.0], [30.0, 0.0]]), np.ones((2, 2)), np.zeros(2), np.ones(2))
    world.people.found = lambda capture: found
    senses = OwnSenses(world, 0, None)  # type: ignore[arg-type]
    assert len(senses.people_in(capture(0, 0.0), None)) == 2
    assert senses.people_in(capture(0, 0.0), Disc(29.0, 0.0, 5.0)).xy_m.tolist() == [[30.0, 0.0]]


def test_an_event_of_one_s_own_sees_the_drones_of_the_frame_and_weakens_a_link_one_way() -> None:
    world = _world()
    its = FleetHandle(world, world._scenario, SimpleNamespace(model="mine"), 3)  # type: ignore[arg-type]
    for t_s, frame in ((0.27, 2), (0.3, 3)):
        world.env.run(until=t_s)
        np.testing.assert_array_equal(its.positions_m, world.motion.position_m[frame])
    one_way = np.zeros((3, 3))
    one_way[0, 2] = 9.0
    its.set_loss_db(one_way)
    one_way[0, 2] = 1.0  # it keeps a copy
    assert world._loss_db()[0, 2] == 9.0
    assert world._loss_db().sum() == 9.0
    its.set_loss_db(4.0)
    assert world._loss_db().tolist() == [[0.0, 4.0, 4.0], [4.0, 0.0, 4.0], [4.0, 4.0, 0.0]]


@pytest.mark.parametrize("text", [5, None, b"storm"])
def test_an_event_of_one_s_own_writes_no_note_that_the_record_cannot_hold(text: Any) -> None:
    world = _world()
    its = FleetHandle(world, world._scenario, SimpleNamespace(model="mine"), 3)  # type: ignore[arg-type]
    for act in (lambda: its.note(text), lambda: its.lose(0, text)):
        with pytest.raises(PluginError, match=r"^event mine: text .+, must be a str$"):
            act()
    assert world.drones[0].airborne
    assert world._recorder.rows["events"] == []


@pytest.mark.parametrize("drone", [-2, 3, 1.5, "a", None])
def test_an_event_of_one_s_own_notes_something_of_the_fleet_or_of_a_drone_alone(drone: Any) -> None:
    world = _world()
    its = FleetHandle(world, world._scenario, SimpleNamespace(model="mine"), 3)  # type: ignore[arg-type]
    with pytest.raises(PluginError, match=rf"^event mine: drone {drone!r}, must be a whole number, -1 … 2$"):
        its.note("x", drone)
    for fits in (-1, 2, np.int64(1)):
        its.note("x", fits)
    assert [row[1] for row in world._recorder.rows["events"]] == [-1, 2, 1]


def test_a_phase_begins_with_its_frame_whatever_the_clock_rounds() -> None:
    plan = MissionPlan(example().mission, 2)
    assert [plan.at(t_s)[0].phase for t_s in (2.9, 3.0 - 1e-12, 3.0)] == ["search", "track", "track"]


def test_every_part_draws_by_the_seed_and_the_replication_that_fly_and_not_by_the_scenario_s(
    monkeypatch: pytest.MonkeyPatch,
) -> None:

    got: dict[str, tuple[Any, Any]] = {}

    def noted(name: str, place: Callable[[Any, Any], tuple[Any, Any]]) -> None:
        made = getattr(engine, name)
        monkeypatch.setattr(engine, name, lambda *a, **k: (got.__setitem__(name, place(a, k)), made(*a, **k))[1])

    noted("People", lambda a, k: a[-1])
    noted("Air", lambda a, k: (k["seed"], k["replication"]))
    noted("schedule", lambda a, k: (k["seed"], k["replication"]))
    for name in ("OwnEvents", "Steering", "oscillators", "sensor_errors", "flown_motion", "mixed"):
        noted(name, lambda a, k: a[-2:])
    scenario = example("seed=1", "duration_s=0.2", "mission.phases=[{at_s: 0, phase: search}]", "fleet.drones=2")
    build(scenario, plan_for(scenario), 9, 4)
    assert got == dict.fromkeys(got, (9, 4))
    assert len(got) == 9


def test_after_a_rest_a_tracker_takes_one_look_and_then_those_that_are_due() -> None:
    scenario = example("duration_s=10", "perception.detector=surrogate")
    looks_s = [frame * scenario.frame_s for frame in scenario.tracked_frames]
    seen: list[float] = []
    tracking = FleetTracking(
        scenario, lambda captures: seen.extend(c.t_s for c in captures) or [Boxes.empty() for _ in captures]
    )  # type: ignore[func-returns-value]
    due, last_s = list[float](), -1.0
    for t_s in (0.1 * frame for frame in (*range(5), *range(30, 40))):
        tracking.perceived(capture(0, t_s))
        if any(last_s < look_s <= t_s + 1e-6 for look_s in looks_s):
            due.append(t_s)
            last_s = t_s + 1e-6
    tracking.tracks(0)
    assert seen == due
    assert len(due) < 5
