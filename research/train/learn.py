"""One training step: batches of frames, targets for the head, losses and gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from research.benchmark.dataset import Frames
from research.benchmark.scenes import DRONES
from research.train.recipe import Precision, Recipe
from sortie.perception.geometry import CELLS, FULL, HEAD_PX, Geometry, to_local
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.overlap import iou_pairs
from sortie.perception.network.decode import REFERENCE_SIZE_M
from sortie.perception.network.fusion.base import UnsentCells, takes_part
from sortie.perception.network.model import CarNet
from sortie.perception.network.warp import arriving, moved, support
from sortie.scenarios.streams import stream

SHARDS = 2
"""A step is two shards; each has a thread, a replica of the network and a batch of its own."""
EGOS = 2


@dataclass(frozen=True, slots=True)
class Labels:
    """What the head is to say of n outputs: `heat` [n, 128, 128], and in p cells, each of output `sample` [p] at `cell` [p]
    (flat), the regressions `values` [p, 6], which count with `weight` [p]; `cars` in all of them together."""

    heat: Tensor
    sample: Tensor
    cell: Tensor
    values: Tensor
    weight: Tensor
    cars: int

    def to(self, device: torch.device) -> Labels:
        """The same on a device."""
        heat, sample, cell = (part.to(device) for part in (self.heat, self.sample, self.cell))
        return Labels(heat, sample, cell, self.values.to(device), self.weight.to(device), self.cars)


@dataclass(frozen=True, slots=True)
class Batch:
    """b frames × k agents as they were drawn: `images` uint8 [b, k, 4, px, px] before they are mirrored and turned;
    `pose` (true) and `est` [b, k, 3] and the labels after it."""

    images: Tensor
    mirrored: bool
    quarter_turns: int
    gain: Tensor
    """[b, 1, 3, 1, 1], of the colours."""
    pose: NDArray[np.float64]
    est: NDArray[np.float64]
    cars: NDArray[np.float64]
    """[b, m, 5]."""
    egos: NDArray[np.int64]
    """[b, 2]: the agents that fuse all others."""
    alone: NDArray[np.int64]
    """[b]: those whose output is learned without peers."""
    labels: Labels
    """Of the egos, frame by frame, then of those alone."""

    def seen(self, device: torch.device) -> Tensor:
        """The images [b, k, 4, px, px] as they are learned from, on a device."""
        images = self.images.to(device)
        if self.mirrored:  # the world in a mirror: north and south change places
            images = images.flip(-1)
        for _ in range(self.quarter_turns):  # a heading a quarter turn to the left sees old left as forward
            images = images.flip(-2).transpose(-1, -2)
        rgb = images[:, :, :3].float()
        return torch.cat([(rgb * self.gain.to(device)).clamp_(0, 255).to(torch.uint8), images[:, :, 3:]], dim=2)


def draw_batch(frames: Frames, recipe: Recipe, step: int, shard: int, geometry: Geometry = FULL) -> Batch:
    """One shard of a step: random frames, two to five of their drones, mirrored or turned by quarters at random."""
    seed, count = recipe.seed, recipe.batch // SHARDS
    k = int(stream(seed, 0, step, "train.agents").choice([2, 3, 4, 5], p=[0.25, 0.25, 0.2, 0.3]))
    rng = stream(seed, 0, (step, shard), "train.batch")
    which = rng.choice(len(frames.images), count)
    agents = np.stack([rng.permutation(DRONES)[:k] for _ in range(count)])
    images = torch.from_numpy(frames.images)[torch.from_numpy(which[:, None]), torch.from_numpy(agents)]
    pose, est = frames.true_pose[which[:, None], agents].copy(), frames.est_pose[which[:, None], agents].copy()
    cars = frames.cars[which].copy()
    mirrored = bool(rng.random() < 0.5)
    if mirrored:
        for table, yaw in ((pose, 2), (est, 2), (cars, 4)):
            table[..., 1] *= -1
            table[..., yaw] *= -1
    turns = int(rng.integers(4))
    for _ in range(turns):
        pose[..., 2] += np.pi / 2
        est[..., 2] += np.pi / 2
    gain = torch.from_numpy(rng.uniform(0.85, 1.15, (count, 1, 3, 1, 1)).astype(np.float32))
    rng = stream(seed, 0, (step, shard), "train.egos")
    egos = np.stack([rng.permutation(k)[:EGOS] for _ in range(count)])
    alone = rng.integers(k, size=count)
    heard = [(i, e) for i, row in enumerate(egos.tolist()) for e in row] + list(enumerate(alone.tolist()))
    labels = targets([local_cars(cars[i], pose[i, e], geometry) for i, e in heard], geometry)
    return Batch(images, mirrored, turns, gain, pose, est, cars, egos, alone, labels)


def local_cars(cars: NDArray[np.float64], pose: NDArray[np.float64], geometry: Geometry = FULL) -> NDArray[np.float64]:
    """The cars [n, 5] inside a drone's square, in its frame (x forward, y left)."""
    cars = ground_truth(cars, pose, geometry.half_extent_m).table()
    return np.stack([*to_local(cars[:, 0], cars[:, 1], pose), cars[:, 2], cars[:, 3], cars[:, 4] - pose[2]], axis=1)


