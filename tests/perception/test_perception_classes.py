"""Boxes of one class match, those of two never do: in joining, tracking, AP and on the wire. Cases worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sortie.fleet.gate import HEADER_BYTES, make_payload
from sortie.fleet.messages.wire import DIRECTIVE_BYTES
from sortie.perception import budget
from sortie.perception.classes import CAR, NEAR_M, PERSON, PERSON_SIZE_M, TRUCK, TargetClass, vehicle_classes
from sortie.perception.joining import EgoSources, Rule, SourceBoxes, joined_many
from sortie.perception.lateness import CARS, PEOPLE, movement, still_right, variance_m2
from sortie.perception.metrics.ap import match, match_many
from sortie.perception.motion import Tracks
from sortie.perception.tracking.following import boxes_of, followed, motion_of_boxes
from sortie.perception.tracking.tracker import step
from sortie.perception.tracking.wire import TRACK, packed, unpacked
from sortie.perception.types import Boxes
from sortie.policies.contract import Directive, Disc, Representation

HERE = (0.0, 0.0, 0.0)
SIZES = {CAR: (4.5, 1.9), TRUCK: (8.0, 2.5), PERSON: PERSON_SIZE_M[:2]}
RULES: list[Rule] = ["nms", "average"]


def boxes(*rows: tuple[TargetClass, float, float, float]) -> Boxes:
    """Of (class, x, y, score)."""
    table = np.array([row[1:] for row in rows]).reshape(-1, 3)
    size, kind = np.array([SIZES[row[0]] for row in rows]).reshape(-1, 2), np.array([row[0] for row in rows], np.int8)
    return Boxes(table[:, :2], size, np.zeros(len(rows)), table[:, 2], kind=kind).single()


def joined(rule: Rule, *each: Boxes) -> Boxes:
    """What a drone makes of its own boxes and its peers', all of full weight."""
    peers = [SourceBoxes(its, 1.0, HERE) for its in each[1:]]
    return joined_many([EgoSources(HERE, each[0], False, peers)], rule)[0]


@pytest.mark.parametrize("rule", RULES)
def test_boxes_of_two_classes_in_one_place_both_stay(rule: Rule) -> None:
    out = joined(rule, boxes((CAR, 0, 0, 0.9)), boxes((TRUCK, 0.5, 0, 0.8), (PERSON, 0, 0, 0.7)))
    assert sorted(out.kind.tolist()) == [CAR, TRUCK, PERSON]
    same = joined(rule, boxes((TRUCK, 0, 0, 0.9)), boxes((TRUCK, 0.5, 0, 0.8)))
    assert same.kind.tolist() == [TRUCK]


def people(*rows: tuple[float, float]) -> Boxes:
    """People on one line, by place and score."""
    return boxes(*((PERSON, x_m, 0.0, score) for x_m, score in rows))


