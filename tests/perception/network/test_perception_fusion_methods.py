"""Every fusion method: who has a say, what a weight does, what cells that were not sent do, and the formula itself."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F  # noqa: N812
from wrong_rows import wrong_rows

from sortie.perception.geometry import CHANNELS
from sortie.perception.network.fusion.base import Fusion, takes_part
from sortie.perception.network.fusion.registry import DEFAULT, FUSIONS
from sortie.perception.network.fusion.traffic import LinkBytes
from sortie.perception.network.fusion.v2vnet import V2VNet
from sortie.perception.network.fusion.when2com import When2com, asked
from sortie.perception.network.fusion.where2comm import HEADS, Where2comm, confidence_map, requested_rank
from sortie.scenarios.schema import Perception

SIDE = 12
LEARNED = ("disconet", "v2vnet", "when2com", "where2comm")
FUSING = ("fcooper", *LEARNED)
draws = settings(max_examples=5, deadline=None, derandomize=True)


def made(name: str) -> Fusion:
    """A method with nothing left at its beginning, statistics of batch norms included."""
    torch.manual_seed(5)
    fusion = FUSIONS[name]().eval()
    with torch.no_grad():
        for value in [*fusion.parameters(), *(b for b in fusion.buffers() if b.dtype.is_floating_point)]:
            value.add_(0.02 * torch.randn_like(value).abs_() if value.ndim == 1 else 0.02 * torch.randn_like(value))
    return fusion


METHODS = {name: made(name) for name in FUSIONS}


def maps(seed: int, count: int, cells: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Features ≥ 0 [1, count, 80, 12, 12], and which cells of them were sent [1, count − 1, 12, 12]; others are 0."""
    rng = torch.Generator().manual_seed(seed)
    agents = torch.randn(1, count, CHANNELS, SIDE, SIDE, generator=rng).relu()
    sent = torch.rand(1, count - 1, SIDE, SIDE, generator=rng) < cells
    agents[:, 1:] *= sent[:, :, None]
    return agents, sent


@torch.inference_mode()
def fuse(
    name: str, agents: torch.Tensor, sent: torch.Tensor, weight: list[float], unsent: str = "masked"
) -> torch.Tensor:
    peers = torch.tensor([weight])
    part = takes_part(sent, torch.ones_like(sent), peers, unsent)
    out: torch.Tensor = METHODS[name](agents, part, F.pad(peers, (1, 0), value=1.0))
    return out


def test_a_peer_that_is_absent_mute_or_weightless_changes_nothing() -> None:
    def check(name: str) -> None:
        agents, sent = maps(1, 3)
        ego = agents[:, 0]
        assert torch.equal(fuse(name, agents[:, :1], sent[:, :0], []), ego)
        assert torch.equal(fuse(name, agents, sent, [0.0, 0.0]), ego)
        mute = agents.clone()
        mute[:, 1:] = 0.0
        assert torch.equal(fuse(name, mute, torch.zeros_like(sent), [1.0, 1.0]), ego)
        one = fuse(name, agents[:, :2], sent[:, :1], [0.8])
        for silent in ([0.8, 0.0], [0.8, 1.0]):
            with_silent = agents.clone()
            heard = sent.clone()
            if silent[1]:
                with_silent[:, 2], heard[:, 1] = 0.0, False
            assert torch.allclose(fuse(name, with_silent, heard, silent), one, atol=1e-5)
        if FUSIONS[name].shares == "features":
            assert not torch.allclose(one, ego, atol=1e-2)

    assert wrong_rows(FUSIONS, check) == {}


@pytest.mark.parametrize("name", FUSING)
@draws
@given(st.integers(0, 1000), st.permutations([1, 2, 3]), st.sampled_from(["masked", "zero"]))
def test_peers_have_no_order(name: str, seed: int, order: list[int], unsent: str) -> None:
    agents, sent = maps(seed, 4, 0.5)
    weight = [0.3, 1.0, 0.7]
    turned = fuse(name, agents[:, [0, *order]], sent[:, [i - 1 for i in order]], [weight[i - 1] for i in order], unsent)
    assert torch.allclose(turned, fuse(name, agents, sent, weight, unsent), atol=1e-4)


