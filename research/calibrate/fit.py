"""Fit the surrogate's parameters to runs of the torch detector: small networks, a few minutes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import expit, logit, ndtr, ndtri
from torch import Tensor

from research.calibrate.rows import FitRows
from sortie.perception.errors import InputError
from sortie.perception.metrics.overlap import iou_pairs
from sortie.perception.surrogate.exchange import ALARM_COVARIATES
from sortie.perception.surrogate.features import axes, on_axes
from sortie.perception.surrogate.model import (
    BAND,
    KINDS,
    NETS,
    RATES,
    SPREAD,
    SQUARE,
    Net,
    Parameters,
    kind_of,
    rank_covariates,
    vague,
)
from sortie.scenarios.streams import stream

Array = NDArray[Any]
HIDDEN = {"look": (32, 32), "rank": (16,), "find": (32, 24), "place": (48, 32), "alarms": (24,)}
STEPS = {"look": 5000, "rank": 5000, "find": 10_000, "place": 10_000, "alarms": 5000}
"""Of every network. With fewer, AP moves by 0.01 from one seed of a fit to the next; where boxes lie decides it most."""
START = {"look": [0.0, 1.0, -1.0, 0.0, 0.0], "find": [0.0, 0.0, 1.0, -1.0, 0.0, 0.0]}
"""First outputs, so that a mixture's components part."""
CAR_M = (4.5, 1.9)
"""A car, about the towns' mean: decides which boxes would count."""
RESIDUALS, POOL, REACH = 2048, 512, 10.0
FEWEST = 20
"""Alarms of one band that are a pool of their own."""
GROUPS, FACTORS = 4, (0.7, 1.4)
"""Of bands of residuals, each made longer or shorter by a factor within these bounds."""
NONE_SHARED = (0.0, 1.0, 0.0, 0.0)
BANDS = np.array([0.0, 0.35, 0.6, 0.77, 0.88, 0.95, 0.98, 0.995])
"""Quantiles of the alarms' scores between which they are counted."""


