"""Rules that every fusion keeps, and maps on which they are tried: for the conformance kit (`sortie verify fusion`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.detector import shipped
from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.fusion.own import OwnFusion
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.scenarios.plugins.reference import Params

Maps = tuple[Tensor, Tensor, Tensor]
"""The arguments of `Fusion.forward`: agents, takes_part and weight."""


def loaded(reference: str, params: Params) -> Fusion:
    """A fusion as it flies: a built-in one with its shipped weights, or one of one's own."""
    return load_weights(shipped(reference)).fusion if reference in FUSIONS else OwnFusion(reference, params).eval()


def cases() -> dict[str, Maps]:
    """Random maps, by what is special about them."""
    return {
        "one peer": _maps(1, 1, 0.3),
        "four peers, a tenth of the cells": _maps(1, 4, 0.1),
        "all cells of two peers": _maps(1, 2, 1.1),
        "nobody takes part": _maps(1, 2, -1.0),
        "two egos": _maps(2, 3, 0.5),
    }


def _maps(egos: int, peers: int, part: float) -> Maps:
    """Peers take part in a share of the cells, and are zero elsewhere."""
    rng = torch.Generator().manual_seed(peers)
    there = torch.rand(egos, 1 + peers, 64, 64, generator=rng) < part
    there[:, 0] = True
    agents = torch.rand(egos, 1 + peers, 80, 64, 64, generator=rng) * there[:, :, None]
    weight = 0.2 + 0.8 * torch.rand(egos, 1 + peers, generator=rng)
    weight[:, 0] = 1.0
    return agents, there, weight


def rules(ask: Callable[[Maps], Tensor], maps: Mapping[str, Maps]) -> dict[str, Callable[[], str | None]]:
    """By name: functions that return a complaint, or None where the rule is kept. `maps` are those of `cases`."""
    agents, there, weight = two = maps["two egos"]
    nobody = maps["nobody takes part"]

    def order() -> str | None:
        turn = [0, 3, 1, 2]
        turned = ask((agents[:, turn], there[:, turn], weight[:, turn]))
        return None if _alike(turned, ask(two)) else "the map depends on the order of the peers"

    def absent() -> str | None:
        with_one, part = (torch.cat([v, torch.zeros_like(v[:, :1])], dim=1) for v in (agents, there))
        more = ask((with_one, part, torch.cat([weight, weight[:, 1:2]], dim=1)))
        return None if _alike(more, ask(two)) else "a peer that takes part in no cell changes the map"

    def alone() -> str | None:
        return None if _alike(ask(nobody), nobody[0][:, 0]) else "another map than the ego's where no peer takes part"

    def apart() -> str | None:
        each = torch.cat([ask((agents[[k]], there[[k]], weight[[k]])) for k in range(len(agents))])
        return None if _alike(each, ask(two)) else "an ego's map depends on the other egos of the same call"

    return {"order of peers": order, "absent peers": absent, "ego alone": alone, "egos apart": apart}


def _alike(a: Tensor, b: Tensor) -> bool:
    return torch.allclose(a, b, rtol=1e-4, atol=1e-4)