@pytest.mark.parametrize(
    ("own", "peers", "best_m", "mean_m"),
    [
        # whoever one camera sees beside each other are two, though their boxes overlap: the ego's, and a peer's
        ([(0.0, 0.9), (0.3, 0.8)], [[(30.0, 0.7)]], [0.0, 0.3, 30.0], [0.0, 0.3, 30.0]),
        ([], [[(0.0, 0.9), (0.3, 0.8)]], [0.0, 0.3], [0.0, 0.3]),
        # two cameras see one person within 2 m, and place her by score: (0 × 0.8 + 1.2 × 0.4) / 1.2
        ([(0.0, 0.8)], [[(1.2, 0.4)]], [0.0], [0.4]),
        ([(0.0, 0.8)], [[(2.1, 0.4)]], [0.0, 2.1], [0.0, 2.1]),
        # a box near two people of another camera is of the better one: (0.6 × 0.7) / 1.6
        ([(0.0, 0.9), (1.0, 0.8)], [[(0.6, 0.7)]], [0.0, 1.0], [0.2625, 1.0]),
        ([(1.0, 0.8), (0.0, 0.9)], [[(0.6, 0.7)]], [0.0, 1.0], [0.2625, 1.0]),
        # three cameras: two boxes 3 m apart are of one person between them: (1.5 × 0.8 − 1.5 × 0.7) / 2.4
        ([(0.0, 0.9)], [[(1.5, 0.8)], [(-1.5, 0.7)]], [0.0], [0.0625]),
        # no chain: the third box is near the second alone, which is the first one's
        ([(0.0, 0.9)], [[(1.8, 0.8)], [(3.4, 0.7)]], [0.0, 3.4], [1.8 * 0.8 / 1.7, 3.4]),
    ],
)
@pytest.mark.parametrize("rule", RULES)
def test_boxes_of_people_are_merged_between_cameras_and_never_of_one(
    rule: Rule,
    own: list[tuple[float, float]],
    peers: list[list[tuple[float, float]]],
    best_m: list[float],
    mean_m: list[float],
) -> None:
    """Suppression leaves the best box of each person, averaging the mean place by score. Cars stand far off, merged as ever."""
    cars = boxes((CAR, 60.0, 0.0, 0.5))
    out = joined(rule, Boxes.join([people(*own), cars]), *[Boxes.join([people(*rows), cars]) for rows in peers])
    places = sorted(zip(out.kind.tolist(), out.xy_m[:, 0].tolist(), strict=True))
    wanted = [(CAR, 60.0), *((PERSON, x_m) for x_m in sorted(best_m if rule == "nms" else mean_m))]
    assert [kind for kind, _ in places] == [kind for kind, _ in wanted]
    assert [x_m for _, x_m in places] == pytest.approx([x_m for _, x_m in wanted], abs=1e-5)
    np.testing.assert_allclose(out.size_m[out.kind == PERSON], [PERSON_SIZE_M[:2]] * len(best_m))


@pytest.mark.parametrize("rule", RULES)
def test_people_that_two_egos_know_of_are_not_merged_between_egos(rule: Rule) -> None:
    """They are joined in one call, and stand close to each other. Each keeps its own place of the person."""
    far = [SourceBoxes(people((40.0, 0.5)), 1.0, HERE)]
    egos = [EgoSources((0.5 * k, 0.0, 0.0), people((0.5 * k, 0.9 - 0.1 * k)), False, far) for k in range(3)]
    for k, out in enumerate(joined_many(egos, rule)):
        assert sorted(out.xy_m[:, 0].tolist()) == pytest.approx([0.5 * k, 40.0])


@pytest.mark.parametrize("rule", RULES)
def test_a_late_person_counts_less_by_walking_speed_and_not_by_a_cars(rule: Rule) -> None:
    def score(kind: TargetClass, age_s: float) -> float:
        late = SourceBoxes(boxes((kind, 0, 0, 0.8)), 1.0, HERE, age_s=age_s)
        ego = EgoSources(HERE, boxes(), False, [late], looked=False)
        return float(joined_many([ego], rule)[0].score[0])

    late = 1 - math.exp(-(NEAR_M**2) / (2 * (1.0 + 1.4**2 * 0.25))), 1 - math.exp(-(NEAR_M**2) / 2)
    assert score(PERSON, 0.5) == pytest.approx(0.8 * (1 - 0.9 + 0.9 * late[0] / late[1]), rel=1e-5)
    assert score(PERSON, 0.5) > score(CAR, 0.5)
    assert score(TRUCK, 0.0) == pytest.approx(0.8)


def test_cars_and_trucks_move_alike_and_people_by_their_own_parameters() -> None:
    assert movement(np.zeros(3, np.int8)) is CARS
    mixed = movement(np.array([CAR, TRUCK, PERSON]))
    for k, one in enumerate((CARS, CARS, PEOPLE)):
        assert [v[k] for v in mixed] == list(one)  # type: ignore[index]
    assert variance_m2(2.0, PEOPLE) == pytest.approx(1.0 + 0.9 * 2.8**2)
    assert still_right(2.0, 0.0, PEOPLE) == 1.0


