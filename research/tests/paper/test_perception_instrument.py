"""The network as an instrument: fusing only where something arrived is fusing everywhere, whatever the method."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from harness_examples import SeenFrames, made_frames, with_images
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from research.flip.networks import StudyConfig, StudyNet
from research.paper.instrument import CarNetInstrument, fingerprint
from research.paper.ways import FULL_SHARING, SINGLE, Sharing, evaluate
from sortie.perception.evaluation.harness import Settings, exchanges
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.geometry import FULL
from sortie.perception.network.checkpoint import save_weights
from sortie.perception.network.decode import decode
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.perception.network.warp import warp
from sortie.scenarios.schema.base import Params


@pytest.fixture(scope="module")
def frames() -> SeenFrames:
    rng = np.random.Generator(np.random.PCG64(5))
    coarse = rng.integers(0, 255, (2, 5, 4, 32, 32), dtype=np.uint8).repeat(8, axis=3).repeat(8, axis=4)
    return with_images(made_frames([1, 2]), coarse)


def network(fusion: str, seed: int = 0) -> CarNet:
    """Random weights, spread so that links do not weigh alike and many peaks pass the floor."""
    torch.manual_seed(seed)
    net = CarNet(ModelConfig(fusion=fusion)).eval()
    with torch.no_grad():
        for parameter in net.fusion.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        net.head.out.bias[0] = -1.0
    return net


@torch.inference_mode()
def everywhere(net: CarNet, features: torch.Tensor, frames: SeenFrames, f: int, e: Exchange) -> torch.Tensor:
    """The head's output by whole maps, `warp` and `takes_part`, one ego at a time."""
    est = torch.from_numpy(frames.est_pose[f] - frames.est_pose[f].mean(axis=0) * (1, 1, 0)).float()
    peers, k = list(e.peers), len(e.peers)
    sent = torch.from_numpy(e.sent)[:, None]
    moved, arrived, inside = warp(features[peers], sent, est[e.ego], est[peers], net.config.geometry.cell_m)
    ones = torch.ones(1, k)
    part = takes_part(arrived[None, :, 0], inside[None, :, 0], ones, e.unsent)
    agents = torch.cat([features[e.ego : e.ego + 1], moved])[None]
    weight = net.fusion.weigh(features[[e.ego]], features[peers][None], ones)
    out: torch.Tensor = net.head(net.fusion(agents, part, F.pad(weight, (1, 0), value=1.0)))[0]
    return out


@pytest.mark.parametrize("unsent", ["zero", "masked"])
@pytest.mark.parametrize(
    "fusion",
    [  # one in the short suite: together they take a minute
        pytest.param(name, marks=[] if name == "where2comm" else pytest.mark.slow)
        for name, f in FUSIONS.items()
        if f.shares == "features"
    ],
)
def test_fusing_where_something_arrived_is_fusing_everywhere(frames: SeenFrames, fusion: str, unsent: str) -> None:
    net = network(fusion)
    view = CarNetInstrument(net).look(frames, 0)
    net = folded(net)
    with torch.inference_mode():
        features = net.encoder(torch.from_numpy(frames.images[0]))
    rng = np.random.Generator(np.random.PCG64(1))
    cases = [
        Exchange(ego, peers, rng.random((len(peers), 64, 64)) < share, unsent)
        for share, ego, peers in ((0.0, 0, (1, 2)), (0.02, 0, (1, 2, 3, 4)), (0.3, 3, (0, 4)), (1.0, 3, (0, 4)))
    ]
    found = view.detect(cases, 0.01)
    apart = 0
    for e, ours in zip(cases, found, strict=True):
        theirs = decode(everywhere(net, features, frames, 0, e), 0.01).double().numpy()
        assert len(ours) == len(theirs) > 50
        # peaks of nearly equal score may change places
        assert np.sort(ours[:, 5]) == pytest.approx(np.sort(theirs[:, 5]), abs=2e-5)
        apart += not np.array_equal(ours[:, 5], found[0][:, 5])
    assert apart == 3, "what was sent matters"


