"""What drones find by fusing goes with their maps (`perception.maps_bring_boxes`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import simpy
from agent_rig import capture
from fusing_rig import Mind, Seer, agent
from sim_examples import example

from sortie.fleet.gate import HEADER_BYTES, make_payload
from sortie.fleet.messages.wire import directive_bytes
from sortie.perception.types import Boxes, Found, Share
from sortie.policies.contract import Directive, Disc, Representation
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.sim.engine.fusing import FindingEachFrame, Fusing, Job
from sortie.sim.engine.sortie import run_sortie

REGION = Disc(1.0, 2.0, 30.0)
CONFIG = "perception={max_age_s: 0.5, fusion_delay_s: 0.05}"


def boxes(n: int) -> Boxes:
    return Boxes(np.zeros((n, 2)), np.ones((n, 2)), np.zeros(n), np.ones(n))


@pytest.mark.parametrize("classes", [False, True])
@pytest.mark.parametrize("rung", list(Representation)[1:])
def test_maps_and_codes_bring_a_header_and_boxes_and_nothing_else_does(rung: Representation, classes: bool) -> None:
    directive = Directive(0, 1, rung, 0.05 if rung in (Representation.FEATURES, Representation.CODES) else 0.0)
    found = Found(capture(0, 0.3), 7, boxes(7))
    plain, bringing = (
        make_payload(directive, 0.0, 0.0, 0.0, lambda roi: 3, found_last=last, classes=classes)
        for last in (None, lambda roi: found)
    )
    assert plain is not None
    assert bringing is not None
    if rung in (Representation.FEATURES, Representation.CODES):
        assert plain.size_bytes > HEADER_BYTES + directive_bytes(directive)
        assert bringing == plain._replace(
            boxes=7, size_bytes=plain.size_bytes + HEADER_BYTES + 7 * (24 + classes), found=found
        )
        nothing_yet = make_payload(
            directive, 0.0, 0.0, 0.0, lambda roi: 3, found_last=lambda roi: None, classes=classes
        )
        assert nothing_yet == plain
    else:
        assert bringing == plain


def test_a_payload_asks_for_the_boxes_in_its_region() -> None:
    asked: list[Disc | None] = []
    for roi in (None, Disc(3.0, 4.0, 8.0)):
        directive = Directive(0, 1, Representation.CODES, 0.05, roi)
        make_payload(directive, 0.0, 0.0, 0.0, lambda roi: 3, found_last=lambda roi: asked.append(roi))  # type: ignore[func-returns-value]
    assert asked == [None, Disc(3.0, 4.0, 8.0)]


@pytest.mark.parametrize("classes", [False, True])
@pytest.mark.parametrize("rung", list(Representation)[1:])
def test_maps_and_codes_bring_the_boxes_of_their_look_where_poses_are_corrected(
    rung: Representation, classes: bool
) -> None:
    is_map = rung in (Representation.FEATURES, Representation.CODES)
    directive = Directive(0, 1, rung, 0.05 if is_map else 0.0, REGION)
    asked: list[Disc | None] = []

    def count(roi: Disc | None) -> int:
        asked.append(roi)
        return 3

    def made(bring_look: bool, **of: Any) -> Any:
        return make_payload(directive, 0.0, 0.0, 0.0, count, classes=classes, bring_look=bring_look, **of)

    plain, bringing = made(False), made(True)
    if not is_map:
        assert bringing == plain
        return
    assert asked == [REGION], "only where they are sent"
    assert bringing == plain._replace(boxes=3, size_bytes=plain.size_bytes + 3 * (24 + classes))
    last = Found(capture(0, 0.3), 7, boxes(7))
    both, one = (made(look, found_last=lambda roi: last) for look in (True, False))
    assert both == one._replace(boxes=10, size_bytes=one.size_bytes + 3 * (24 + classes))


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ("radio.framing=tiles", "radio.framing is tiles"),
        ("perception.detector=surrogate", "a drone's detector is surrogate"),
        ("fleet.makes=[{name: a, drones: [0], detector: surrogate}]", "a drone's detector is surrogate"),
        ("perception.fusion=late", "fusion is late"),
        ("perception.fusion=none", "fusion is none"),
    ],
)
def test_corrected_poses_are_refused_where_no_map_is_fused(other: str, named: str) -> None:
    on = "perception={detector: torch, match_poses: true}"
    example(on, "perception.motion_compensation=false")
    with pytest.raises(ScenarioError, match=f"perception.match_poses: true, must be false where {named}$"):
        example(on, other)


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ("radio.framing=tiles", "radio.framing is tiles"),
        ("perception.detector=surrogate", "a drone's detector is surrogate"),
        ("perception.fusion=late", "fusion is late"),
        ("perception.fusion=none", "fusion is none"),
        ("perception.motion_compensation=false", "motion_compensation is false"),
    ],
)
def test_it_is_refused_where_it_would_mean_nothing(other: str, named: str) -> None:
    on = "perception={detector: torch, maps_bring_boxes: true}"
    example(on)
    with pytest.raises(ScenarioError, match=f"perception.maps_bring_boxes: true, must be false where {named}$"):
        example(on, other)


def test_boxes_that_came_with_a_map_follow_it_and_are_as_old_as_their_look() -> None:
    found = Found(capture(1, 0.7), 2, boxes(2))
    mind = Mind([(4, 0.9, 0.1, 1.0, {}), (1, 0.9, 0.2, 0.5, {"found": found, "roi": REGION})])
    shares = Fusing(example(CONFIG), lambda drone: None).shares(agent(0, 1.0, 1.0, mind), 1.0)  # type: ignore[arg-type]
    assert [(s.capture.drone, s.representation, s.weight) for s in shares] == [
        (1, "features", 0.25),
        (1, "detections", 0.25),
        (4, "features", 0.5),
    ]
    assert shares[1] == Share(
        found.capture, "detections", 0.0, REGION, 0.25, age_s=pytest.approx(0.4), boxes=found.boxes
    )


@pytest.mark.parametrize(("look_s", "fresh"), [(0.65, True), (0.64, False)])
def test_boxes_of_a_look_that_is_too_old_are_left_out(look_s: float, fresh: bool) -> None:
    """The map came at an age of 0.25 s."""
    mind = Mind([(1, 0.9, 0.25, 1.0, {"found": Found(capture(1, look_s), 2, boxes(2))})])
    shares = Fusing(example(CONFIG), lambda drone: None).shares(agent(0, 1.0, 1.0, mind), 1.0)  # type: ignore[arg-type, return-value]
    assert [s.representation for s in shares] == ["features", "detections"][: 1 + fresh]


class Counts(Seer):
    """As many boxes as it got shares, and its number of calls."""

    calls = 0

    def detect(self, jobs: Sequence[Any]) -> list[Boxes]:
        self.calls += 1
        super().detect(jobs)
        return [boxes(1 + len(shares)) for _, shares in jobs]


def test_a_drone_finds_by_its_own_look_and_maps_alone_once_a_frame_and_only_when_it_is_asked() -> None:
    env, seer, scenario = simpy.Environment(), Counts(), example(CONFIG)
    came = {"found": Found(capture(2, 0.0), 2, boxes(2))}
    alone = {"representation": Representation.DETECTIONS}
    agents = [
        agent(0, 0.0, 0.0, Mind([(1, 0.0, 0.1, 1.0, {}), (2, 0.0, 0.1, 1.0, came), (3, 0.0, 0.1, 1.0, alone)])),
        agent(1, 0.0, 0.0, Mind(), airborne=False),
        agent(2, 0.0, None, Mind([(1, 0.0, 0.1, 1.0, {})]), looks=False),
        agent(3, 0.0, None, Mind()),
    ]
    finding = FindingEachFrame(env, scenario, seer, Fusing(scenario, None), lambda look, roi: 99)  # type: ignore[arg-type]
    finding.start(agents)
    assert finding.last(0, None) is None, "before the first time"
    calls = seer.calls
    env.run(until=0.06)
    assert seer.calls == calls
    first = finding.last(0, None)
    assert first is not None
    assert (first.capture, first.number, len(first.boxes or ())) == (capture(0, 0.0), 3, 3)
    assert [s.representation for s in seer.jobs[0][1]] == ["features", "features"]
    assert seer.jobs.keys() == {0}
    calls = seer.calls
    assert [finding.last(drone, None) for drone in (1, 2, 3)] == [None] * 3
    agents[0].here = agents[0].latest = capture(0, 0.1)
    env.run(until=0.14)
    assert finding.last(0, None) == first, "until it fuses again"
    env.run(until=0.16)
    assert seer.calls == calls
    assert (finding.last(0, None) or first).capture == capture(0, 0.1)
    assert seer.calls == calls + 1
    agents[0].status.airborne = False
    env.run(until=0.26)
    assert finding.last(0, None) is None, "gone"


class Places(Seer):
    """Three boxes of each look, 0, 10 and 20 m east of the origin."""

    def detect(self, jobs: Sequence[Any]) -> list[Boxes]:
        return [replace(boxes(3), xy_m=np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])) for _ in jobs]


def _finding(detector: Seer | None, *agents: Any) -> tuple[simpy.Environment, FindingEachFrame]:
    env, scenario = simpy.Environment(), example(CONFIG)
    counted = lambda look, roi: 7 if roi is None else 2  # noqa: E731
    finding = FindingEachFrame(env, scenario, detector, Fusing(scenario, None), counted)  # type: ignore[arg-type]
    finding.start(agents)
    return env, finding


def test_boxes_outside_the_region_stay_behind() -> None:
    disc = Disc(10.0, 0.0, 10.5)
    for detector, numbers in ((Places(), (3, 3, 1)), (None, (7, 2, 2))):
        env, finding = _finding(detector, agent(0, 0.0, 0.0, Mind()))
        env.run(until=0.06)
        found = [finding.last(0, roi) for roi in (None, disc, disc._replace(radius_m=9.5))]
        assert tuple(f.number for f in found if f is not None) == numbers
        for each in found:
            assert each is not None
            assert (None if each.boxes is None else len(each.boxes)) == (None if detector is None else each.number)


def test_boxes_of_a_look_that_receivers_find_too_old_are_not_sent() -> None:
    """The drone looks once and no more."""
    drone = agent(0, 0.0, 0.0, Mind())
    env, finding = _finding(Places(), drone)
    for k in range(1, 5):
        env.run(until=0.1 * k)
        drone.here = capture(0, 0.1 * k)
    env.run(until=0.5)
    assert finding.last(0, None) is not None
    env.run(until=0.52)
    assert finding.last(0, None) is None


SENDING = ("policy.name=all-4", "policy.params={received_budget: 0.05}", "fleet.drones=3", "duration_s=2")


def test_in_flight_receivers_join_what_senders_found_before() -> None:
    """Every drone's boxes of a look are what the detector found of it with the maps that it held, in a frame before."""
    calls: list[dict[Any, tuple[Sequence[Share], Boxes]]] = []

    class Seen(Seer):
        def detect(self, jobs: Sequence[Job]) -> list[Boxes]:
            found = [boxes(1 + len(shares)) for _, shares in jobs]
            calls.append({ego: (shares, its) for (ego, shares), its in zip(jobs, found, strict=True)})
            return found

        count_boxes = staticmethod(lambda capture, roi: 1)  # type: ignore[assignment]

    record = run_sortie(
        example("perception.maps_bring_boxes=true", "perception.sample_rate_hz=2", *SENDING),
        detector_of=lambda *_: Seen(),  # type: ignore[arg-type, return-value]
    )
    came = 0
    for call in calls:
        for shares, _ in call.values():
            for map_, its in pairwise(shares):
                if its.representation == "detections" and its.boxes is not None:
                    assert map_.capture.drone == its.capture.drone
                    assert its.capture.t_s == pytest.approx(map_.capture.t_s - 0.1)
                    assert its.age_s == pytest.approx(map_.age_s + 0.1)
                    (of,) = (c[its.capture] for c in calls if its.capture in c and c[its.capture][1] is its.boxes)
                    assert all(s.is_map for s in of[0])
                    came += 1
    assert came > 10
    fused = record.tables["fusions"].to_pylist()[-1]
    assert fused["peers"] == sorted(fused["peers"])
    assert fused["representations"] == ["features"] * 2, "what came with them is no payload of its own"
    sent = record.tables["transmissions"].to_pandas().query("representation == 'features'")
    assert sent.boxes.max() == 3, "of the own look and two maps"