# --- AP --------------------------------------------------------------------------------------------


def test_a_truck_that_is_called_a_car_is_a_false_positive_and_a_missed_truck() -> None:
    truth = boxes((TRUCK, 0, 0, 1.0), (CAR, 30, 0, 1.0))
    right = match(boxes((TRUCK, 0, 0, 0.9), (CAR, 30, 0, 0.8)), truth)
    assert right.hit.tolist() == [True, True]
    called = boxes((TRUCK, 0, 0, 0.9), (CAR, 30, 0, 0.8))
    wrong = match(Boxes(called.xy_m, called.size_m, called.yaw_rad, called.score), truth)  # cars, by default
    assert wrong.hit.tolist() == [False, True]


def test_people_are_found_by_distance_and_the_nearest_is_taken() -> None:
    truth = boxes((PERSON, 0, 0, 1.0), (PERSON, 1.5, 0, 1.0), (CAR, 10, 0, 1.0))
    near = match(boxes((PERSON, 0.2, 1.9, 0.9), (PERSON, 1.4, 0, 0.8)), truth)
    assert near.hit.tolist() == [True, True]
    assert match(boxes((PERSON, 0, 2.1, 0.9)), truth).hit.tolist() == [False]
    assert match(boxes((PERSON, 10, 0, 0.9)), truth).hit.tolist() == [False], "a car is no person"
    crowd = match(boxes((PERSON, 1.4, 0, 0.9), (PERSON, 1.3, 0.2, 0.8), (PERSON, 1.6, 0, 0.7)), truth)
    assert crowd.hit.tolist() == [True, True, False], "one person is found once; the second box takes the other"
    greedy = match(boxes((PERSON, 0.2, 0, 0.9), (PERSON, -1.0, 0, 0.8)), truth)
    assert greedy.hit.tolist() == [True, False], "the better box takes the nearer person, whom the other would have had"


def test_many_frames_are_matched_as_one_by_one() -> None:
    rng = np.random.default_rng(0)

    def some(count: int) -> Boxes:
        kinds = [TargetClass(k) for k in rng.integers(0, 3, count)]
        return boxes(*[(k, *rng.uniform(-6, 6, 2), rng.random()) for k in kinds])

    found, truth = [some(12) for _ in range(130)], [some(9) for _ in range(130)]
    for one, a, b in zip(match_many(found, truth), found, truth, strict=True):
        alone = match(a, b)
        assert one.hit.tolist() == alone.hit.tolist()
    assert sum(m.hit.sum() for m in match_many(found, truth)) > 100


def test_classes_of_vehicles_go_by_true_length() -> None:
    assert vehicle_classes(np.array([3.8, 5.8, 6.0, 9.0])).tolist() == [CAR, CAR, TRUCK, TRUCK]


# --- tracking --------------------------------------------------------------------------------------


def followed_twice(first: Boxes, second: Boxes) -> tuple[Tracks, list[int]]:
    tracks, next_id = Tracks.empty(), np.zeros(1, np.int64)
    for t_s, seen in ((0.0, first), (0.5, second)):
        owner = np.zeros(len(seen), np.int64)
        tracks, next_id, ids = step(tracks, seen, owner, np.array([t_s]), next_id)
    return tracks, ids.tolist()


def test_a_box_goes_on_a_track_of_its_class_alone() -> None:
    _, ids = followed_twice(boxes((CAR, 0, 0, 0.9)), boxes((PERSON, 0, 0, 0.9)))
    assert ids == [1], "the person begins a track"
    tracks, ids = followed_twice(
        boxes((CAR, 0, 0, 0.9), (PERSON, 0.3, 0, 0.8)), boxes((PERSON, 0, 0, 0.9), (CAR, 0.3, 0, 0.9))
    )
    assert ids == [1, 0]
    assert dict(zip(tracks.id.tolist(), tracks.kind.tolist(), strict=True)) == {0: CAR, 1: PERSON}


