"""The calibration's file and its parts: what is broken is named; sight and regressions against plain definitions."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from perception_examples import EMPTY
from safetensors.numpy import load_file, save_file
from scipy.special import expit
from wrong_rows import wrong_rows

from sortie.perception.scene.height_field import CAR_TOP_M
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.exchange import ALARM_COVARIATES, FUSED_COVARIATES
from sortie.perception.surrogate.features import LOOK_COVARIATES
from sortie.perception.surrogate.model import (
    FORMAT,
    KINDS,
    NETS,
    PLACE_COVARIATES,
    RANK_COVARIATES,
    SHIPPED,
    SPREAD,
    Net,
    Parameters,
    load,
    rank_covariates,
    save,
)
from sortie.scenarios.schema import Scene

RNG = np.random.Generator(np.random.PCG64(5))
START = RNG.bit_generator.state
CARD = {"format": FORMAT, "id": "x", "fusion": "disconet"}


@pytest.fixture(autouse=True)
def _the_same_draws_whatever_ran_before() -> None:
    RNG.bit_generator.state = START


@pytest.fixture(scope="module")
def parameters() -> Parameters:
    return load(SHIPPED)


def broken(path: Path, card: object = CARD, **changes: np.ndarray | None) -> Path:
    """The shipped calibration with tensors changed, or without those that are None."""
    tensors = {**load_file(SHIPPED), **changes}
    metadata = {} if card is None else {"surrogate": card if isinstance(card, str) else json.dumps(card)}
    save_file({k: np.ascontiguousarray(v) for k, v in tensors.items() if v is not None}, path, metadata=metadata)
    return path


def test_a_broken_calibration_is_named(tmp_path: Path) -> None:
    bad, nan = np.zeros((2, 2), np.float32), np.full(4, np.nan, np.float32)
    beside = (
        "holds no calibration, and c.surrogate.safetensors is not beside it; `python -m research calibrate` makes one"
    )
    rows = [
        (None, {}, beside),
        ("{", {}, "its card is no JSON: Expecting property name enclosed in double quotes: line 1 column 2 (char 1)"),
        ({**CARD, "format": 7}, {}, f"format is 7, must be {FORMAT}; calibrate again"),
        ({**CARD, "fusion": 3}, {}, "card.fusion is 3, must be text"),
        (CARD, {"alike": None}, "tensor alike is missing"),
        (CARD, {"alike": bad[0]}, "tensor alike has shape [2], must be [4]"),
        (CARD, {"look.0.weight": bad}, f"tensor look.0.weight has shape [2, 2], must be [{len(LOOK_COVARIATES)}, any]"),
        (CARD, {"alike": nan}, "tensor alike holds values that are not finite"),
    ]

    def check(card: object, changes: dict[str, np.ndarray | None], says: str) -> None:
        path = broken(tmp_path / "c.safetensors", card, **changes)
        with pytest.raises(ValueError, match=f"^{re.escape(f'{path}: {says}')}$"):
            load(path)

    assert wrong_rows(rows, check) == {}
    with pytest.raises(ValueError, match=r"none.safetensors: no such calibration; `python -m research calibrate`"):
        load(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("no")
    with pytest.raises(ValueError, match=r"text.safetensors: no safetensors file: "):
        load(tmp_path / "text.safetensors")


def test_what_is_saved_is_loaded(tmp_path: Path, parameters: Parameters) -> None:
    save(tmp_path / "again.safetensors", parameters)
    again = load(tmp_path / "again.safetensors")
    assert again.card == parameters.card
    for name in ("alike", "residuals", "alarm_edges", "alarm_range", "alarm_pool", "shared_false_positives", "boxes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(parameters, name))
    x = RNG.normal(size=(7, len(LOOK_COVARIATES))).astype(np.float32)
    np.testing.assert_array_equal(again.nets["look"](x), parameters.nets["look"](x))


def test_a_net_is_its_layers_however_many_rows_it_takes() -> None:
    weight = tuple(RNG.normal(size=s).astype(np.float32) for s in ((3, 5), (5, 2)))
    bias = tuple(RNG.normal(size=s).astype(np.float32) for s in (5, 2))
    x = RNG.normal(size=(1001, 3)).astype(np.float32)
    plain = np.maximum(x @ weight[0] + bias[0], 0) @ weight[1] + bias[1]
    np.testing.assert_allclose(Net(weight, bias)(x), plain, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["look", "find", "place"])
def test_a_row_of_a_net_is_the_same_to_the_bit_wherever_it_stands_and_whatever_order_it_is_added_in(
    name: str, parameters: Parameters
) -> None:
    """A matrix library adds in an order of its own, by machine and by place in the matrix."""
    net = parameters.nets[name]
    (first, *others), (shift, *shifts) = net.weight, net.bias
    x = RNG.normal(scale=2.0, size=(401, len(first))).astype(np.float32)
    out = net(x)
    for k in range(1, 40):
        np.testing.assert_array_equal(net(x[k : 5 * k]), out[k : 5 * k])
    inputs, hidden = RNG.permutation(len(first)), RNG.permutation(len(shift))
    mixed = Net((first[inputs][:, hidden], others[0][hidden], *others[1:]), (shift[hidden], *shifts))
    np.testing.assert_array_equal(mixed(np.ascontiguousarray(x[:, inputs])), out)


def test_sums_of_the_shipped_nets_stay_where_they_are_exact(parameters: Parameters) -> None:
    """Magnitudes of products below 2¹³ for any covariates within ±10, worst signs all along."""

    def check(name: str) -> None:
        net, reach = parameters.nets[name], np.full(len(parameters.nets[name].weight[0]), 10.0)
        for weight, bias in zip(net.weight, net.bias, strict=True):
            reach = reach @ np.abs(weight)
            assert reach.max() < 2.0**13
            reach = reach + np.abs(bias)

    assert wrong_rows(sorted(NETS), check) == {}


def test_cells_rank_by_five_of_a_look_s_covariates_its_confidence_and_how_many_cars_there_are() -> None:
    look, confidence = RNG.normal(size=(4, len(LOOK_COVARIATES))).astype(np.float32), np.arange(4, dtype=np.float32)
    columns = {name: look[:, k] for k, name in enumerate(LOOK_COVARIATES)}
    columns |= {"confidence": confidence, "cars": np.log([1, 4, 36, 101]) - 3.6}  # usually 35.6 and the one itself
    x = rank_covariates(look, confidence, np.array([0, 3, 35, 100]))
    np.testing.assert_allclose(x, np.stack([columns[name] for name in RANK_COVARIATES], axis=1), atol=1e-6)


def test_higher_draws_and_surer_drones_rank_higher(parameters: Parameters) -> None:
    x = np.zeros((50, len(RANK_COVARIATES)), np.float32)
    x[:, 0] = np.linspace(-4, 3, 50)
    fraction = parameters.rank(x, np.zeros(50, np.float32))
    assert fraction[0] > 10 * fraction[-1]
    assert (fraction <= 1).all()
    assert (fraction > 0).all()
    draw = parameters.rank(x[:1].repeat(3, 0), np.array([-1, 0, 1], np.float32))
    assert (np.diff(draw) > 0).all()


def test_one_draw_says_whether_there_is_a_box_and_the_other_how_high_its_score_is(parameters: Parameters) -> None:
    first, second = (draw.ravel() for draw in np.meshgrid(np.linspace(0.01, 0.99, 40), [0.6, 0.8, 0.95]))
    draw = np.column_stack([first, second]).astype(np.float32)
    score = parameters.find(lonely(len(first), range=0.7), draw).reshape(3, 40)
    there = score > 0.0
    assert 0 < there[0].sum() < 40
    assert (there == there[0]).all()
    assert (np.diff(there[0].astype(int)) <= 0).all(), "the lowest draws have one"
    assert [len(np.unique(row[there[0]])) for row in score] == [1, 1, 1]
    assert len(np.unique(score[:, 0])) == 3


def test_confidence_is_drawn_from_the_two_normals_that_it_is_said_to_be(parameters: Parameters) -> None:
    """Even draws, [0, 1], against the mixture's own mean and variance; and a higher draw is never less sure."""
    x = np.zeros((20_000, NETS["look"][0]), np.float32)
    drawn = parameters.confidence(x, ((np.arange(20_000) + 0.5) / 20_000).astype(np.float32))
    high, up, down, wide, narrow = (float(v) for v in parameters.nets["look"](x[:1])[0])
    p, a, b = expit(high), np.exp(np.clip(wide, *SPREAD)), np.exp(np.clip(narrow, *SPREAD))
    mean = p * up + (1 - p) * down
    variance = p * (a**2 + up**2) + (1 - p) * (b**2 + down**2) - mean**2
    assert drawn.mean() == pytest.approx(mean, abs=0.01)
    assert drawn.var() == pytest.approx(variance, rel=0.02)


