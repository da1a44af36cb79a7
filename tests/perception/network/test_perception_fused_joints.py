"""Peers fused for an ego that has no look of its own, and whom a drone asks for a map; by hand, with the maximum as the fusion."""

from __future__ import annotations

from concurrent.futures import Future
from types import SimpleNamespace

import pytest

pytest.importorskip("torch")
import torch
from perception_examples import cross

from sortie.perception.network.detector import TorchDetector, _part
from sortie.perception.network.fused import Peer, fused_map
from sortie.perception.network.fusion.when2com import asked
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception

POSE = (300.0, -40.0, 0.0)
ALL, NONE = torch.ones(64, 64, dtype=torch.bool), torch.zeros(64, 64, dtype=torch.bool)


def peer(weight: float, value: float, sent: torch.Tensor = ALL) -> Peer:
    """At the ego's own pose, saying the same in every cell."""
    return Peer(POSE, weight, torch.full((80, 64, 64), value), sent)


@pytest.mark.parametrize("turn", [1, -1])
def test_without_a_look_the_peer_that_counts_most_leads_and_the_others_follow(turn: int) -> None:
    """Weights are relative to the largest: a peer of half of it takes the map half of the way up."""
    with torch.inference_mode():
        net = CarNet(ModelConfig(fusion="fcooper")).eval()
        half = torch.zeros(64, 64, dtype=torch.bool)
        half[:32] = True
        peers = [peer(0.5, 1.0, half), peer(0.25, 3.0)][::turn]
        masked = fused_map(net, POSE, None, peers, "masked")
        zero = fused_map(net, POSE, None, peers, "zero")
        nobody = fused_map(net, POSE, None, [peer(0.5, 1.0, NONE)], "masked")
    assert nobody is None
    for found in (masked, zero):
        assert found is not None
        assert found[0, :, :32].unique().tolist() == pytest.approx([1.0 + 0.5 * (3.0 - 1.0)])
        # who sent nothing of a cell does not lead there, however much it counts
        assert found[0, :, 32:].unique().tolist() == pytest.approx([3.0])


def test_a_handshake_goes_by_the_whole_map_of_a_peer_that_sent_codes_of_some_cells() -> None:
    """Codes that lose nothing are fused as the cells themselves are."""
    net = CarNet(ModelConfig(fusion="when2com")).eval()
    own, whole = torch.rand(2, 80, 64, 64, generator=torch.Generator().manual_seed(4))
    some = torch.zeros(64, 64, dtype=torch.bool)
    some[:8] = True

    class Codes(TorchDetector):
        def __init__(self) -> None:
            self._config, self._net = Perception(fusion="when2com"), net

        def _sent(self, *_: object) -> torch.Tensor:
            return some

        def _head(self, maps: torch.Tensor) -> torch.Tensor:
            return maps

    def ready(value: torch.Tensor) -> Future[torch.Tensor]:
        done: Future[torch.Tensor] = Future()
        done.set_result(value)
        return done

    ego, sender = cross(0.0, 0.0, 0.0)[:2]
    share = Share(sender, "codes", 0.125, None, 1.0)
    read = {_part(share): ready(whole * some)}
    known = {ego: SimpleNamespace(maps=ready(own)), sender: SimpleNamespace(maps=ready(whole), coded=read)}
    with torch.inference_mode():
        detector = Codes()
        both = (
            detector._peer(known, share._replace(representation=what), sender.est_pose)  # type: ignore[arg-type]
            for what in ("codes", "features")
        )
        codes, cells = (detector._fuse(ego, ego.est_pose, [peer], known) for peer in both)  # type: ignore[arg-type]
        with_own = fused_map(net, POSE, own, [Peer(POSE, 1.0, whole * some, some)], "masked")
        as_sent = fused_map(net, POSE, own, [Peer(POSE, 1.0, whole, some)], "masked")
    assert codes is not None
    assert cells is not None
    assert torch.equal(codes, cells)
    assert not torch.equal(with_own, as_sent), "which of the two a handshake goes by matters"  # type: ignore[arg-type]


def test_a_peer_is_asked_that_has_more_attention_than_the_threshold_and_not_as_much() -> None:
    attention = torch.tensor([[0.5, 0.25, 0.25, 0.0], [0.125, 0.5, 0.125, 0.25]])
    assert asked(attention, 0.25).tolist() == [[False, False, False], [True, False, False]]
    assert asked(attention).tolist() == [[True, False, False], [True, False, False]]