@pytest.mark.parametrize("name", FUSING)
@draws
@given(st.integers(0, 1000))
def test_zeros_and_masks_differ_only_where_something_was_not_sent(name: str, seed: int) -> None:
    agents, _ = maps(seed, 3)
    sent = torch.ones(1, 2, SIDE, SIDE, dtype=torch.bool)
    rng = torch.Generator().manual_seed(seed)
    row, column = torch.randint(SIDE, (2,), generator=rng).tolist()
    sent[:, 0, row, column] = False
    agents[:, 1, :, row, column] = 0.0
    zero, masked = (fuse(name, agents, sent, [1.0, 1.0], unsent) for unsent in ("zero", "masked"))
    differ = ((zero - masked).abs() > 1e-6).any(dim=1)[0]
    reach = FUSIONS[name].reach_cells
    near = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    near[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] = True
    assert not differ[~near].any()
    assert differ[row, column] or name == "fcooper"  # the maximum with zeros of what is ≥ 0 is the maximum


def test_a_weight_leads_from_absent_to_trusted_without_a_jump() -> None:
    def check(name: str) -> None:
        agents, sent = maps(3, 2)
        ego = agents[:, 0]
        assert torch.allclose(fuse(name, agents, sent, [1e-9]), ego, atol=1e-4)
        moved = [float((fuse(name, agents, sent, [w]) - ego).norm()) for w in (0.1, 0.4, 1.0)]
        assert moved[0] < moved[1] < moved[2]

    assert wrong_rows(FUSING, check) == {}


def test_egos_fused_together_are_egos_fused_alone() -> None:
    def check(name: str) -> None:
        agents, sent = maps(4, 3, 0.3)
        more, heard = maps(5, 3, 0.3)
        one = torch.ones(2, 2)
        part = takes_part(torch.cat([sent, heard]), torch.ones(2, 2, SIDE, SIDE, dtype=torch.bool), one, "masked")
        with torch.inference_mode():
            both = METHODS[name](torch.cat([agents, more]), part, torch.ones(2, 3))
        assert torch.allclose(both[:1], fuse(name, agents, sent, [1.0, 1.0]), atol=1e-5)
        assert torch.allclose(both[1:], fuse(name, more, heard, [1.0, 1.0]), atol=1e-5)

    assert wrong_rows(FUSING, check) == {}


def test_folding_changes_nothing_and_every_parameter_learns() -> None:
    def check(name: str) -> None:
        agents, sent = maps(6, 3, 0.6)
        part = takes_part(sent, torch.ones_like(sent), torch.ones(1, 2), "masked")
        fusion = made(name)
        with torch.no_grad():
            before = fusion(agents, part, torch.ones(1, 3))
            fusion.fold()
            assert torch.allclose(fusion(agents, part, torch.ones(1, 3)), before, atol=1e-4)
        fusion = FUSIONS[name]().train()
        parameters = list(fusion.parameters())
        if parameters:
            weight = F.pad(fusion.weigh(agents[:, 0], agents[:, 1:], torch.ones(1, 2)), (1, 0), value=1.0)
            grads = torch.autograd.grad(fusion(agents, part, weight).square().sum(), parameters)
            assert all(torch.isfinite(g).all() for g in grads)

    assert wrong_rows(FUSIONS, check) == {}


def test_f_cooper_is_the_maximum() -> None:
    agents, sent = maps(7, 4, 0.5)
    assert torch.allclose(fuse("fcooper", agents, sent, [1.0] * 3), agents.amax(dim=1), atol=1e-6)
    signed = agents - 0.5
    signed[:, 1:] *= sent[:, :, None]
    shown = torch.cat([torch.ones_like(sent[:, :1]), sent], dim=1)[:, :, None]
    highest = signed.masked_fill(~shown, -math.inf).amax(dim=1)
    assert torch.allclose(fuse("fcooper", signed, sent, [1.0] * 3), highest, atol=1e-6)


