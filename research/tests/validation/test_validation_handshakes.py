"""Who asks whom in the comparison of handshakes, and what it counts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from harness_examples import SeenFrames, made_frames, with_images

from research.paper.instrument import CarNetInstrument
from research.validation import handshakes
from sortie.perception.network.model import CarNet, ModelConfig


@pytest.fixture(scope="module")
def frames() -> SeenFrames:
    images = np.random.default_rng(5).integers(0, 255, (2, 5, 4, 256, 256), dtype=np.uint8)
    return with_images(made_frames([1, 2]), images)


def network(fusion: str = "when2com") -> CarNet:
    torch.manual_seed(0)
    net = CarNet(ModelConfig(fusion=fusion)).eval()
    with torch.no_grad():
        for parameter in net.fusion.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return net


def test_every_choice_asks_others_and_as_many_as_its_name_says(frames: SeenFrames) -> None:
    net = network()
    attention = handshakes.attention_of(net, CarNetInstrument(net).look(frames, 0))
    assert attention.sum(axis=1) == pytest.approx(np.ones(5), abs=1e-5)
    overlap = np.array([[1.0, 0.5, 0.4, 0.3, 0.2]] * 5)
    many = {}
    for name, choose in handshakes.CHOICES.items():
        asks = choose(attention, overlap, np.random.default_rng(0))
        assert not np.diag(asks).any()
        many[name] = asks.sum(axis=1)
    assert (many.pop("When2com, learned") == ((attention > 0.2) & ~np.eye(5, dtype=bool)).sum(axis=1)).all()
    assert (many.pop("two at random") == 2).all()
    assert (np.array(list(many.values())) == 1).all()
    without_self = np.where(np.eye(5, dtype=bool), -1, attention)
    learned = handshakes.CHOICES["Who2com, learned"](attention, overlap, np.random.default_rng(0))
    assert learned.argmax(axis=1).tolist() == without_self.argmax(axis=1).tolist()
    assert handshakes.CHOICES["most overlap"](attention, overlap, np.random.default_rng(0)).argmax(axis=1).tolist() == [
        1,
        0,
        0,
        0,
        0,
    ]


def test_only_those_who_were_asked_are_heard_and_paid_for(frames: SeenFrames, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handshakes, "CHOICES", {k: handshakes.CHOICES[k] for k in ("Who2com, learned", "most overlap")})
    rows = {r.name: r for r in handshakes.measure(network(), frames)}
    assert [r.links_per_ego for r in rows.values()] == [1.0, 1.0, 4.0]
    one = 5 * 655_360
    assert [r.bytes_per_frame for r in rows.values()] == [one + 20 * 132, one, 4 * one]
    assert "| everyone | 4.00 | 13.11 MB |" in handshakes.table(list(rows.values())).markdown()
    with pytest.raises(ValueError, match="weights are made for fusion 'disconet', must be 'when2com'"):
        handshakes.Chosen(network("disconet"), "most overlap")