def targets(cars: Sequence[NDArray[np.float64]], geometry: Geometry = FULL) -> Labels:
    """What the head is to say of n outputs, from the cars [m, 5] of each in its drone's frame.

    Heat is a Gaussian (σ 0.8 cells) about each car; offsets and sizes are learned on the 3 × 3 cells around it.
    """
    heat = np.zeros((len(cars), HEAD_PX, HEAD_PX), np.float32)
    every, of = np.concatenate(cars), np.repeat(np.arange(len(cars)), [len(each) for each in cars])
    at = (every[:, :2] + geometry.half_extent_m) / geometry.head_m - 0.5
    nearest = np.round(at).astype(np.int64)
    size = np.log(every[:, 2:4] / REFERENCE_SIZE_M)
    turn = np.stack([np.sin(2 * every[:, 4]), np.cos(2 * every[:, 4])], axis=1)
    samples, cells, values, weights = [], [], [], []
    for di in range(-2, 3):
        for dj in range(-2, 3):
            cell = nearest + np.array([di, dj])
            ok = ((cell >= 0) & (cell < HEAD_PX)).all(axis=1)
            offset = at - cell
            g = np.exp(-((offset if (di or dj) else 0.0 * offset) ** 2).sum(axis=1) / (2 * 0.8**2))
            np.maximum.at(heat, (of[ok], cell[ok, 0], cell[ok, 1]), g[ok].astype(np.float32))
            if abs(di) <= 1 and abs(dj) <= 1:
                samples.append(of[ok])
                cells.append(cell[ok, 0] * HEAD_PX + cell[ok, 1])
                values.append(np.concatenate([offset, size, turn], axis=1)[ok])
                weights.append(g[ok])
    sample = np.concatenate(samples)
    order = np.argsort(sample, kind="stable")
    return Labels(
        torch.from_numpy(heat),
        torch.from_numpy(sample[order]),
        torch.from_numpy(np.concatenate(cells)[order]),
        torch.from_numpy(np.concatenate(values)[order].astype(np.float32)),
        torch.from_numpy(np.concatenate(weights)[order].astype(np.float32)),
        len(every),
    )


def loss_of(out: Tensor, labels: Labels, geometry: Geometry = FULL) -> Tensor:
    """Centre-point focal loss plus weighted L1 regressions, per car. `out` [n, 7 or 8, 128, 128].

    An eighth plane learns the IoU of the box that its cell tells with the car, by cross-entropy.
    """
    there = labels.to(out.device)
    logit, heat, want, weight = out[:, 0], there.heat, there.values, there.weight
    p = logit.sigmoid().clamp(1e-4, 1 - 1e-4)
    centre = heat >= 0.999
    positive = -((1 - p) ** 2 * p.log())[centre].sum()
    negative = -(((1 - heat) ** 4) * p**2 * (1 - p).log())[~centre].sum()
    said = out[:, 1:].flatten(2)[there.sample, :, there.cell]
    if said.shape[1] > 6:
        fit = torch.from_numpy(_fit(said[:, :6].detach().float().cpu().numpy(), labels.values.numpy(), geometry.head_m))
        uneven = F.binary_cross_entropy_with_logits(said[:, 6].float(), fit.to(out.device), weight, reduction="sum")
        said = said[:, :6]
        regression_of_fit = uneven / weight.sum().clamp_min(1.0)
    else:
        regression_of_fit = out.new_zeros(())
    place = 2.0 if out.shape[1] > 7 else 1.0  # a fine network is to place cars well
    scale = torch.tensor([place, place, 0.5, 0.5, 0.4, 0.4], device=out.device)
    regression = ((said - want).abs() * scale * weight[:, None]).sum() / weight.sum().clamp_min(1.0)
    return (positive + negative) / max(labels.cars, 1) + regression + regression_of_fit


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
    device: torch.device,
    thinning: Thinning | None = None,
    precision: Precision = "float32",
) -> tuple[float, list[Tensor]]:
    """Loss and gradients of one shard, in the thread that calls."""
    if device.type == "cpu":
        torch.set_num_threads(1)  # of this thread: shards side by side beat two threads in every operation
    with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16"):
        loss = step_loss(net, batch, device, thinning)
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


def step_loss(net: CarNet, batch: Batch, device: torch.device, thinning: Thinning | None = None) -> Tensor:
    """The loss of one shard: for each frame, `EGOS` drones that fuse all others and one that is alone."""
    b, k = batch.images.shape[:2]
    features = net.encoder(batch.seen(device).flatten(0, 1))
    first = np.arange(b)[:, None] * k
    ego = (first + batch.egos).ravel().repeat(k - 1)  # one row per (frame, ego, peer)
    peers = np.array([[[i for i in range(k) if i != e] for e in row] for row in batch.egos.tolist()])
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
    alone = maps[np.arange(b) * k + batch.alone]
    return loss_of(net.head(torch.cat([fused, alone])).float(), batch.labels, geometry)