def test_v2vnet_is_the_stated_rounds() -> None:
    agents, sent = maps(8, 3, 0.5)
    net = METHODS["v2vnet"]
    assert isinstance(net, V2VNet)
    message = nn.Conv2d(2 * CHANNELS, net.from_ego.out_channels, 3, padding=1)
    with torch.inference_mode():
        message.weight.copy_(torch.cat([net.from_peer.weight, net.from_ego.weight], dim=1))
        message.bias.copy_(net.from_ego.bias)
        state = agents[:, 0]
        for _ in range(2):
            said = [F.relu(message(torch.cat([agents[:, j], state], dim=1))) * sent[:, j - 1 : j] for j in (1, 2)]
            mean = (said[0] + said[1]) / sent.sum(dim=1, keepdim=True).clamp_min(1)
            z, r = torch.sigmoid(net.gates(torch.cat([state, mean], dim=1))).split(CHANNELS, dim=1)
            state = (1 - z) * state + z * net.candidate(torch.cat([r * state, mean], dim=1))
        plain = torch.where(sent.any(dim=1, keepdim=True), net.last(state), agents[:, 0])
    assert torch.allclose(fuse("v2vnet", agents, sent, [1.0, 1.0]), plain, atol=1e-4)


def test_where2comm_is_attention_with_confidence_as_prior() -> None:
    agents, sent = maps(9, 3, 0.7)
    net = METHODS["where2comm"]
    assert isinstance(net, Where2comm)
    weight = [0.4, 1.0]
    fused = fuse("where2comm", agents, sent, weight)
    width = CHANNELS // HEADS
    for row, column in ((0, 0), (3, 11), (8, 7)):
        cell = agents[0, :, :, row, column]
        here = [0] + [j for j in (1, 2) if sent[0, j - 1, row, column]]
        if here == [0]:
            continue
        with torch.inference_mode():
            query, mixed = net.query(cell[0]), torch.zeros(CHANNELS)
            for h in range(HEADS):
                part = slice(h * width, (h + 1) * width)
                share = {}
                for j in here:
                    likeness = float(query[part] @ net.key(cell[j])[part]) / math.sqrt(width)
                    confidence = float(torch.sigmoid(net.confidence(cell[j])))
                    share[j] = math.exp(likeness) * confidence * (1.0 if j == 0 else weight[j - 1])
                for j in here:
                    mixed[part] += share[j] / sum(share.values()) * cell[j][part]
            trust = max(weight[j - 1] for j in here[1:])
            plain = mixed + trust * net.narrow(F.relu(net.widen(mixed)))
        assert torch.allclose(fused[0, :, row, column], plain, atol=1e-4)


def test_when2com_is_the_mean_by_attention_of_keys_and_queries() -> None:
    agents, sent = maps(10, 4, 0.7)
    net = METHODS["when2com"]
    assert isinstance(net, When2com)
    with torch.inference_mode():
        seen = [net.handshake.look(agents[:, i])[0] for i in range(4)]
        query = net.handshake.query(seen[0])
        scores = torch.stack([net.handshake.key(s) @ net.handshake.match.weight @ query for s in seen]) / 16
        attention = net.attention(agents[:, 0], agents[:, 1:])[0]
        assert torch.allclose(attention, scores.softmax(dim=0), atol=1e-5)
        directive = torch.tensor([[1.0, 0.5, 1.0]])
        weight = F.pad(net.weigh(agents[:, 0], agents[:, 1:], directive), (1, 0), value=1.0)
        fused = net(agents, takes_part(sent, torch.ones_like(sent), directive, "masked"), weight)
    for row, column in ((0, 0), (3, 11), (8, 7)):
        share = attention * torch.tensor([1.0, 1.0, 0.5, 1.0])
        share[1:] *= sent[0, :, row, column]
        plain = (share / share.sum()) @ agents[0, :, :, row, column]
        assert torch.allclose(fused[0, :, row, column], plain, atol=1e-4)


