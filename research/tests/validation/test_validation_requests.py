"""Which cells a request brings, and what it counts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from harness_examples import SeenFrames, made_frames, with_images

from research.paper.instrument import CarNetInstrument
from research.validation import requests_of_cells
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.network.fusion.where2comm import confidence_map
from sortie.perception.network.model import CarNet, ModelConfig

CELLS = 64


@pytest.fixture(scope="module")
def frames() -> SeenFrames:
    images = np.random.default_rng(5).integers(0, 255, (2, 5, 4, 256, 256), dtype=np.uint8)
    return with_images(made_frames([1, 2]), images)


@pytest.fixture(scope="module")
def net() -> CarNet:
    torch.manual_seed(0)
    return CarNet(ModelConfig(fusion="where2comm")).eval()


def test_a_request_ranks_by_what_the_receiver_lacks_at_the_same_place(frames: SeenFrames, net: CarNet) -> None:
    view = CarNetInstrument(net).look(frames, 0)
    together = np.zeros((5, 3))  # all at one place: grids lie on each other, so nothing is resampled
    with torch.inference_mode():
        sure = confidence_map(net.head(view.features)[:, 0]).double().numpy()
    found = requests_of_cells.ranks(net, view, together, requested=True)
    for receiver, sender in ((0, 1), (3, 2), (4, 4)):
        assert found[receiver, sender] == pytest.approx(sure[sender] * (1 - sure[receiver]), abs=1e-6)
    apart = together + np.array([[0, 0, 0], [1e4, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert (requests_of_cells.ranks(net, view, apart, requested=True)[0, 1] == -1.0).all()
    plain = requests_of_cells.ranks(net, view, together, requested=False)
    assert plain[4, 2] == pytest.approx(sure[2])


def test_as_many_cells_are_sent_as_were_allowed_and_the_first_in_order(frames: SeenFrames, net: CarNet) -> None:
    seen = requests_of_cells.Requesting(net, "confidence × request").look(frames, 0)
    sent = np.zeros((2, CELLS, CELLS), np.bool_)
    sent[0, :2], sent[1, 5] = True, True
    given = []
    view = requests_of_cells.RequestingView(seen.view, seen.place)
    view.view.detect = lambda exchanges, floor: given.extend(exchanges) or []  # type: ignore[method-assign,assignment]
    view.detect([Exchange(0, (3, 1), sent, "masked")], 0.1)
    assert given[0].sent.sum(axis=(1, 2)).tolist() == [128, 64]
    assert (given[0].sent[0] == (seen.place[0, 3] < 128)).all()


def test_a_request_costs_its_bytes_and_weights_of_another_fusion_are_refused(frames: SeenFrames, net: CarNet) -> None:
    rows = requests_of_cells.measure(net, frames)
    by = {(r.share, r.order): r.bytes_per_frame for r in rows}
    assert by[0.05, "confidence × request"] - by[0.05, "confidence"] == 20 * 8192
    with pytest.raises(ValueError, match="must be 'where2comm'"):
        requests_of_cells.Requesting(CarNet(ModelConfig(fusion="disconet")), "confidence")
