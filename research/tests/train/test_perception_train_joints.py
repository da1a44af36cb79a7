"""A training step's parts by hand: targets and losses, the mean of the shards, levels of pose error, and whose errors count."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from research.benchmark.dataset import Benchmark, Frames
from research.paper.results import TAU
from research.paper.ways import FULL_SHARING, SINGLE
from research.train import boxes_alone, validation
from research.train.box_errors import common, errors_of
from research.train.learn import Thinning, _fit, apply, local_cars, loss_of, targets
from research.train.recipe import Recipe, command, of_benchmark
from research.train.validation import LEVELS, validate, validate_all, with_errors
from sortie.perception.geometry import HEAD_PX, Geometry
from sortie.perception.network.decode import REFERENCE_SIZE_M
from sortie.perception.types import Boxes
from sortie.perception.uncertainty import TERMS, BoxErrors

HALF = Geometry(51.2)
CARS = np.array([[10.3, -20.7, 5.0, 2.0, 0.4], [-30.0, 7.1, 4.0, 1.8, -1.2], [11.9, -20.1, 4.4, 1.9, 2.0]])


def frames(true: np.ndarray, est: np.ndarray) -> Frames:
    n = len(true)
    return Frames(np.zeros((n, 1), np.uint8), true, est, np.zeros((n, 0, 5)), np.arange(n))


def test_a_drone_learns_the_cars_of_its_own_square_in_its_own_frame() -> None:
    pose = np.array([100.0, 50.0, np.pi / 2])
    world = np.array([[100.0, 80.0, 4.5, 1.9, 2.0], [40.0, 50.0, 4.5, 1.9, 0.0], [90.0, 50.0, 5.0, 2.0, 0.0]])
    np.testing.assert_allclose(
        local_cars(world, pose, HALF), [[30, 0, 4.5, 1.9, 2 - np.pi / 2], [0, 10, 5.0, 2.0, -np.pi / 2]], atol=1e-6
    )
    assert len(local_cars(world, pose)) == 3


def test_targets_lie_about_each_car_and_say_where_it_is_and_how_it_is_turned() -> None:
    """Heat is 1 in the nearest cell, else a Gaussian of 0.8 cells; what is learned lies in three by three cells."""
    labels = targets([CARS, CARS[:1]], HALF)
    first = labels.sample == 0
    assert torch.equal(labels.sample, labels.sample.sort().values), "output by output"
    assert labels.cars == len(CARS) + 1
    cell_m = 102.4 / HEAD_PX
    at = (CARS[:, :2] + 51.2) / cell_m - 0.5
    expected = np.zeros((HEAD_PX, HEAD_PX))
    rows = []
    for car, place in zip(CARS, at, strict=True):
        middle = np.round(place).astype(int)
        for i in range(-2, 3):
            for j in range(-2, 3):
                cell = middle + np.array([i, j])
                g = 1.0 if i == j == 0 else np.exp(-((place - cell) ** 2).sum() / (2 * 0.64))
                expected[tuple(cell)] = max(expected[tuple(cell)], g)
                if max(abs(i), abs(j)) < 2:
                    size = np.log(car[2:4] / REFERENCE_SIZE_M)
                    turn = np.sin(2 * car[4]), np.cos(2 * car[4])
                    rows.append((cell[0] * HEAD_PX + cell[1], *(place - cell), *size, *turn, g))
    np.testing.assert_allclose(labels.heat[0], expected, atol=1e-6)
    table = np.column_stack([part[first] for part in (labels.cell, labels.values, labels.weight)])
    rows = np.array(rows)
    np.testing.assert_allclose(
        table[np.lexsort((table[:, 3], table[:, 0]))], rows[np.lexsort((rows[:, 3], rows[:, 0]))], atol=1e-5
    )


@pytest.mark.parametrize("planes", [7, 8])
def test_a_loss_is_that_of_heat_by_cars_and_of_boxes_by_weight(planes: int) -> None:
    """A network that tells how well its boxes fit places them twice as carefully."""
    torch.manual_seed(3)
    out = 0.5 * torch.randn(2, planes, HEAD_PX, HEAD_PX)
    labels = [CARS, CARS[:1]]
    made = [targets([c], HALF) for c in labels]
    logit = out[:, 0].numpy().astype(float)
    p, heat = 1 / (1 + np.exp(-logit)), np.concatenate([m.heat for m in made])
    centre = heat > 0.9999
    focal = -((1 - p) ** 2 * np.log(p))[centre].sum() - ((1 - heat) ** 4 * p**2 * np.log(1 - p))[~centre].sum()
    said = np.concatenate([out[k, 1:].flatten(1).numpy()[:, m.cell].T for k, m in enumerate(made)])
    want, weight = np.concatenate([m.values for m in made]), np.concatenate([m.weight for m in made])
    scale = np.array([1, 1, 0.5, 0.5, 0.4, 0.4]) * ([2, 2, 1, 1, 1, 1] if planes == 8 else 1)
    expected = focal / 4 + (np.abs(said[:, :6] - want) * scale * weight[:, None]).sum() / weight.sum()
    if planes == 8:
        fit, x = _fit(said[:, :6], want, HALF.head_m), said[:, 6]
        each = np.logaddexp(0, -x) * fit + np.logaddexp(0, x) * (1 - fit)
        expected += (each * weight).sum() / weight.sum()
    assert float(loss_of(out, targets(labels, HALF), HALF)) == pytest.approx(expected, rel=1e-4)
    assert float(loss_of(out, targets([c[:0] for c in labels], HALF), HALF)) > 0


def test_a_fit_is_the_overlap_of_the_boxes_that_are_meant() -> None:
    """Turned by 90° a box of 2 : 1 overlaps by a third; offsets are cells, sizes logarithms, angles doubled."""
    square = np.log(np.array([4.0, 2.0]) / REFERENCE_SIZE_M)

    def row(x: float, turn: float) -> np.ndarray:
        return np.array([[x, 0.0, *square, np.sin(2 * turn), np.cos(2 * turn)]], np.float32)

    for x, turn, iou in (
        (0.0, 0.0, 1.0),
        (0.0, np.pi / 2, 1 / 3),
        (0.0, np.pi, 1.0),
        (1.25, 0.0, 2 / 6),
        (5.0, 0.0, 0.0),
    ):
        assert _fit(row(x, turn), row(0.0, 0.0), 1.6)[0] == pytest.approx(iou, abs=1e-4)


class Downhill:
    """An optimiser that goes down the whole gradient."""

    def __init__(self, net: Any) -> None:
        self.net = net

    def step(self) -> None:
        for parameter in self.net.parameters():
            parameter -= parameter.grad


def test_a_step_goes_down_the_mean_of_the_shards_and_all_are_the_network_again() -> None:
    """Running statistics are the mean of the shards', whole numbers the first one's; long gradients are made 5 long."""
    net: Any = torch.nn.BatchNorm1d(2)
    replicas: list[Any] = [torch.nn.BatchNorm1d(2) for _ in range(2)]
    optimiser: Any = Downhill(net)
    for k, replica in enumerate(replicas):
        replica.running_mean += torch.tensor([1.0, 2.0]) * (k + 1)
        replica.num_batches_tracked += 7 + k
    grads = [
        [torch.tensor([1.0, 0.0]), torch.tensor([0.0, 2.0])],
        [torch.tensor([3.0, 0.0]), torch.tensor([0.0, -1.0])],
    ]
    apply(net, replicas, grads, optimiser)
    for module in (net, *replicas):
        assert module.weight.tolist() == [-1.0, 1.0]
        assert module.bias.tolist() == [0.0, -0.5]
        assert module.running_mean.tolist() == [1.5, 3.0]
        assert module.num_batches_tracked.item() == 7
    apply(net, replicas, [[torch.tensor([30.0, 40.0]), torch.zeros(2)]] * 2, optimiser)
    assert net.weight.tolist() == pytest.approx([-4.0, -3.0], abs=1e-4)


def test_errors_of_pose_are_multiplied_each_by_its_own_factor_and_the_short_way_round() -> None:
    true = np.array([[[1.0, 2.0, 3.1]]])
    est = np.array([[[1.5, 1.0, -3.1]]])
    turn = 2 * np.pi - 6.2
    found = with_errors(frames(true, est), 2.0, 0.5)
    np.testing.assert_allclose(found.est_pose, [[[2.0, 0.0, 3.1 + turn / 2]]])
    np.testing.assert_array_equal(found.true_pose, true)
    np.testing.assert_array_equal(with_errors(frames(true, est), 0.0, 0.0).est_pose, true)


def test_validation_sets_a_drone_alone_against_all_by_whole_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def evaluate(instrument: Any, data: Any, conditions: Any, **rest: Any) -> Any:
        asked.append((data, conditions, rest))
        return SimpleNamespace(matched=lambda c: c, groups=lambda by: np.array([by]))

    monkeypatch.setattr(validation, "evaluate", evaluate)
    monkeypatch.setattr(validation, "CarNetInstrument", lambda net, device: None)
    monkeypatch.setattr(validation, "compare", lambda a, b, groups: (a, b, groups))
    data, cpu = frames(np.zeros((2, 1, 3)), np.ones((2, 1, 3))), torch.device("cpu")
    net: Any = None
    assert validate(net, data, cpu, 3) == (SINGLE, FULL_SHARING, ["scene"])
    ((given, conditions, rest),) = asked
    assert given is data
    assert conditions == (SINGLE, FULL_SHARING)
    assert rest == {"regions": ("full",), "egos": 3, "floor": TAU}
    asked.clear()
    told: list[Any] = []
    levels = validate_all(net, data, Benchmark(), cpu, lambda *at: told.append(at))
    assert [(v.position_sigma_m, v.heading_sigma_deg) for v in levels] == [(0.2 * p, 0.2 * h) for p, h in LEVELS]
    for (given, _, rest), (p, h) in zip(asked, LEVELS, strict=True):
        np.testing.assert_allclose(given.est_pose, np.tile([p, p, h], (2, 1, 1)))
        assert rest["egos"] == 5
    assert told == [(k, 3) for k in (1, 2, 3)]


def test_thinning_is_drawn_for_each_shard_and_step_and_fills_as_the_recipe_says() -> None:
    recipe = Recipe(cell_dropout=0.5, unsent="zero")
    made = [Thinning.of(recipe, step, shard) for step, shard in ((3, 0), (3, 1), (4, 0), (3, 0))]
    sent = [t.sent(8) for t in made if t is not None]
    assert [t.unsent for t in made if t is not None] == ["zero"] * 4
    assert torch.equal(sent[0], sent[3])
    assert not torch.equal(sent[0], sent[1])
    assert not torch.equal(sent[0], sent[2])


def test_localisation_errors_are_by_the_poses_that_drones_believe_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boxes_alone, "errors_of", lambda boxes, pose, cars: (boxes, pose, cars.shape))
    data = frames(np.zeros((2, 2, 3)), np.arange(12.0).reshape(2, 2, 3))
    found = boxes_alone.moments_of(data, [["a", "b"], ["c", "d"]])  # type: ignore[list-item]
    assert found == [
        [("a", (0, 1, 2), (0, 5)), ("b", (3, 4, 5), (0, 5))],
        [("c", (6, 7, 8), (0, 5)), ("d", (9, 10, 11), (0, 5))],
    ]


def test_a_box_lies_on_the_car_that_it_overlaps_most_and_its_error_is_from_that_car() -> None:
    """Between two cars, nearer to the second; the sight is from the drone, not from the origin."""
    cars = np.array([[30.0, 40.0, 4.5, 1.9, 0.0], [33.0, 40.0, 4.5, 1.9, 0.0]])
    at = np.array([[31.9, 40.0], [31.2, 40.0]])
    seen = Boxes(at, np.tile([4.5, 1.9], (2, 1)), np.zeros(2), np.array([0.9, 0.8]))
    found = errors_of(seen, (31.9, 10.0, 0.0), cars)
    assert found.car.tolist() == [1, 0]
    np.testing.assert_allclose(found.off_m, [[-1.1, 0.0], [1.2, 0.0]], atol=1e-6)
    np.testing.assert_allclose(found.sight[0], [0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(found.by_sight_m[0], [0.0, 1.1], atol=1e-6)
    assert found.distance_m[0] == pytest.approx(30.0)
    flat = BoxErrors((0.0,) * TERMS, (0.0,) * TERMS)
    assert common(flat, [[found]]) == 1.0, "nothing is known of pairs: as careful as can be"
    assert common(flat, [[found, found]]) == 1.0


def test_what_a_weights_file_says_of_its_data_is_that_benchmark_s() -> None:
    facts = of_benchmark(Benchmark(1, geometry=HALF))
    assert (facts["seed"], facts["half_extent_m"], facts["key"]) == (1, 51.2, Benchmark(1, geometry=HALF).key())
    assert command({"steps": 500, "seed": 3}, {}, 1, "x") == "python -m research train --seed 3 --bench-seed 1 --out x"
    assert (
        command({}, {"half_extent_m": 51.2, "fusion": "disconet"}, 0, "x")
        == "python -m research train --range 51.2 --out x"
    )