def test_boxes_of_part_of_the_cars_lie_off_to_the_same_side_for_all_and_as_far_as_before(
    parameters: Parameters,
) -> None:
    """Two drones that look at the same cars, each with draws of its own; what lies ahead and turned left for one lies
    behind and turned right for the other."""
    n = 20_000
    x = np.concatenate([lonely(n, range=0.7), np.full((n, 1), 0.5, np.float32)], axis=1)
    mean = parameters.nets["place"](x)[:, :5]
    ours = offset_draw(n)
    theirs = ours * np.array([1, -1, 1, -1], np.float32)
    draw = RNG.random((2, n), np.float32)
    far = []
    for part in (0.0, 0.4, 1.0):
        some = replace(parameters, alike=np.append(parameters.alike[:3], np.float32(part)))
        a, b = (some.place(x, u, t)[0] - mean for u, t in zip(draw, (ours, theirs), strict=True))
        same = [(np.sign(a[:, k]) == side * np.sign(b[:, k])).mean() for k, side in enumerate((-1, 1, -1))]
        np.testing.assert_allclose(same, 0.5 + part / 2, atol=0.06)
        far.append(np.abs(a))
    np.testing.assert_allclose(far[1:], [far[0]] * 2, rtol=1e-3, atol=1e-5)


def lonely(n: int, **look: float) -> np.ndarray:
    """Covariates [n, 28] of cars in sight that nobody else's map shows, 0 but for what is given of the `look`."""
    x = np.zeros((n, len(FUSED_COVARIATES)), np.float32)
    named = {"first": -8.0, "second": -8.0, "mean": -8.0, "own_visible": 1.0} | {f"own_{k}": v for k, v in look.items()}
    for name, value in named.items():
        x[:, FUSED_COVARIATES.index(name)] = value
    return x


