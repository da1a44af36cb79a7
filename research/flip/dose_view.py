"""One fleet-frame under many doses. What no dose changes is computed once: features, warped cells, the edge network's logits.

The boxes are those of `CarNetView.detect` under a network that was tuned to the dose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from research.flip.fusion import DosedDiscoNet, silent_in
from research.paper.instrument import BATCH, CarNetView
from sortie.perception.evaluation.sharing import Exchange, Floats, Unsent
from sortie.perception.network.fusion.base import weighted_sum
from sortie.perception.network.warp import arriving


class Tuning(NamedTuple):
    """A dose as the fusion sees it."""

    temperature: float
    silent_weight: float
    unsent: Unsent


class Prepared(NamedTuple):
    """What one ego fuses in the cells where anything arrived, before any dose."""

    ego: int
    peers: tuple[int, ...]
    inside: torch.Tensor
    """[k, cells] bool: each peer's grid covers the cell."""
    at: torch.Tensor
    """[p] cells of the ego's grid where anything arrived."""
    arrived: torch.Tensor
    """[k, p] bool: from whom."""
    said: torch.Tensor
    """[1 + k, p, channels], the ego first."""
    logit: torch.Tensor
    """[1 + k, p]"""
    silent: torch.Tensor
    """[1 + k, p] bool"""


class DoseView:
    """A `CarNetView` of a network with DiscoNet's fusion, under several tunings of it."""

    def __init__(self, view: CarNetView, tunings: Sequence[Tuning]) -> None:
        self.view = view
        self.fusions = {
            t: DosedDiscoNet(view.net.fusion, temperature=t.temperature, silent_weight=t.silent_weight) for t in tunings
        }
        self._alone: dict[int, torch.Tensor] = {}
        self._shares: dict[tuple[int, tuple[int, ...], Tuning], torch.Tensor] = {}

    @torch.inference_mode()
    def detect(
        self, exchanges: Sequence[Exchange], tunings: Sequence[Tuning], floor: float
    ) -> dict[Tuning, list[Floats]]:
        """Each ego's boxes under each tuning, as `CarNetView.detect`; each has peers, and what an unsent cell counts as is the tuning's."""
        out: dict[Tuning, list[Floats]] = {t: [] for t in tunings}
        for begin in range(0, len(exchanges), BATCH):
            prepared = [self._prepare(e) for e in exchanges[begin : begin + BATCH]]
            for t in tunings:
                out[t] += self.view.boxes(torch.stack([self._fuse(p, t) for p in prepared]), floor)
        return out

    def weight_on_zeros(self, tuning: Tuning, cells: Sequence[NDArray[np.int64]]) -> list[float]:
        """`CarNetView.weight_on_zeros` in these cells of each ego, one ego after the other; zeros where they are masked."""
        if tuning.unsent == "masked":
            return [0.0] * sum(map(len, cells))
        fusion = self.fusions[tuning]
        each = [self.view.weight_on_zeros(ego, these, fusion) for ego, these in enumerate(cells)]
        out: list[float] = np.concatenate(each).tolist()
        return out

    def _prepare(self, e: Exchange) -> Prepared:
        view = self.view
        own, under = view.own(e.ego), view.support(e.ego, e.peers)
        sent = view.net.sent(torch.from_numpy(e.sent.reshape(len(e.peers), -1))).to(own.device)
        weights, arrived = arriving(under, sent)
        arrived = arrived.flatten(1)
        at = arrived.any(dim=0).nonzero().squeeze(1)
        theirs = view.gather(e, under, weights, at) if len(at) else own.new_empty(len(e.peers), 0, own.shape[1])
        said = torch.cat([own[at][None], theirs])
        logit = self._disconet.edge(said) if len(at) else said[..., 0]
        return Prepared(e.ego, e.peers, under.inside.flatten(1), at, arrived[:, at], said, logit, silent_in(said))

    @property
    def _disconet(self) -> DosedDiscoNet:
        return next(iter(self.fusions.values()))

    def _fuse(self, p: Prepared, t: Tuning) -> torch.Tensor:
        """[cells, channels]"""
        own, masked = self.view.own(p.ego), t.unsent == "masked"
        base = own if masked or not p.peers else own * self._silent_shares(p, t)[0, :, None]
        if not len(p.at):
            return base
        mixed = weighted_sum(
            _shares(self.fusions[t], p.logit, p.silent, p.arrived if masked else p.inside[:, p.at]), p.said
        )
        return base.index_copy(0, p.at, mixed)

    def _silent_shares(self, p: Prepared, t: Tuning) -> torch.Tensor:
        """[1 + k, cells]: the softmax weights of an ego beside peers that sent nothing and count as zeros."""
        key = (p.ego, p.peers, t)
        if key not in self._shares:
            if p.ego not in self._alone:  # every silent peer has the same logit
                own = self.view.own(p.ego)
                self._alone[p.ego] = self._disconet.edge(torch.stack([own, torch.zeros_like(own)]))
            own_, zero = self._alone[p.ego]
            logit = torch.stack([own_, *[zero] * len(p.peers)])
            silent = torch.ones_like(logit, dtype=torch.bool)
            silent[0] = False
            self._shares[key] = _shares(self.fusions[t], logit, silent, p.inside)
        return self._shares[key]


def _shares(fusion: DosedDiscoNet, logit: torch.Tensor, silent: torch.Tensor, peers: torch.Tensor) -> torch.Tensor:
    part = torch.cat([torch.ones_like(peers[:1]), peers])
    return fusion.dosed(logit, silent, part, logit.new_ones(1, 1).expand(part.shape))
