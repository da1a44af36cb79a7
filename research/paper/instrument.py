"""Our network for the evaluation: it encodes a fleet-frame once, then detects for every exchange in batches."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from research.flip.fusion import DosedDiscoNet
from research.flip.networks import load
from research.paper.ways import CellsBy
from research.train.devices import gpu_name
from sortie.perception.errors import InputError
from sortie.perception.evaluation.harness import FleetFrames
from sortie.perception.evaluation.sharing import Exchange, Floats
from sortie.perception.geometry import Geometry
from sortie.perception.network.decode import decode
from sortie.perception.network.fusion.base import Fusion, PerCell
from sortie.perception.network.fusion.disconet import DiscoNet
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet
from sortie.perception.network.warp import Support, arriving, rows, support

CPU = torch.device("cpu")
BATCH = 5
"""Egos fused at once; on a CPU larger batches leave the cache and gain nothing."""


class CarNetInstrument:
    """A network on frames that carry `images` uint8 [n, d, 4, px, px]."""

    def __init__(self, net: CarNet, device: torch.device = CPU, fusion_params: Mapping[str, Any] | None = None) -> None:
        """
        Args:
            device: where it computes; a GPU is part of the fingerprint, because it rounds in its own way.
            fusion_params: the dose of the network's fusion (`DosedDiscoNet`); left out, it fuses as it was trained.
        """
        params: Mapping[str, Any] = fusion_params or {}
        self.fingerprint = fingerprint(net) + "".join(f" {k}={v!r}" for k, v in sorted(params.items()))
        if gpu := gpu_name(device):
            self.fingerprint += f" on {gpu}"
        self.geometry: Geometry = net.config.geometry
        self.fused_cells = net.config.fused_cells
        """Cells along a side of the maps that are fused."""
        self._device = device
        self._net = folded(net)
        if params:
            self._net.fusion = DosedDiscoNet(self._net.fusion, **params)
        self._net.to(device)

    @classmethod
    def load(
        cls, weights: Path, device: torch.device = CPU, fusion_params: Mapping[str, Any] | None = None
    ) -> CarNetInstrument:
        """From a weights file; InputError where it is missing or does not fit."""
        return cls(load(weights), device, fusion_params)

    def start_worker(self) -> None:
        """For a thread of `evaluate`: frames side by side, each in one thread, beat two threads in every operation."""
        if self._device.type == "cpu":
            torch.set_num_threads(1)

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
    """The features of one fleet-frame, and what the network finds from them.

    A fusion that works cell by cell (`PerCell`) computes only the cells where something arrived. The other cells are the
    ego's own or, where silent peers count as zeros, the ego fused with that many zeros, computed once per view.
    """

    @torch.inference_mode()
    def __init__(
        self, net: CarNet, features: torch.Tensor, est: torch.Tensor, read: torch.Tensor | None = None
    ) -> None:
        """Args: `read` are the features as peers read them, where they are sent otherwise than as they are."""
        self.net, self._est = net, est
        self.features = features
        """[d, 80, 64, 64]: every drone's, on its own grid."""
        self._maps: torch.Tensor = net.spread(features)
        self._n = net.config.fused_cells
        self._table = self._maps.permute(0, 2, 3, 1).reshape(-1, self._maps.shape[1])
        self._theirs = self._table
        if read is not None:
            self._theirs = net.spread(read).permute(0, 2, 3, 1).reshape(self._table.shape)
        self._under: dict[int, Support] = {}
        self._silent: dict[tuple[int, tuple[int, ...]], torch.Tensor] = {}

    @torch.inference_mode()
    def rank(self, by: CellsBy = "confidence") -> NDArray[np.floating]:
        """Confidence: the highest score of the cell's head pixels, each drone alone; norm: of its feature vector."""
        heat = None if by == "norm" else self.net.head(self._maps)[:, :1]
        plane = self.features.norm(dim=1) if heat is None else F.max_pool2d(heat, 2)[:, 0]
        out: NDArray[np.floating] = plane.cpu().numpy()
        return out

    @torch.inference_mode()
    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        """Each ego's boxes before suppression (see `contract.FrameView`)."""
        out: list[Floats] = []
        for at in range(0, len(exchanges), BATCH):
            out += self.boxes(torch.stack([self._fuse(e) for e in exchanges[at : at + BATCH]]), floor)
        return out

    def boxes(self, fused: torch.Tensor, floor: float) -> list[Floats]:
        """What the head finds in fused maps [n, cells, channels]; as `detect`."""
        maps = fused.view(-1, self._n, self._n, fused.shape[-1]).permute(0, 3, 1, 2)
        return [decode(one, floor, self.net.config.geometry).double().numpy() for one in self.net.head(maps).cpu()]

    @torch.inference_mode()
    def weight_on_zeros(self, ego: int, cells: NDArray[np.int64], fusion: Fusion | None = None) -> Floats:
        """What all other drones together draw of DiscoNet's softmax weight in these cells [p] of an ego's grid of fused
        cells (row by row), where they sent nothing and count as zeros; [p].

        Args: `fusion` in place of the network's, such as a tuned copy.

        Raises:
            InputError: the network's fusion is not DiscoNet.
        """
        fusion = fusion or self.net.fusion
        if not isinstance(fusion, DiscoNet):
            raise InputError(f"fusion is {fusion.name}, must be disconet")
        peers = tuple(i for i in range(len(self.features)) if i != ego)
        own = self.own(ego)[torch.from_numpy(cells).to(self._table.device)]
        inside = self.support(ego, peers).inside.flatten(1)[:, cells]
        part = torch.cat([torch.ones_like(inside[:1]), inside])
        said = torch.cat([own[None], own.new_zeros(len(peers), *own.shape)])
        share = fusion.weights(said, part, own.new_ones(1, 1).expand(part.shape))
        out: Floats = share[1:].sum(dim=0).double().cpu().numpy()
        return out

    def _fuse(self, e: Exchange) -> torch.Tensor:
        """[cells, channels]: what one ego makes of its own features and what it was sent."""
        own = self.own(e.ego)
        if not e.peers:
            return own
        sent = self.net.sent(torch.from_numpy(e.sent.reshape(len(e.peers), -1))).to(own.device)
        under = self.support(e.ego, e.peers)
        weights, arrived = arriving(under, sent)
        inside, arrived = under.inside.flatten(1), arrived.flatten(1)
        trust = self._trust(e)
        if not isinstance(self.net.fusion, PerCell):
            return self._dense(e, own, under, weights, arrived if e.unsent == "masked" else inside, trust)
        at = arrived.any(dim=0).nonzero().squeeze(1)
        base = own if e.unsent == "masked" else self._zeros(e, own, inside, len(at), trust)
        if not len(at):
            return base
        said = torch.cat([own[at][None], self.gather(e, under, weights, at)])
        part = (arrived if e.unsent == "masked" else inside)[:, at]
        return base.index_copy(0, at, self._mix(said, part, trust))

    def own(self, ego: int) -> torch.Tensor:
        """[cells, channels]: an ego's own features, row by row."""
        own: torch.Tensor = self._table[ego * self._n**2 : (ego + 1) * self._n**2]
        return own

    def support(self, ego: int, peers: tuple[int, ...]) -> Support:
        """Of these peers under the ego; all of a view's are worked out once."""
        if ego not in self._under:
            self._under[ego] = support(self._est[ego], self._est, self.net.config.fused_cell_m, self._n)
        every = self._under[ego]
        return Support(*(part[list(peers)] for part in every))

    def _trust(self, e: Exchange) -> torch.Tensor:
        """[1 + peers]: the links' weights, 1 but for what the method's handshake makes of them."""
        own, peers = self.features[e.ego], self.features[list(e.peers)]
        weight = self.net.fusion.weigh(own[None], peers[None], own.new_ones(1, len(e.peers)))[0]
        return F.pad(weight, (1, 0), value=1.0)

    def gather(self, e: Exchange, under: Support, weights: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
        """[peers, p, channels]: what arrived at these cells of the ego's grid."""
        k = len(e.peers)
        first = torch.tensor(e.peers, device=at.device)[:, None, None] * self._n**2
        taps = under.cells.view(k, -1, 4)[:, at] + first
        moved = rows(self._theirs, taps.view(-1, 4), weights.view(k, -1, 4)[:, at].view(-1, 4))
        said: torch.Tensor = self.net.aligned(
            moved.view(k, len(at), -1), under.offset.view(k, -1, 2)[:, at], under.turn
        )
        return said

    def _mix(self, said: torch.Tensor, part: torch.Tensor, trust: torch.Tensor) -> torch.Tensor:
        """Fuse [1 + k, p, channels] cell by cell by the links' weights [1 + k]; the ego takes part everywhere."""
        fusion = self.net.fusion
        assert isinstance(fusion, PerCell)
        part = torch.cat([torch.ones_like(part[:1]), part])
        mixed: torch.Tensor = fusion.mix(said, part, trust[:, None].expand(part.shape))
        return torch.where(part[1:].any(dim=0)[:, None], mixed, said[0])

    def _zeros(
        self, e: Exchange, own: torch.Tensor, inside: torch.Tensor, arrived: int, trust: torch.Tensor
    ) -> torch.Tensor:
        """The ego beside silent peers that count as zeros."""
        if arrived == len(own):
            return own  # every cell is about to be replaced
        key = (e.ego, e.peers)
        if key not in self._silent:
            said = torch.cat([own[None], own.new_zeros(len(e.peers), *own.shape)])
            self._silent[key] = self._mix(said, inside, trust)
        return self._silent[key]

    def _dense(
        self,
        e: Exchange,
        own: torch.Tensor,
        under: Support,
        weights: torch.Tensor,
        part: torch.Tensor,
        trust: torch.Tensor,
    ) -> torch.Tensor:
        """The whole map, for a fusion that looks beyond its cell."""
        every = torch.arange(len(own), device=own.device)
        said = torch.cat([own[None], self.gather(e, under, weights, every)])
        part = torch.cat([torch.ones_like(part[:1]), part]).view(1, -1, self._n, self._n)
        agents = said.view(1, -1, self._n, self._n, own.shape[1]).permute(0, 1, 4, 2, 3)
        fused: torch.Tensor = self.net.fusion(agents, part, trust[None])
        return fused[0].permute(1, 2, 0).reshape(own.shape)
