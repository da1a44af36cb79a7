"""One training step: batches of frames, targets for the head, losses and gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.benchmark.dataset import Frames
from sortie.perception.benchmark.scenes import DRONES
from sortie.perception.geometry import CELLS, FULL, HEAD_PX, Geometry, to_local
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.overlap import iou_pairs
from sortie.perception.network.decode import REFERENCE_SIZE_M
from sortie.perception.network.fusion.base import UnsentCells, takes_part
from sortie.perception.network.model import CarNet
from sortie.perception.network.warp import arriving, moved, support
from sortie.perception.training.recipe import Precision, Recipe
from sortie.scenarios.streams import stream

SHARDS = 2
SHARD_FRAMES = 2
"""A step is two shards of two frames; each shard has a thread, a replica of the network and a batch of its own."""
EGOS = 2


@dataclass(frozen=True, slots=True)
class Batch:
    """b frames × k agents: `images` uint8 [b, k, 4, 256, 256], `pose` (true) and `est` [b, k, 3], `cars` [b, m, 5]."""

    images: Tensor
    pose: NDArray[np.float64]
    est: NDArray[np.float64]
    cars: NDArray[np.float64]


def draw_batch(frames: Frames, seed: int, step: int, shard: int) -> Batch:
    """One shard of a step: random frames, two to five of their drones, mirrored or turned by quarters at random."""
    k = int(stream(seed, 0, step, "train.agents").choice([2, 3, 4, 5], p=[0.25, 0.25, 0.2, 0.3]))
    rng = stream(seed, 0, (step, shard), "train.batch")
    which = rng.choice(len(frames.images), SHARD_FRAMES)
    agents = np.stack([rng.permutation(DRONES)[:k] for _ in range(SHARD_FRAMES)])
    images = torch.from_numpy(frames.images[which[:, None], agents])
    pose, est = frames.true_pose[which[:, None], agents].copy(), frames.est_pose[which[:, None], agents].copy()
    cars = frames.cars[which].copy()
    if rng.random() < 0.5:  # the world in a mirror: north and south change places
        images = images.flip(-1)
        for table, yaw in ((pose, 2), (est, 2), (cars, 4)):
            table[..., 1] *= -1
            table[..., yaw] *= -1
    for _ in range(int(rng.integers(4))):  # a heading a quarter turn to the left sees old left as forward
        images = images.flip(-2).transpose(-1, -2)
        pose[..., 2] += np.pi / 2
        est[..., 2] += np.pi / 2
    rgb = images[:, :, :3].float()
    gain = torch.from_numpy(rng.uniform(0.85, 1.15, (SHARD_FRAMES, 1, 3, 1, 1)).astype(np.float32))
    images = torch.cat([(rgb * gain).clamp_(0, 255).to(torch.uint8), images[:, :, 3:]], dim=2)
    return Batch(images, pose, est, cars)


def local_cars(cars: NDArray[np.float64], pose: NDArray[np.float64], geometry: Geometry = FULL) -> NDArray[np.float64]:
    """The cars [n, 5] inside a drone's square, in its frame (x forward, y left)."""
    cars = ground_truth(cars, pose, geometry.half_extent_m).table()
    return np.stack([*to_local(cars[:, 0], cars[:, 1], pose), cars[:, 2], cars[:, 3], cars[:, 4] - pose[2]], axis=1)