@pytest.mark.parametrize(("kind", "goes_on"), [(CAR, True), (TRUCK, True), (PERSON, False)])
def test_nobody_walks_as_fast_as_cars_drive(kind: TargetClass, goes_on: bool) -> None:
    """Seven metres in half a second: a car may have driven so far, and another person stands there."""
    _, ids = followed_twice(boxes((kind, 0, 0, 0.9)), boxes((kind, 7.0, 0, 0.9)))
    assert ids == [0 if goes_on else 1]
    _, ids = followed_twice(boxes((kind, 0, 0, 0.9)), boxes((kind, 0.7, 0, 0.9)))
    assert ids == [0]


def test_late_boxes_are_moved_by_tracks_of_their_class_and_no_person_is_a_target() -> None:
    n = 2
    moving = np.array([[8.0, 0.0], [1.0, 0.0]])
    covariance, at = np.tile([0.1, 0.0, 0.01], (n, 1)), np.zeros(n)
    tracks = Tracks(
        np.zeros(n, np.int64), np.arange(n), at, np.zeros((n, 2)), moving, covariance, np.ones((n, 2)), at, np.ones(n),
        np.full(n, 5), np.full(n, 5), at, np.ones(n, bool), np.array([CAR, PERSON], np.int8),
    )  # fmt: skip
    velocity, _ = motion_of_boxes(boxes((PERSON, 0, 0, 0.9), (CAR, 0, 0, 0.9), (TRUCK, 0, 0, 0.9)), 0.0, 0.3, tracks)
    np.testing.assert_array_equal(velocity, [[1, 0], [8, 0], [np.nan, np.nan]])
    assert boxes_of(tracks).kind.tolist() == [CAR, PERSON]
    cue = {0: (0.0, 0.0, 1.0, 0.0)}
    assert followed(tracks, cue, {}, 0.0) == {}
    walks = tracks.take(np.array([1]))
    car = Tracks(*[getattr(walks, f) for f in Tracks.__slots__[:-1]])
    assert followed(car, cue, {}, 0.0) == {0: 1}, "the same track of a car is the target"


def test_tracks_name_their_class_on_the_wire_in_the_same_bytes() -> None:
    tracks, _ = followed_twice(
        boxes((CAR, 0, 0, 0.9), (PERSON, 9, 0, 0.8)), boxes((CAR, 0, 0, 0.9), (PERSON, 9, 0, 0.8))
    )
    datagram = packed(tracks, (0.0, 0.0))
    assert len(datagram) == 2 * budget.TRACK_BYTES
    assert unpacked(datagram, 0, (0.0, 0.0), 0.5).kind.tolist() == tracks.kind.tolist()
    unknown = np.frombuffer(datagram, TRACK).copy()
    unknown["kind"] = 3
    with pytest.raises(ValueError, match="a track's class is 3, must be at most 2"):
        unpacked(unknown.tobytes(), 0, (0.0, 0.0), 0.5)


# --- payloads --------------------------------------------------------------------------------------


def test_detections_have_one_byte_more_where_there_are_several_classes() -> None:
    directive = Directive(0, 1, Representation.DETECTIONS, 0.0, Disc(0, 0, 20), 2.0)
    head = HEADER_BYTES + DIRECTIVE_BYTES
    people = boxes((PERSON, 0, 0, 0.9), (PERSON, 50, 0, 0.9))

    def made(**classes: object) -> tuple[int, int, Boxes | None]:
        payload = make_payload(directive, 0, 0, 0, lambda roi: 7, **classes)  # type: ignore[arg-type]
        assert payload is not None
        return payload.boxes, payload.size_bytes, payload.people

    assert made() == (7, head + 7 * 24, None)
    assert made(classes=True) == (7, head + 7 * 25, None)
    count, size, sent = made(people_in=people.inside, classes=True)
    assert (count, size) == (8, head + 8 * 25)
    assert sent is not None
    assert sent.xy_m.tolist() == [[0, 0]], "those in the region"
