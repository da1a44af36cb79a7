"""What boxes are compared by: classes, what lateness leaves of them, and poses that are corrected by them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from perception_examples import cross
from scipy.stats import rayleigh
from wrong_rows import wrong_rows

from sortie.fleet.gate import HEADER_BYTES, make_payload
from sortie.fleet.messages.wire import DIRECTIVE_BYTES
from sortie.perception.classes import CAR, NEAR_M, PERSON, PERSON_SIZE_M, TRUCK, TargetClass, vehicle_classes
from sortie.perception.joining import EgoSources, Rule, SourceBoxes, joined_many
from sortie.perception.lateness import (
    CARS,
    MOVING,
    PEOPLE,
    SIGMA0_M,
    SPEED_MPS,
    map_weight,
    movement,
    moving_m2,
    own_age_s,
    reach_m,
    stands,
    still_right,
    still_right_of,
    variance_m2,
    weighed,
)
from sortie.perception.metrics.ap import match
from sortie.perception.pose_matching import (
    BOX_SIGMA_M,
    GATE_M,
    HEADING_SIGMA_RAD,
    POSITION_SIGMA_M,
    matched_poses,
    sure,
)
from sortie.perception.types import Boxes, Capture, Share
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


PEOPLE_OF_ONE_PLACE = [
    # own boxes and each peer's by place and score; where they are then by suppression, and by averaging
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
]
Seen = list[tuple[float, float]]


@pytest.mark.parametrize("rule", RULES)
def test_boxes_of_people_are_merged_between_cameras_and_never_of_one(rule: Rule) -> None:
    """Cars stand far off, merged as ever."""
    cars = boxes((CAR, 60.0, 0.0, 0.5))

    def check(own: Seen, peers: list[Seen], best_m: list[float], mean_m: list[float]) -> None:
        out = joined(rule, Boxes.join([people(*own), cars]), *[Boxes.join([people(*rows), cars]) for rows in peers])
        places = sorted(zip(out.kind.tolist(), out.xy_m[:, 0].tolist(), strict=True))
        wanted = [(CAR, 60.0), *((PERSON, x_m) for x_m in sorted(best_m if rule == "nms" else mean_m))]
        assert [kind for kind, _ in places] == [kind for kind, _ in wanted]
        assert [x_m for _, x_m in places] == pytest.approx([x_m for _, x_m in wanted], abs=1e-5)
        np.testing.assert_allclose(out.size_m[out.kind == PERSON], [PERSON_SIZE_M[:2]] * len(best_m))

    assert wrong_rows(PEOPLE_OF_ONE_PLACE, check) == {}


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
        assert [v[k] for v in mixed] == list(one)
    assert variance_m2(2.0, PEOPLE) == pytest.approx(1.0 + 0.9 * 2.8**2)
    assert still_right(2.0, 0.0, PEOPLE) == 1.0


def test_classes_of_vehicles_go_by_true_length() -> None:
    assert vehicle_classes(np.array([3.8, 5.8, 6.0, 9.0])).tolist() == [CAR, CAR, TRUCK, TRUCK]


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


def test_detections_have_one_byte_more_where_there_are_several_classes() -> None:
    directive = Directive(0, 1, Representation.DETECTIONS, 0.0, Disc(0, 0, 20), 2.0)
    head = HEADER_BYTES + DIRECTIVE_BYTES
    people = boxes((PERSON, 0, 0, 0.9), (PERSON, 50, 0, 0.9))

    def made(**classes: object) -> tuple[int, int, Boxes | None]:
        payload = make_payload(directive, 0, 0, 0, lambda roi: 7, **classes)
        assert payload is not None
        return payload.boxes, payload.size_bytes, payload.people

    assert made() == (7, head + 7 * 24, None)
    assert made(classes=True) == (7, head + 7 * 25, None)
    count, size, sent = made(people_in=people.inside, classes=True)
    assert (count, size) == (8, head + 8 * 25)
    assert sent is not None
    assert sent.xy_m.tolist() == [[0, 0]], "those in the region"


AGES_S = np.array([0.0, 0.1, 0.3, 1.0, 60.0])
REACH_M = 0.95


def test_a_late_place_has_the_variance_of_the_declared_model() -> None:
    """Drawn cars, of which a share moves, are off by what the closed form says."""
    rng = np.random.default_rng(1)
    for age_s in (0.0, 0.2, 1.0):
        moves = rng.random(400_000) < MOVING
        sigma = np.where(moves, np.hypot(SIGMA0_M, SPEED_MPS * age_s), SIGMA0_M)
        off = sigma * rng.normal(size=400_000)
        assert off.var() == pytest.approx(float(variance_m2(age_s)), rel=0.02)


def test_the_chance_to_be_right_is_that_of_a_rayleigh_distance() -> None:
    fresh = rayleigh.cdf(REACH_M, scale=SIGMA0_M)
    late = rayleigh.cdf(REACH_M, scale=np.sqrt(moving_m2(AGES_S)))
    np.testing.assert_allclose(still_right(REACH_M, AGES_S), 1 - MOVING + MOVING * late / fresh, rtol=1e-12)
    assert still_right(REACH_M, 0.0) == 1.0
    assert (np.diff(still_right(REACH_M, AGES_S)) < 0).all()
    assert still_right(REACH_M, 60.0) == pytest.approx(1 - MOVING, abs=1e-3)  # cars that stand stay
    np.testing.assert_allclose(still_right_of(REACH_M, [SIGMA0_M**2, 1e-6, 1e9]), [1.0, 1.0, 0.0], atol=1e-6)
    assert reach_m(np.array([[4.5, 1.9]])) == pytest.approx(np.sqrt(1.5 * 1.9 / 3))


def test_a_map_counts_by_the_inverse_of_its_variance() -> None:
    assert map_weight(0.095, 0.095) == 1.0
    assert map_weight(0.095, 0.4) == 1.0  # an older look of one's own does not make a map count more than in full
    weights = [map_weight(age_s, 0.095) for age_s in (0.195, 0.295, 0.5, 2.0)]
    assert weights == sorted(weights, reverse=True)
    assert weights[0] == pytest.approx(float(variance_m2(0.095) / variance_m2(0.195)))
    assert weights[-1] < 0.01


def test_the_chance_that_a_car_stands_is_that_of_bayes() -> None:
    """From the densities of the distance between two of its boxes, each off by σ0 along each axis."""
    off_m, apart_s = np.array([0.0, 0.3, 0.8, 1.5, 2.5]), np.array([0.1, 0.1, 0.3, 0.3, 1.0])
    still = (1 - MOVING) * rayleigh.pdf(off_m + 1e-9, scale=np.sqrt(2) * SIGMA0_M)
    moves = MOVING * rayleigh.pdf(off_m + 1e-9, scale=np.sqrt(2 * SIGMA0_M**2 + (SPEED_MPS * apart_s) ** 2))
    np.testing.assert_allclose(stands(off_m, apart_s), still / (still + moves), rtol=1e-6)
    assert stands(np.array([0.2]), np.array([0.0])) == pytest.approx(1 - MOVING)  # at one time nothing tells
    assert np.isfinite(stands(np.array([0.0, 1e3]), np.array([60.0, 60.0]))).all()


def test_ages_are_compared_with_the_freshest_look_at_hand() -> None:
    """The ego's own where it has looked, else the freshest that came; only what is older loses."""
    ego, a, b, c = cross(0.0, 0.0, 0.0, t_s=5.0)[:4]

    def late(who: Capture, age_s: float, now_s: float = 5.1) -> Share:
        return Share(who._replace(t_s=now_s - age_s), "features", 0.2, None, 0.8, (), age_s)

    shares = [late(a, 0.1), late(b, 0.4), late(c, 0.7)]
    assert own_age_s(ego, shares) == pytest.approx(0.1)
    weights = [s.weight for s in weighed(ego, shares)]
    assert weights == pytest.approx([0.8, 0.8 * map_weight(0.4, 0.1), 0.8 * map_weight(0.7, 0.1)])
    blind = ego._replace(looked=False)
    rest = shares[1:]
    assert [s.weight for s in weighed(blind, rest)] == pytest.approx([0.8, 0.8 * map_weight(0.7, 0.4)])
    # a receiver may hold an age to be longer than it is: the moment is that of the one that it knows best
    assert own_age_s(ego, [*shares, late(b, 0.2)._replace(age_s=0.9)]) == pytest.approx(0.1)
    boxes = late(b, 0.4)._replace(representation="detections")
    assert weighed(ego, [boxes]) == [boxes]
    assert own_age_s(b._replace(t_s=5.1), [late(a, 0.4, 5.4)]) == pytest.approx(0.3)  # by the shares of that ego