def fit(
    rows: FitRows,
    boxes: Array,
    floor: float,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Parameters:
    """All parameters, without a card, and without what several drones have in common (`correlation`).

    Args:
        rows: of the fitted scenes, made with the same `floor`.
        boxes: as `Parameters.boxes`.
    """
    report = progress or (lambda _: None)
    nets: dict[str, Net] = {}
    report("look")
    nets["look"], out = _train("look", rows.look, {"c": rows.confidence}, _look_loss, seed)
    car, alone = rows.look_object[rows.fused_look], rows.job[rows.fused_job, ALARM_COVARIATES.index("sharing")] == 0
    alike = [_alike(rows, out, rows.fused_look[alone])]
    report("rank")
    covariates = rank_covariates(rows.look, rows.confidence, rows.look_cars)
    nets["rank"], _ = _train("rank", covariates, {"y": np.log(rows.above + 0.5 / 4096)}, _normal_loss, seed)
    report("find")
    found = rows.score > 0
    q = np.where(found, logit(np.clip(rows.score, 1e-6, 1 - 1e-6)), 0.0)
    at = torch.tensor(float(logit(floor)))
    loss = partial(_find_loss, floor=at)
    nets["find"], out = _train("find", rows.fused, {"hit": found, "q": q}, loss, seed)
    chance = expit(out[:, 0]) * (1.0 - _below(np.full(len(out), float(at)), out[:, 1:]))
    alike.append(_in_common(found[alone], chance[alone], car[alone]))
    report("place")
    covariates = np.concatenate([rows.fused, rows.score[:, None]], axis=1)[found]
    angle, hand = axes(rows.heading[found], rows.xy_m[found])
    off = np.concatenate([on_axes(rows.offset[found, :2], angle, hand), rows.offset[found, 2:]], axis=1)
    off[:, 2] *= hand
    shift = on_axes(rows.shift[found], angle, hand)
    nets["place"], out = _train("place", covariates, {"off": off, "shift": shift}, _place_loss, seed)
    followed = np.concatenate([shift * expit(out[:, 10:]), np.zeros((len(off), 3))], axis=1)
    centre, spread = followed + out[:, :5], np.exp(np.clip(out[:, 5:10], *SPREAD))
    residuals = (off - centre) / spread
    rng = stream(seed, 0, (), "calibrate.pool")
    kind, unsure = kind_of(covariates), vague(out)
    fits = _iou(off)
    pools = []
    for k in range(KINDS):
        wider = (kind == k, kind // 2 == k // 2, (kind >= 2) == (k >= 2), kind >= 0)
        of = next((of for of in wider if of.sum() >= BAND), wider[-1])  # too few to draw from: square or not, and so on
        pool = _bands(residuals[of], unsure[of], fits[of])
        good = fits[of] >= 0.5
        pools.append(_as_good(pool, centre[of], spread[of], unsure[of], good, rows.score[found][of], rng))
    only = alone[found]
    alike.append(_in_common(fits[only] >= 0.5, _chance(fits[only] >= 0.5, unsure[only]), car[found][only]))
    report("alarms")
    edges, counts, alarms = _alarms(rows, floor, rng)
    usable = np.isfinite(rows.job).all(axis=1)
    start = np.log(counts[usable].mean(axis=0) + 1e-3).tolist()
    nets["alarms"], _ = _train("alarms", rows.job[usable], {"count": counts[usable]}, _count_loss, seed, start=start)
    ends = np.stack([rows.job[usable].min(axis=0), rows.job[usable].max(axis=0)])
    singles = (np.array([*alike, 0.0]), np.stack(pools), edges, ends, alarms, NONE_SHARED, boxes)
    a, r, e, x, p, m, n = (np.asarray(v, np.float32) for v in singles)
    return Parameters(nets, a, r, e, x, p, m, n, card={})


def _bands(residuals: Array, unsure: Array, fits: Array) -> Array:
    """Evenly many of the residuals, [2048, 6], as `Parameters.residuals`."""
    order = np.argsort(unsure, kind="stable")
    pick = order[np.linspace(0, len(order) - 1, RESIDUALS).astype(int)].reshape(-1, BAND)
    pick = np.take_along_axis(pick, np.argsort(fits[pick], axis=1, kind="stable"), axis=1)
    start = np.repeat(unsure[pick].min(axis=1), BAND)
    return np.concatenate([np.clip(residuals[pick.ravel()], -REACH, REACH), start[:, None]], axis=1)


def _as_good(
    pool: Array, centre: Array, spread: Array, unsure: Array, good: Array, score: Array, rng: np.random.Generator
) -> Array:
    """The residuals, longer or shorter by a factor a group of bands, so that of the boxes that were predicted as vaguely as
    many count, by score, as did. Networks that are fitted twice place by a percent better or worse; AP would follow."""
    band = np.maximum(np.searchsorted(pool[::BAND, 5], unsure, side="right") - 1, 0)
    group = band * GROUPS // (len(pool) // BAND)
    draw = (rng.random(len(band)) * BAND).astype(np.intp)
    out = pool.copy()
    for g in range(GROUPS):
        mine = np.flatnonzero(group == g)
        if not len(mine):
            continue
        drawn, weight = spread[mine] * pool[band[mine] * BAND + draw[mine], :5], score[mine] / score[mine].sum()
        wanted = weight @ good[mine]
        low, high = FACTORS
        for _ in range(12):
            factor = (low + high) / 2
            more = weight @ (_iou(centre[mine] + factor * drawn) >= 0.5) > wanted
            low, high = (factor, high) if more else (low, factor)
        here = np.arange(len(pool)) // BAND * GROUPS // (len(pool) // BAND) == g
        out[here, :5] *= (low + high) / 2
    return out


def _train(
    name: str,
    x: Array,
    y: dict[str, Array],
    loss: Callable[[Tensor, dict[str, Tensor]], Tensor],
    seed: int,
    steps: int | None = None,
    batch: int = 2048,
    start: Sequence[float] | None = None,
) -> tuple[Net, Array]:
    """A network fitted by Adam with a falling rate, and its outputs for all rows."""
    inputs, outputs = NETS[name]
    steps = steps or STEPS[name]
    torch.manual_seed(seed)
    sizes = (inputs, *HIDDEN[name], outputs)
    mean, deviation = x.mean(axis=0), x.std(axis=0) + 1e-3
    data = torch.from_numpy(((x - mean) / deviation).astype(np.float32))
    want = {k: torch.from_numpy(v.astype(np.float32)) for k, v in y.items()}
    layers: list[torch.nn.Module] = []
    for a, b in itertools.pairwise(sizes):
        layers += [torch.nn.Linear(a, b), torch.nn.ReLU()]
    net = torch.nn.Sequential(*layers[:-1])
    linear = [layer for layer in net if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        linear[-1].weight.mul_(0.1)
        linear[-1].bias.copy_(torch.tensor(start or START.get(name, [0.0] * outputs)))
    optimiser = torch.optim.AdamW(net.parameters(), 4e-3, weight_decay=0.03)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=steps)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        pick = torch.randint(len(data), (min(batch, len(data)),), generator=generator)
        value = loss(net(data[pick]), {k: v[pick] for k, v in want.items()})
        optimiser.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    weights, biases = [], []
    for layer in linear:
        weights.append(layer.weight.detach().numpy().T.astype(np.float64))
        biases.append(layer.bias.detach().numpy().astype(np.float64))
    biases[0] = biases[0] - (mean / deviation) @ weights[0]
    weights[0] = weights[0] / deviation[:, None]
    made = Net(tuple(w.astype(np.float32) for w in weights), tuple(b.astype(np.float32) for b in biases))
    with torch.no_grad():
        return made, net(data).numpy().astype(np.float64)


def _normal(x: Tensor, mean: Tensor, log_spread: Tensor) -> Tensor:
    log_spread = log_spread.clamp(*SPREAD)
    return -0.5 * ((x - mean) * torch.exp(-log_spread)) ** 2 - log_spread


def _look_loss(out: Tensor, y: dict[str, Tensor]) -> Tensor:
    return -_of_two(y["c"], out).mean()


def _of_two(x: Tensor, out: Tensor) -> Tensor:
    """Log density of a mixture of two normals, `out` [n, 5] as the model draws from it."""
    low = torch.nn.functional.logsigmoid(-out[:, 0]) + _normal(x, out[:, 2], out[:, 4])
    high = torch.nn.functional.logsigmoid(out[:, 0]) + _normal(x, out[:, 1], out[:, 3])
    return torch.logaddexp(low, high)


def _below(x: Array, out: Array) -> Array:
    """What part of such a mixture lies below x [n]."""
    p = expit(out[:, 0])
    low = ndtr((x - out[:, 2]) / np.exp(np.clip(out[:, 4], *SPREAD)))
    high = ndtr((x - out[:, 1]) / np.exp(np.clip(out[:, 3], *SPREAD)))
    return np.asarray(p * high + (1 - p) * low)


def _normal_loss(out: Tensor, y: dict[str, Tensor]) -> Tensor:
    return -_normal(y["y"], out[:, 0], out[:, 1]).mean()


def _find_loss(out: Tensor, y: dict[str, Tensor], floor: Tensor) -> Tensor:
    score, log = out[:, 1:], torch.nn.functional.logsigmoid
    upper, lower = (
        torch.special.log_ndtr((score[:, k] - floor) * torch.exp(-score[:, k + 2].clamp(*SPREAD))) for k in (1, 2)
    )
    above = torch.logaddexp(log(score[:, 0]) + upper, log(-score[:, 0]) + lower)
    p = log(out[:, 0])
    missed = torch.log1p(-torch.exp((p + above).clamp(max=-1e-6)))
    seen = p + _of_two(y["q"], score)
    return -torch.where(y["hit"] > 0, seen, missed).mean()


def _count_loss(out: Tensor, y: dict[str, Tensor]) -> Tensor:
    rate = out.clamp(*RATES)
    return (torch.exp(rate) - y["count"] * rate).sum(dim=1).mean()  # Poisson


def _place_loss(out: Tensor, y: dict[str, Tensor]) -> Tensor:
    follow = torch.sigmoid(out[:, 10:])
    shift = torch.nn.functional.pad(y["shift"] * follow, (0, 3))
    log_spread = out[:, 5:10].clamp(*SPREAD)
    return (
        (((y["off"] - shift - out[:, :5]).abs() * torch.exp(-log_spread)) + log_spread).sum(dim=1).mean()
    )  # Laplace: outliers count once


def _alike(rows: FitRows, out: Array, looks: Array) -> float:
    """The share of a look's random draw that is the car's own: correlation, over pairs of such `looks` at one car, of where in its
    predicted distribution each fell."""
    z = ndtri(np.clip(_below(rows.confidence[looks], out[looks]), 1e-4, 1 - 1e-4))
    a, b = _pairs(rows.look_object[looks])
    return float(np.clip((z[a] * z[b]).mean() / max(z.var(), 1e-6), 0.0, 0.95))


def _in_common(happened: Array, chance: Array, car: Array) -> float:
    """The share of the random draw of events that is the car's own: the covariance over pairs at one car, over what it would be if all
    of it were, where the less likely of two happens only with the other."""
    a, b = _pairs(car)
    off = happened - chance
    most = np.minimum(chance[a], chance[b]) - chance[a] * chance[b]
    return float(np.clip((off[a] * off[b]).sum() / max(most.sum(), 1e-6), 0.0, 0.95))


def _iou(off: Array) -> Array:
    """IoU with their car of boxes [n] that lie so far off."""
    box = np.concatenate([off[:, :2], np.exp(off[:, 3:5]) * CAR_M, off[:, 2:3]], axis=1)
    return iou_pairs(box, np.tile((0.0, 0.0, *CAR_M, 0.0), (len(box), 1)))


def _chance(good: Array, unsure: Array) -> Array:
    """What part of the boxes that were predicted as vaguely is good."""
    order = np.argsort(unsure, kind="stable")
    chance = np.empty(len(good))
    chance[order] = uniform_filter1d(good[order].astype(float), max(1, len(good) // 16))
    return chance


def _pairs(group: Array) -> tuple[Array, Array]:
    """Every two rows of one group."""
    order = np.argsort(group, kind="stable")
    which = group[order]
    some = [np.flatnonzero(which[lag:] == which[:-lag]) for lag in range(1, int(np.bincount(group).max(initial=1)))]
    first = np.concatenate([np.zeros(0, np.intp), *some])
    lag = np.repeat(np.arange(1, len(some) + 1), [len(s) for s in some])
    return order[first], order[first + lag]


def _alarms(rows: FitRows, floor: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Bands of scores, how many of each job's alarms lie in each, and alarms to draw from."""
    score = rows.alarm[:, 5]
    if len(score) < 50:
        raise InputError(f"{len(score)} false alarms above {floor:g}, at least 50 are needed; calibrate on more scenes")
    edges = np.append(np.quantile(score, BANDS), 1.0)
    edges[0] = floor
    edges = np.maximum.accumulate(edges + 1e-6 * np.arange(len(edges)))
    band = np.clip(np.searchsorted(edges, score, side="right") - 1, 0, len(BANDS) - 1)
    counts = np.zeros((len(rows.job), len(BANDS)))
    np.add.at(counts, (rows.alarm_job, band), 1.0)
    along = rows.job[rows.alarm_job, ALARM_COVARIATES.index("square")] > SQUARE
    pools = []
    for of in (~along, along):
        mine = [np.flatnonzero((band == b) & of) for b in range(len(BANDS))]
        mine = [m if len(m) >= FEWEST else np.flatnonzero(band == b) for b, m in enumerate(mine)]
        pools.append(np.stack([rows.alarm[rng.choice(m, POOL)] for m in mine]))
    return edges, counts, np.stack(pools)
