"""Our network as the harness's instrument: features of a fleet-frame once, then every exchange of it in batches."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from perception.checkpoint import load_weights
from perception.decode import decode
from perception.fusion.base import takes_part
from perception.geometry import Geometry
from perception.harness.condition import CellsBy
from perception.harness.contract import Exchange, FleetFrames, Floats
from perception.model import CarNet, folded
from perception.warp import warp

CPU = torch.device("cpu")
BATCH = 5
"""Egos fused at once; on a CPU larger batches leave the cache and gain nothing."""


class CarNetInstrument:
    """A network on frames that carry `images` uint8 [n, d, 4, 256, 256]."""

    def __init__(self, net: CarNet, device: torch.device = CPU) -> None:
        self.fingerprint = fingerprint(net)
        self.geometry: Geometry = net.config.geometry
        self._device = device
        self._net = folded(net).to(device)

    @classmethod
    def load(cls, weights: Path, device: torch.device = CPU) -> CarNetInstrument:
        """From a weights file; ValueError where it is missing or does not fit."""
        return cls(load_weights(weights), device)

    @torch.inference_mode()
    def look(self, frames: FleetFrames, frame: int) -> CarNetView:
        images = torch.from_numpy(np.ascontiguousarray(frames.images[frame]))  # type: ignore[attr-defined]
        est = frames.est_pose[frame] - np.array([*frames.est_pose[frame].mean(axis=0)[:2], 0.0])
        return CarNetView(
            self._net, self._net.encoder(images.to(self._device)), torch.from_numpy(est).float().to(self._device)
        )


def fingerprint(net: CarNet) -> str:
    """A hash of the network's configuration and every weight."""
    digest = hashlib.blake2b(repr(net.config).encode(), digest_size=16)
    for name, tensor in sorted(net.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


class CarNetView:
    """The features of one fleet-frame, and what the network finds from them."""

    def __init__(self, net: CarNet, features: torch.Tensor, est: torch.Tensor) -> None:
        self._net, self._features, self._est = net, features, est

    @torch.inference_mode()
    def rank(self, by: CellsBy) -> NDArray[np.floating]:
        """Confidence: the highest score of the cell's head pixels, each drone alone; norm: of its feature vector."""
        if by == "norm":
            plane = self._features.norm(dim=1)
        else:
            plane = F.max_pool2d(self._net.head(self._features)[:, :1], 2)[:, 0]
        out: NDArray[np.floating] = plane.cpu().numpy()
        return out

    @torch.inference_mode()
    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        out: list[Floats] = [np.zeros((0, 6))] * len(exchanges)
        alike: dict[tuple[int, str], list[int]] = {}
        for i, e in enumerate(exchanges):
            alike.setdefault((len(e.peers), e.unsent), []).append(i)
        for which in alike.values():
            for at in range(0, len(which), BATCH):
                part = which[at : at + BATCH]
                fused = self._fuse([exchanges[i] for i in part])
                for i, one in zip(part, self._net.head(fused).cpu(), strict=True):
                    out[i] = decode(one, floor, self._net.config.geometry).double().numpy()
        return out

    def _fuse(self, batch: Sequence[Exchange]) -> torch.Tensor:
        """[n, 80, 64, 64]; the exchanges have equally many peers and treat unsent cells alike."""
        n, k = len(batch), len(batch[0].peers)
        egos = [e.ego for e in batch]
        own = self._features[egos]
        if k == 0:
            return own
        peers = [p for e in batch for p in e.peers]
        sent = torch.from_numpy(np.concatenate([e.sent for e in batch]))[:, None].to(own.device)
        here = self._est[egos].repeat_interleave(k, dim=0)
        moved, arrived, inside = warp(
            self._features[peers], sent, here, self._est[peers], self._net.config.geometry.cell_m
        )
        ones = torch.ones(n, k, device=own.device)
        shape = (n, k, *own.shape[2:])
        part = takes_part(arrived.view(shape), inside.view(shape), ones, batch[0].unsent)
        agents = torch.cat([own[:, None], moved.view(n, k, *own.shape[1:])], dim=1)
        fused: torch.Tensor = self._net.fusion(agents, part, F.pad(ones, (1, 0), value=1.0))
        return fused