CARS_M = np.random.default_rng(3).uniform(-80, 80, (40, 2))


def placed(cars: np.ndarray, true: np.ndarray, believed: np.ndarray) -> np.ndarray:
    """Where a drone that believes another pose than its true one puts cars."""
    c, s = np.cos(believed[2] - true[2]), np.sin(believed[2] - true[2])
    return believed[:2] + (cars - true[:2]) @ np.array([[c, s], [-s, c]])


def test_two_drones_share_a_shift_by_the_closed_form() -> None:
    """Cars in a ring about both: no turn, and of a difference d each takes its part of the posterior mean."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = 40 * np.column_stack([np.cos(angle), np.sin(angle)])
    fitted = matched_poses([(0, 0, 0.4), (0, 0, -0.2)], [ring + np.array([0.3, 0.0]), ring])
    per_drone, per_difference = POSITION_SIGMA_M**2, 2 * BOX_SIGMA_M**2 / len(ring)
    part = 0.3 * per_drone / (2 * per_drone + per_difference)
    np.testing.assert_allclose(fitted, [(-part, 0, 0.4), (part, 0, -0.2)], atol=1e-9)


def test_it_is_what_least_squares_over_pairs_found_one_by_one_give() -> None:
    """Poses far from the origin; some drones see nothing."""

    def check(n: int) -> None:
        rng = np.random.default_rng(n)
        poses = np.column_stack([5000.0 + rng.uniform(-40, 40, (n, 2)), rng.uniform(-3, 3, n)])
        cars = 5000.0 + rng.uniform(-50, 50, (25, 2))
        places = [cars[rng.random(25) < 0.6] if k % 4 != 3 else cars[:0] for k in range(n)]
        places = [each + rng.normal(0.0, 0.5, each.shape) for each in places]
        sigmas = np.tile([POSITION_SIGMA_M, POSITION_SIGMA_M, HEADING_SIGMA_RAD], n)
        rows, right = [*np.diag(1.0 / sigmas)], [0.0] * (3 * n)
        for a in range(n):
            for b in range(a + 1, n):
                for p in places[a]:
                    for q in places[b]:
                        is_nearest = all(np.hypot(*(p - o)) >= np.hypot(*(p - q)) for o in places[b])
                        is_nearest &= all(np.hypot(*(q - o)) >= np.hypot(*(p - q)) for o in places[a])
                        if is_nearest and np.hypot(*(p - q)) < GATE_M:
                            for axis in range(2):
                                row = np.zeros((n, 3))
                                for drone, place, sign in ((a, p, 1.0), (b, q, -1.0)):
                                    row[drone, axis] = sign
                                    turn = place - poses[drone, :2]
                                    row[drone, 2] = sign * (-turn[1], turn[0])[axis]
                                rows.append(row.ravel() / (BOX_SIGMA_M * np.sqrt(n)))
                                right.append((p - q)[axis] / (BOX_SIGMA_M * np.sqrt(n)))
        assert len(rows) > 3 * n + 20 or n == 1
        errors = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0].reshape(n, 3)
        np.testing.assert_allclose(matched_poses(poses, places), poses - errors, rtol=0, atol=1e-9)

    assert wrong_rows([1, 2, 4, 12], check) == {}


def test_nothing_is_corrected_where_nothing_is_matched() -> None:
    nobody = np.empty((0, 2))
    poses = [(1.0, 2.0, 0.3), (4.0, 2.0, 0.1)]
    np.testing.assert_array_equal(matched_poses(poses, [nobody, CARS_M]), poses)
    np.testing.assert_array_equal(matched_poses(poses[:1], [CARS_M]), poses[:1])
    far = np.array([[0.0, 0.0]])
    np.testing.assert_array_equal(matched_poses(poses, [far, np.array([[GATE_M + 0.01, 0.0]])]), poses)
    between = np.array([[0.0, 0.0], [1.0, 0.0]])  # the second one's nearest is nearer to the first
    moved = matched_poses(poses, [between[:1], between])
    assert np.array_equal(moved[:, :2], np.array(poses)[:, :2]), "one pair, which agrees"


def test_weak_boxes_and_people_are_not_matched() -> None:
    """A detector of one's own may find people; a truck is a car to the network."""
    kind = np.array([CAR, CAR, TRUCK, PERSON], np.int8)
    boxes = Boxes(CARS_M[:4], np.ones((4, 2)), np.zeros(4), np.array([0.31, 0.29, 0.5, 0.9]), kind=kind)
    assert sure(boxes).xy_m.tolist() == CARS_M[[0, 2]].tolist()


def test_boxes_move_with_their_drones_pose() -> None:
    old, new = (3.0, -2.0, 0.5), (3.4, -2.5, 0.52)
    local = CARS_M[:6]
    boxes = Boxes(placed(local, np.zeros(3), np.array(old)), np.ones((6, 2)), np.arange(6.0), np.ones(6))
    moved = boxes.moved(old, new)
    np.testing.assert_allclose(moved.xy_m, placed(local, np.zeros(3), np.array(new)), atol=1e-4)
    np.testing.assert_allclose(moved.yaw_rad, np.arange(6) + 0.02, atol=1e-6)
    assert boxes.moved(old, old) is boxes
