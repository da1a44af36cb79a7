"""What drones find by fusing goes with their maps (`perception.maps_bring_boxes`, `perception.match_poses`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import simpy
from agent_rig import capture
from fusing_rig import Mind, Seer, agent
from sim_examples import example

from sortie.fleet.coverage import RANGE_M
from sortie.fleet.gate import HEADER_BYTES, make_payload
from sortie.fleet.messages.wire import directive_bytes
from sortie.perception.types import Boxes, Found, Share
from sortie.policies.contract import Directive, Disc, Representation
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.sim.engine.fusing import FindingEachFrame, Fusing, Job
from sortie.sim.engine.sortie import run_sortie

REGION = Disc(1.0, 2.0, 30.0)
CONFIG = "perception={max_age_s: 0.5, fusion_delay_s: 0.05}"
MAPS = (Representation.FEATURES, Representation.CODES)


def boxes(n: int) -> Boxes:
    return Boxes(np.zeros((n, 2)), np.ones((n, 2)), np.zeros(n), np.ones(n))


# --- payloads ------------------------------------------------------------------------------------


@pytest.mark.parametrize("classes", [False, True])
def test_maps_and_codes_bring_boxes_and_nothing_else_does(classes: bool) -> None:
    """With a header what was found by fusing, and where poses are corrected the boxes of their look."""
    found, box_b = Found(capture(0, 0.3), 7, boxes(7)), 24 + classes
    for rung in list(Representation)[1:]:
        directive = Directive(0, 1, rung, 0.05 if rung in MAPS else 0.0, REGION)
        asked: list[tuple[str, Disc | None]] = []

        def made(last: Any = None, look: bool = False, directive: Directive = directive, asked: Any = asked) -> Any:
            def count(roi: Disc | None) -> int:
                asked.append(("look", roi))
                return 3

            found_last = None if last is None else lambda roi: (asked.append(("found", roi)), last or None)[1]
            more = {"classes": classes, "bring_look": look, "found_last": found_last}
            return make_payload(directive, 0.0, 0.0, 0.0, count, **more)

        plain = made()
        if rung not in MAPS:
            assert made(found) == made(look=True) == plain
            continue
        asked.clear()
        assert plain.size_bytes > HEADER_BYTES + directive_bytes(directive)
        bringing = plain._replace(boxes=7, size_bytes=plain.size_bytes + HEADER_BYTES + 7 * box_b, found=found)
        assert made(found) == bringing
        assert made(()) == plain, "nothing was found yet"
        assert made(look=True) == plain._replace(boxes=3, size_bytes=plain.size_bytes + 3 * box_b)
        assert made(found, look=True) == bringing._replace(boxes=10, size_bytes=bringing.size_bytes + 3 * box_b)
        assert {disc for _, disc in asked} == {REGION}
        assert [what for what, _ in asked].count("look") == 2, "only where they are sent"


def test_what_would_mean_nothing_is_refused() -> None:
    another = "a drone's detector is surrogate"
    no_map = {
        "radio.framing=tiles": "radio.framing is tiles",
        "perception.detector=surrogate": another,
        "perception.fusion=late": "fusion is late",
        "perception.fusion=none": "fusion is none",
    }
    for field, more in (
        ("match_poses", {"fleet.makes=[{name: a, drones: [0], detector: surrogate}]": another}),
        ("maps_bring_boxes", {"perception.motion_compensation=false": "motion_compensation is false"}),
    ):
        on = f"perception={{detector: torch, {field}: true}}"
        example(on)
        for other, named in (no_map | more).items():
            with pytest.raises(ScenarioError, match=f"perception.{field}: true, must be false where {named}$"):
                example(on, other)


# --- one drone, by hand --------------------------------------------------------------------------


def test_boxes_that_came_with_a_map_follow_it_and_are_as_old_as_their_look() -> None:
    """Those of a look that is too old are left out: the second map came at an age of 0.25 s."""
    found = Found(capture(1, 0.7), 2, boxes(2))
    mind = Mind([(4, 0.9, 0.1, 1.0, {}), (1, 0.9, 0.2, 0.5, {"found": found, "roi": REGION})])
    fusing = Fusing(example(CONFIG), SimpleNamespace(tracks=lambda drone: None))  # type: ignore[arg-type]
    shares = fusing.shares(agent(0, 1.0, 1.0, mind), 1.0)
    assert [(s.capture.drone, s.representation, s.weight) for s in shares] == [
        (1, "features", 0.25),
        (1, "detections", 0.25),
        (4, "features", 0.5),
    ]
    aged = {"age_s": pytest.approx(0.4), "boxes": found.boxes}
    assert shares[1] == Share(found.capture, "detections", 0.0, REGION, 0.25, **aged)  # type: ignore[arg-type]
    for look_s, came in ((0.65, ["features", "detections"]), (0.64, ["features"])):
        mind = Mind([(1, 0.9, 0.25, 1.0, {"found": Found(capture(1, look_s), 2, boxes(2))})])
        assert [s.representation for s in fusing.shares(agent(0, 1.0, 1.0, mind), 1.0)] == came


class Counts(Seer):
    """As many boxes as it got shares, and its number of calls."""

    calls = 0

    def detect(self, jobs: Sequence[Any]) -> list[Boxes]:
        self.calls += 1
        super().detect(jobs)
        return [boxes(1 + len(shares)) for _, shares in jobs]


class Places(Seer):
    """Three boxes of each look, 0, 10 and 20 m east of the origin."""

    def detect(self, jobs: Sequence[Any]) -> list[Boxes]:
        return [replace(boxes(3), xy_m=np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])) for _ in jobs]


def finding(detector: Seer | None, *agents: Any) -> tuple[simpy.Environment, FindingEachFrame]:
    env, scenario = simpy.Environment(), example(CONFIG)
    scene = SimpleNamespace(cars_near=lambda t_s, x_m, y_m, radius_m: 7 if radius_m == RANGE_M else 2)
    found = FindingEachFrame(env, scenario, detector, Fusing(scenario, None), scene)  # type: ignore[arg-type]
    found.start(agents)
    return env, found


def test_a_drone_finds_by_its_own_look_and_maps_alone_once_a_frame_and_only_when_it_is_asked() -> None:
    came = {"found": Found(capture(2, 0.0), 2, boxes(2))}
    alone = {"representation": Representation.DETECTIONS}
    seer, agents = (
        Counts(),
        [
            agent(0, 0.0, 0.0, Mind([(1, 0.0, 0.1, 1.0, {}), (2, 0.0, 0.1, 1.0, came), (3, 0.0, 0.1, 1.0, alone)])),
            agent(1, 0.0, 0.0, Mind(), airborne=False),
            agent(2, 0.0, None, Mind([(1, 0.0, 0.1, 1.0, {})]), looks=False),
            agent(3, 0.0, None, Mind()),
        ],
    )
    env, fleet = finding(seer, *agents)
    assert fleet.last(0, None) is None, "before the first time"
    calls = seer.calls
    env.run(until=0.06)
    assert seer.calls == calls
    first = fleet.last(0, None)
    assert first is not None
    assert (first.capture, first.number, len(first.boxes or ())) == (capture(0, 0.0), 3, 3)
    assert [s.representation for s in seer.jobs[0][1]] == ["features", "features"]
    assert seer.jobs.keys() == {0}
    calls = seer.calls
    assert [fleet.last(drone, None) for drone in (1, 2, 3)] == [None] * 3
    agents[0].here = agents[0].latest = capture(0, 0.1)
    env.run(until=0.14)
    assert fleet.last(0, None) == first, "until it fuses again"
    env.run(until=0.16)
    assert seer.calls == calls
    assert (fleet.last(0, None) or first).capture == capture(0, 0.1)
    assert seer.calls == calls + 1
    agents[0].status.airborne = False
    env.run(until=0.26)
    assert fleet.last(0, None) is None, "gone"


def test_boxes_outside_the_region_stay_behind_and_old_ones_are_not_sent() -> None:
    disc = Disc(10.0, 0.0, 10.5)
    for detector, numbers in ((Places(), (3, 3, 1)), (None, (7, 2, 2))):
        env, fleet = finding(detector, agent(0, 0.0, 0.0, Mind()))
        env.run(until=0.06)
        found = [fleet.last(0, roi) for roi in (None, disc, disc._replace(radius_m=9.5))]
        assert tuple(f.number for f in found if f is not None) == numbers
        assert all((f.boxes is None) == (detector is None) for f in found if f is not None)
    drone = agent(0, 0.0, 0.0, Mind())  # it looks once and no more
    env, fleet = finding(Places(), drone)
    for k in range(1, 5):
        env.run(until=0.1 * k)
        drone.here = capture(0, 0.1 * k)
    for until_s, sent in ((0.5, True), (0.52, False)):
        env.run(until=until_s)
        assert (fleet.last(0, None) is not None) is sent, "receivers find it too old"


# --- in flight -----------------------------------------------------------------------------------

SENDING = ("policy={name: all-4, params: {received_budget: 0.05}}", "fleet.drones=3", "duration_s=2")


def test_in_flight_receivers_join_what_senders_found_before() -> None:
    """A flight of its own: boxes of a look are what was found of it with the maps held, in a frame before."""
    calls: list[dict[Any, tuple[Sequence[Share], Boxes]]] = []

    class Seen(Seer):
        def detect(self, jobs: Sequence[Job]) -> list[Boxes]:
            found = [boxes(1 + len(shares)) for _, shares in jobs]
            calls.append({ego: (shares, its) for (ego, shares), its in zip(jobs, found, strict=True)})
            return found

        count_boxes = staticmethod(lambda capture, roi: 1)  # type: ignore[assignment]

    made: Any = lambda *_: Seen()  # noqa: E731
    sets = ("perception.maps_bring_boxes=true", "perception.sample_rate_hz=2")
    record = run_sortie(example(*sets, *SENDING), detector_of=made)
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


@pytest.mark.parametrize(("field", "room"), [("match_poses", "world"), ("maps_bring_boxes", "fusing")])
def test_without_a_detector_as_many_boxes_go_as_there_are_cars_in_reach(
    field: str, room: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flights of their own: of the look from the begin, and of what was fused once anything was."""
    monkeypatch.setattr(f"sortie.sim.engine.{room}.cars_in_reach", lambda scene, capture, roi: 5 + capture.drone)
    on, off = (
        run_sortie(example(f"perception={{detector: none, {field}: {value}}}", *SENDING))
        .tables["transmissions"]
        .to_pandas()
        .query("representation == 'features'")
        for value in ("true", "false")
    )
    assert off.boxes.eq(0).all()
    late = on.t_sent_s >= (0.1 if field == "maps_bring_boxes" else 0.0)
    assert on.boxes[~late].eq(0).all()
    assert on.boxes[late].eq(5 + on.drone[late]).all()
    maps_b = dict(off[["cells", "payload_bytes"]].drop_duplicates().to_numpy().tolist())
    more_b = (on.payload_bytes - on.cells.map(maps_b))[late]
    header_b = HEADER_BYTES if field == "maps_bring_boxes" else 0
    assert len(more_b) > 20
    assert more_b.eq(header_b + 24 * on.boxes[late]).all()