def test_a_score_far_from_the_drones_own_stays_finite() -> None:
    agents, _ = maps(11, 4)
    net = METHODS["when2com"]
    with torch.inference_mode():
        weight = net.weigh(1e5 * agents[:, 0], 1e5 * agents[:, 1:], torch.ones(1, 3))
    assert torch.isfinite(weight).all()


def test_a_handshake_is_of_whole_maps_and_of_nobody_elses() -> None:
    """A peer's odds hang on its own map and the ego's alone, whatever cells of it are sent."""
    agents, _ = maps(11, 4)
    net = METHODS["when2com"]
    with torch.inference_mode():
        three = net.weigh(agents[:, 0], agents[:, 1:], torch.ones(1, 3))
        one = net.weigh(agents[:, 0], agents[:, 2:3], torch.ones(1, 1))
    assert torch.allclose(three[:, 1:2], one, atol=1e-6)
    assert len(set(three[0].tolist())) == 3


def test_who2com_asks_one_and_when2com_whoever_has_more_attention_than_the_threshold() -> None:
    attention = torch.tensor([[0.9, 0.04, 0.06], [0.2, 0.5, 0.3], [0.5, 0.25, 0.25]])
    assert asked(attention).tolist() == [[False, True], [True, False], [True, False]]
    assert asked(attention, 0.25).tolist() == [[False, False], [True, True], [False, False]]


def test_confidence_is_smoothed_and_requests_ask_for_what_is_unknown() -> None:
    heat = torch.full((1, 128, 128), -math.inf)
    heat[0, 40, 60] = 0.0
    c = confidence_map(heat)
    assert c.shape == (1, 64, 64)
    assert float(c.sum()) == pytest.approx(0.5, abs=1e-6)  # σ(0), spread
    assert float(c[0, 20, 30]) == pytest.approx(0.5 / sum(math.exp(-(i * i) / 2) for i in range(-2, 3)) ** 2, abs=1e-6)
    assert float(c[0, 20, 30] / c[0, 20, 31]) == pytest.approx(math.exp(0.5), abs=1e-4)
    sure, unsure = torch.tensor([0.9]), torch.tensor([0.1])
    assert float(requested_rank(sure, unsure)) == pytest.approx(0.81)
    assert float(requested_rank(sure, torch.ones(1))) == 0.0


def test_bytes_of_each_method() -> None:
    for name in FUSING:
        first = 132 if name == "when2com" else 0  # a query of 32 floats and a score
        assert FUSIONS[name].link_bytes(cells=4096) == LinkBytes(655_360, 0, first)
        assert FUSIONS[name].link_bytes(cells=1024) == LinkBytes(163_840, 512, first)
        assert FUSIONS[name].link_bytes(cells=82).total == 82 * 160 + 123 + first
        assert FUSIONS[name].link_bytes(cells=0).total == first
    assert FUSIONS["none"].link_bytes(cells=4096, boxes=9).total == 0
    assert FUSIONS["late"].link_bytes(cells=4096, boxes=9) == LinkBytes(216)
    assert Where2comm.link_bytes(cells=82, rounds=2) == LinkBytes(13_120, 123, 8192)
    for call, message in (
        (lambda: FUSIONS["disconet"].link_bytes(cells=4097), "cells is 4097, must be 0 to 4096"),
        (lambda: FUSIONS["late"].link_bytes(boxes=-1), "boxes is -1, must be at least 0"),
        (lambda: Where2comm.link_bytes(cells=1, rounds=0), "rounds is 0, must be at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_the_registry_is_what_a_scenario_may_name() -> None:
    allowed = Perception.model_json_schema()["properties"]["fusion"]
    assert set(allowed["anyOf"][0]["enum"]) == set(FUSIONS)
    assert allowed["default"] == DEFAULT
    assert {name for name in FUSIONS if FUSIONS[name].weighs} == {"when2com"}
    assert all(f.about and "\n" not in f.about for f in FUSIONS.values())