def offset_draw(n: int) -> np.ndarray:
    """As `Drawn.offset_draw`."""
    return np.column_stack([RNG.random(n), RNG.choice([-1.0, 1.0], (n, 3))]).astype(np.float32)


def test_sight_is_a_ray_against_boxes() -> None:
    """Houses alone, against rays that are stepped finely through the rectangles themselves."""
    scene = SceneModel(Scene(tree_density=0.0), None, (-50, -50, 50, 50))
    houses = np.concatenate([b.buildings for b in scene.town.blocks(-120, -120, 120, 120)])
    field, n = scene.height_field, 600
    x, y = RNG.uniform(-80, 80, n), np.round(RNG.uniform(-80, 80, n) / 80) * 80 + RNG.uniform(-5, 5, n)
    eye = np.stack([RNG.uniform(-50, 50, n), RNG.uniform(-50, 50, n), np.full(n, 60.0)], axis=1)
    z = np.arange(CAR_TOP_M, 30.0, 0.1)[:, None]
    part = (z - CAR_TOP_M) / (60.0 - CAR_TOP_M)
    px, py = x + part * (eye[:, 0] - x), y + part * (eye[:, 1] - y)
    hidden = np.zeros(n, bool)
    for x0, y0, x1, y1, top, _ in houses:
        hidden |= ((px > x0) & (px < x1) & (py > y0) & (py < y1) & (z < top)).any(axis=0)
    assert 0.03 < hidden.mean() < 0.9
    assert (field.seen(x, y, eye) == ~hidden).mean() > 0.95


def test_nothing_hides_on_an_empty_plain() -> None:
    field = SceneModel(EMPTY, None, (-50, -50, 50, 50)).height_field
    eye = np.tile((0.0, 0.0, 60.0), (9, 1))
    assert field.seen(np.linspace(-90, 90, 9), np.zeros(9), eye).all()
    assert field.lit(np.zeros(3), np.zeros(3)).all()


def test_false_alarms_beyond_what_was_fitted_are_those_at_its_edge(parameters: Parameters) -> None:
    """Lower suns, larger fleets and older maps than any that a calibration draws; late and moving act together."""
    low, high = ends = parameters.alarm_range
    beyond = ends + np.array([[-10.0], [10.0]], np.float32)
    np.testing.assert_array_equal(parameters.alarm_rates(beyond), parameters.alarm_rates(ends))
    assert parameters.alarm_rates(ends).sum(axis=1).max() < 300
    late, moving, gone = (ALARM_COVARIATES.index(name) for name in ("late", "moving", "gone"))
    both = np.tile((low + high) / 2, (2, 1)).astype(np.float32)
    both[:, late], both[:, moving] = high[late] * np.array([1.0, 2.0]), high[moving] / 2
    both[:, gone] = both[:, late] * both[:, moving]
    np.testing.assert_array_equal(*parameters.alarm_rates(both))


def test_residuals_are_those_of_drones_alone_or_fleets_and_of_square_cars_or_others(parameters: Parameters) -> None:
    """Pools that lie 0 … 7 m off along the car, planted; the networks say nothing."""
    pools = np.zeros_like(parameters.residuals)
    pools[..., 0] = np.arange(KINDS)[:, None]
    zero = Net((np.zeros((len(PLACE_COVARIATES), 11), np.float32),), (np.zeros(11, np.float32),))
    planted = replace(
        parameters, nets={**parameters.nets, "place": zero}, residuals=pools, alike=np.zeros(4, np.float32)
    )
    x = np.zeros((KINDS, len(PLACE_COVARIATES)), np.float32)
    x[2:, PLACE_COVARIATES.index("senders")] = 1.5
    x[2:, PLACE_COVARIATES.index("part")] = (0.01, 0.01, 0.5, 0.5, 1.0, 1.0)
    x[1::2, PLACE_COVARIATES.index("own_square")] = 0.9
    off, _ = planted.place(x, np.full(KINDS, 0.4, np.float32), offset_draw(KINDS))
    assert off[:, 0].tolist() == list(range(KINDS))