def test_corrected_poses_send_as_many_boxes_with_maps_as_there_are_cars_in_reach(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without a detector."""
    monkeypatch.setattr("sortie.sim.engine.world.cars_in_reach", lambda scene, capture, roi: 5 + capture.drone)
    on, off = (
        run_sortie(example(f"perception={{detector: none, match_poses: {match}}}", *SENDING))
        .tables["transmissions"]
        .to_pandas()
        .query("representation == 'features'")
        for match in ("true", "false")
    )
    assert off.boxes.eq(0).all()
    assert on.boxes.eq(5 + on.drone).all()
    maps_b = dict(off[["cells", "payload_bytes"]].drop_duplicates().to_numpy().tolist())
    assert (on.payload_bytes - on.cells.map(maps_b)).eq(24 * on.boxes).all()


def test_without_a_detector_as_many_go_as_there_are_cars_in_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sortie.sim.engine.sortie.cars_in_reach", lambda scene, capture, roi: 5 + capture.drone)
    on, off = (
        run_sortie(example(f"perception={{detector: none, maps_bring_boxes: {bring}}}", *SENDING))
        .tables["transmissions"]
        .to_pandas()
        .query("representation == 'features'")
        for bring in ("true", "false")
    )
    assert off.boxes.eq(0).all()
    assert len(on) > 20
    first = on.t_sent_s < 0.1  # nobody has fused yet
    assert on.boxes[first].eq(0).all()
    assert on.boxes[~first].eq(5 + on.drone[~first]).all()
    maps_b = dict(off[["cells", "payload_bytes"]].drop_duplicates().to_numpy().tolist())
    front_b = on.payload_bytes - on.cells.map(maps_b)
    assert front_b[~first].eq(HEADER_BYTES + 24 * on.boxes[~first]).all()