def test_a_drone_alone_and_silent_peers(frames: SeenFrames) -> None:
    net = network("disconet")
    view = CarNetInstrument(net).look(frames, 1)
    nothing = np.zeros((4, 64, 64), bool)
    alone, silent, masked = view.detect(
        [
            Exchange(0, (), nothing[:0]),
            Exchange(0, (1, 2, 3, 4), nothing),
            Exchange(0, (1, 2, 3, 4), nothing, "masked"),
        ],
        0.01,
    )
    with torch.inference_mode():
        head = folded(net).head(folded(net).encoder(torch.from_numpy(frames.images[1]))[:1])[0]
    assert alone == pytest.approx(decode(head, 0.01).double().numpy(), abs=1e-4)
    assert np.array_equal(alone, masked)
    assert not np.array_equal(alone[:, 5], silent[:, 5]), "zeros dilute"


def test_ranks(frames: SeenFrames) -> None:
    net = network("disconet")
    view = CarNetInstrument(net).look(frames, 0)
    with torch.inference_mode():
        features = folded(net).encoder(torch.from_numpy(frames.images[0]))
        heat = folded(net).head(features)[:, 0].numpy()
    assert view.rank("norm") == pytest.approx(np.sqrt((features.numpy() ** 2).sum(axis=1)), rel=1e-4)
    assert view.rank("confidence") == pytest.approx(heat.reshape(5, 64, 2, 64, 2).max(axis=(2, 4)), abs=1e-4)


def test_a_fingerprint_is_of_weights_and_configuration(tmp_path: Path) -> None:
    net = network("disconet")
    assert fingerprint(net) == fingerprint(network("disconet")) != fingerprint(network("disconet", seed=1))
    signed = StudyNet(StudyConfig(exchange="signed")).eval()
    rectified = CarNet(ModelConfig()).eval()
    signed.encoder.load_state_dict(rectified.encoder.state_dict(), strict=False)
    assert fingerprint(signed) != fingerprint(rectified)
    save_weights(net, tmp_path / "w.safetensors")
    assert CarNetInstrument.load(tmp_path / "w.safetensors").fingerprint == fingerprint(net)
    with pytest.raises(ValueError, match="no such weights file"):
        CarNetInstrument.load(tmp_path / "none.safetensors")


def test_from_images_to_ap(frames: SeenFrames) -> None:
    """The whole way, with threads and without."""
    instrument = CarNetInstrument(network("disconet"))
    conditions = (SINGLE, Sharing(0.02, "best-2", roi=True), FULL_SHARING)
    threads = torch.get_num_threads()
    one = evaluate(instrument, frames, conditions, regions=("full", "ego"), egos=2)
    two = evaluate(instrument, frames, conditions, regions=("full", "ego"), egos=2, workers=2)
    assert torch.get_num_threads() == threads, "workers leave the caller's threads alone"
    for key, units in one.units.items():
        for a, b in zip(units, two.units[key], strict=True):
            assert a.score == pytest.approx(b.score, abs=2e-5)
            assert a.truths == b.truths
    assert sum(len(u.score) for u in one.units[FULL_SHARING, "full"]) > 200


def test_absent_peers_take_part_as_peers_who_sent_nothing(frames: SeenFrames) -> None:
    view = CarNetInstrument(network("disconet")).look(frames, 0)
    asked = (Sharing(0.05, "best-2"), Sharing(0.05, "best-2", absent="zeros"), Sharing(0.05, "best-2", unsent="masked"))
    settings = Settings(1, 0.01, "rotated", 0)
    (plain, few), (zeros, many), _ = exchanges(view, frames, 0, (0, 0), asked, settings, FULL, None)
    assert few == many[:2]
    assert many[2:] == [0, 0]
    assert set(zeros.peers) == {1, 2, 3, 4}
    assert zeros.peers[:2] == plain.peers
    assert np.array_equal(zeros.sent[:2], plain.sent)
    assert not zeros.sent[2:].any()
    two, four = view.detect([plain, zeros], 0.01)
    assert not np.array_equal(two[:, 5], four[:, 5])


def test_knobs_of_the_fusion_are_in_the_fingerprint_and_change_boxes(frames: SeenFrames) -> None:
    starved = Exchange(0, (1, 2, 3, 4), np.zeros((4, 64, 64), bool))
    asked: list[Params] = [{}, {"temperature": math.inf}, {"silent_weight": 2.0}]
    made = [CarNetInstrument(network("disconet"), fusion_params=params) for params in asked]
    assert len({instrument.fingerprint for instrument in made}) == 3
    scores = [instrument.look(frames, 0).detect([starved], 0.01)[0][:, 5] for instrument in made]
    assert not np.array_equal(scores[0], scores[1])
    assert not np.array_equal(scores[0], scores[2])