def targets(
    cars: NDArray[np.float64], geometry: Geometry = FULL
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """The head's targets: heat [128, 128]; cells [p] (flat), values [p, 6] and weight [p] of the regressions.

    Heat is a Gaussian (σ 0.8 cells) about each car; offsets and sizes are learned on the 3 × 3 cells around it.
    """
    heat = np.zeros((HEAD_PX, HEAD_PX), np.float32)
    at = (cars[:, :2] + geometry.half_extent_m) / geometry.head_m - 0.5
    nearest = np.round(at).astype(np.int64)
    cells, values, weights = [], [], []
    for di in range(-2, 3):
        for dj in range(-2, 3):
            cell = nearest + np.array([di, dj])
            ok = ((cell >= 0) & (cell < HEAD_PX)).all(axis=1)
            offset = at - cell
            g = np.exp(-((offset if (di or dj) else 0.0 * offset) ** 2).sum(axis=1) / (2 * 0.8**2))
            np.maximum.at(heat, (cell[ok, 0], cell[ok, 1]), g[ok].astype(np.float32))
            if abs(di) <= 1 and abs(dj) <= 1:
                size = np.log(cars[:, 2:4] / REFERENCE_SIZE_M)
                turn = np.stack([np.sin(2 * cars[:, 4]), np.cos(2 * cars[:, 4])], axis=1)
                cells.append(cell[ok, 0] * HEAD_PX + cell[ok, 1])
                values.append(np.concatenate([offset, size, turn], axis=1)[ok])
                weights.append(g[ok])
    return (
        heat,
        np.concatenate(cells),
        np.concatenate(values).astype(np.float32),
        np.concatenate(weights).astype(np.float32),
    )


def loss_of(out: Tensor, labels: list[NDArray[np.float64]], geometry: Geometry = FULL) -> Tensor:
    """Centre-point focal loss plus weighted L1 regressions, per car. `out` [n, 7 or 8, 128, 128], `labels` n tables of cars.

    An eighth plane learns the IoU of the box that its cell tells with the car, by cross-entropy.
    """
    made = [targets(cars, geometry) for cars in labels]
    heat = torch.from_numpy(np.stack([m[0] for m in made])).to(out.device)
    logit = out[:, 0]
    p = logit.sigmoid().clamp(1e-4, 1 - 1e-4)
    centre = heat >= 0.999
    positive = -((1 - p) ** 2 * p.log())[centre].sum()
    negative = -(((1 - heat) ** 4) * p**2 * (1 - p).log())[~centre].sum()
    cars = max(sum(len(c) for c in labels), 1)
    sample = np.repeat(np.arange(len(made)), [len(m[1]) for m in made])
    cell = torch.from_numpy(np.concatenate([m[1] for m in made])).to(out.device)
    want = torch.from_numpy(np.concatenate([m[2] for m in made])).to(out.device)
    weight = torch.from_numpy(np.concatenate([m[3] for m in made])).to(out.device)
    said = out[:, 1:].flatten(2)[torch.from_numpy(sample).to(out.device), :, cell]
    if said.shape[1] > 6:
        fit = torch.from_numpy(_fit(said[:, :6].detach().float().cpu().numpy(), want.cpu().numpy(), geometry.head_m))
        uneven = F.binary_cross_entropy_with_logits(said[:, 6].float(), fit.to(out.device), weight, reduction="sum")
        said = said[:, :6]
        regression_of_fit = uneven / weight.sum().clamp_min(1.0)
    else:
        regression_of_fit = out.new_zeros(())
    place = 2.0 if out.shape[1] > 7 else 1.0  # a fine network is to place cars well
    scale = torch.tensor([place, place, 0.5, 0.5, 0.4, 0.4], device=out.device)
    regression = ((said - want).abs() * scale * weight[:, None]).sum() / weight.sum().clamp_min(1.0)
    return (positive + negative) / cars + regression + regression_of_fit


def _fit(said: NDArray[np.float32], want: NDArray[np.float32], head_m: float) -> NDArray[np.float32]:
    """IoU [p] of the boxes that regressions [p, 6] mean with those that they should mean."""

    def boxes(values: NDArray[np.float32]) -> NDArray[np.float64]:
        v = values.astype(np.float64)
        size = REFERENCE_SIZE_M * np.exp(np.clip(v[:, 2:4], -1, 1))
        return np.column_stack([v[:, :2] * head_m, size, 0.5 * np.arctan2(v[:, 4], v[:, 5])])

    return iou_pairs(boxes(said), boxes(want)).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Thinning:
    """Random cell dropout of one shard: which cells of which links arrive, and what the others count as."""

    rng: np.random.Generator
    probability: float
    unsent: UnsentCells

    @classmethod
    def of(cls, recipe: Recipe, step: int, shard: int) -> Thinning | None:
        """The recipe's, from a stream of its own, so that a run without dropout draws what it always drew."""
        if not recipe.cell_dropout:
            return None
        return cls(stream(recipe.seed, 0, (step, shard), "train.cells"), recipe.cell_dropout, recipe.unsent)

    def sent(self, links: int) -> Tensor:
        """[links, 1, 64, 64] bool. A thinned link keeps a fraction of its cells that is log-uniform from 1 % to all."""
        keep = np.where(self.rng.random(links) < self.probability, 0.01 ** self.rng.random(links), 1.0)
        cells = self.rng.random((links, 1, CELLS, CELLS), dtype=np.float32)
        return torch.from_numpy(cells < keep[:, None, None, None])


def gradients(
    net: CarNet,
    batch: Batch,
    rng: np.random.Generator,
    device: torch.device,
    thinning: Thinning | None = None,
    precision: Precision = "float32",
) -> tuple[float, list[Tensor]]:
    """Loss and gradients of one shard, in the thread that calls."""
    if device.type == "cpu":
        torch.set_num_threads(1)  # of this thread: shards side by side beat two threads in every operation
    with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16"):
        loss = step_loss(net, batch, rng, device, thinning)
    return loss.item(), list(torch.autograd.grad(loss, list(net.parameters())))


@torch.no_grad()
def apply(net: CarNet, replicas: list[CarNet], grads: list[list[Tensor]], optimiser: torch.optim.Optimizer) -> None:
    """One optimiser step on the mean gradient; then every replica is the network again, its running statistics the mean of theirs."""
    for parameter, *each in zip(net.parameters(), *grads, strict=True):
        parameter.grad = torch.stack(each).mean(dim=0)
    torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
    optimiser.step()
    for buffer, *own in zip(net.buffers(), *(r.buffers() for r in replicas), strict=True):
        buffer.copy_(torch.stack(own).mean(dim=0) if buffer.dtype.is_floating_point else own[0])
    for replica in replicas:
        replica.load_state_dict(net.state_dict())


def step_loss(
    net: CarNet, batch: Batch, rng: np.random.Generator, device: torch.device, thinning: Thinning | None = None
) -> Tensor:
    """The loss of one step: for each frame, `EGOS` drones that fuse all others and one that is alone."""
    b, k = batch.images.shape[:2]
    features = net.encoder(batch.images.flatten(0, 1).to(device))
    egos = np.stack([rng.permutation(k)[:EGOS] for _ in range(b)])
    first = np.arange(b)[:, None] * k
    ego = (first + egos).ravel().repeat(k - 1)  # one row per (frame, ego, peer)
    peers = np.array([[[i for i in range(k) if i != e] for e in row] for row in egos])
    agent = (first[:, :, None] + peers).ravel()
    est = torch.from_numpy(batch.est.reshape(-1, 3))
    delta = torch.stack([est[ego], est[agent]]).float()  # float64 poses are near the origin here
    links = len(agent)
    let = torch.ones(links, 1, CELLS, CELLS, dtype=torch.bool) if thinning is None else thinning.sent(links)
    geometry = net.config.geometry
    maps, n = net.spread(features).float(), net.config.fused_cells  # float where the step is bfloat16
    under = support(delta[0].to(device), delta[1].to(device), net.config.fused_cell_m, n)
    weights, sent = arriving(under, net.sent(let.flatten(1)).to(device))
    said = moved(maps[agent], under, weights)
    if net.align is not None:
        flat = said.permute(0, 2, 3, 1).flatten(1, 2)
        said = net.align(flat, under.offset.flatten(1, 2), under.turn).view(links, n, n, -1).permute(0, 3, 1, 2)
    agents = torch.cat([maps[ego[:: k - 1]][:, None], said.view(b * EGOS, k - 1, *said.shape[1:])], dim=1)
    weight = torch.ones(b * EGOS, k - 1, device=device)
    shape = (b * EGOS, k - 1, n, n)
    unsent = "masked" if thinning is None else thinning.unsent
    part = takes_part(sent.view(shape), under.inside.view(shape), weight, unsent)
    weight = net.fusion.weigh(agents[:, 0], maps[agent].view(b * EGOS, k - 1, *maps.shape[1:]), weight)
    fused = net.fusion(agents, part, F.pad(weight, (1, 0), value=1.0))
    alone = np.arange(b) * k + rng.integers(k, size=b)
    out = net.head(torch.cat([fused, maps[alone]])).float()
    pose = batch.pose.reshape(-1, 3)
    who = np.concatenate([ego[:: k - 1], alone])
    return loss_of(out, [local_cars(batch.cars[i // k], pose[i], geometry) for i in who], geometry)
