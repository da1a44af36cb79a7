"""Codes of cells: a codebook by brute force and its file; and the fine network's cells, spread, corrected and fused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from perception_examples import cross, same
from safetensors.torch import save_file
from torch import Tensor

from sortie.perception.errors import InputError
from sortie.perception.files import codebook_digest
from sortie.perception.network import warp
from sortie.perception.network.checkpoint import load_weights, save_weights
from sortie.perception.network.codebook import ENTRIES, Codebook, encoder_digest, load_codebook, save_codebook
from sortie.perception.network.decode import decode
from sortie.perception.network.detector import SHIPPED_WEIGHTS, TorchDetector
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.model import Align, CarNet, ModelConfig
from sortie.perception.network.warp import arriving, moved, support
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception, Scene, Target
from sortie.scenarios.shipped import CODEBOOK, beside

pytestmark = pytest.mark.slow


def drawn(stages: int = 3, seed: int = 0) -> Codebook:
    made = torch.from_numpy(np.random.default_rng(seed).normal(size=(stages, ENTRIES, 80))).float()
    made = made * torch.tensor([1.0, 0.5, 0.25, 0.1])[:stages, None, None]
    return Codebook(made.half().float(), "of none")  # as a file has them


def test_each_byte_names_the_entry_nearest_to_what_is_left() -> None:
    codebook, cells = drawn(), torch.from_numpy(np.random.default_rng(1).normal(size=(40, 80))).float().relu()
    codes = codebook.encode(cells, 3)
    assert codes.shape == (40, 3)
    assert codes.dtype == torch.uint8
    for cell, code in zip(cells.double(), codes.tolist(), strict=True):
        left = cell.clone()
        for entries, found in zip(codebook.stages.double(), code, strict=True):
            far = ((left - entries) ** 2).sum(dim=1)
            assert far[found] <= far.min() + 1e-5
            left = left - entries[found]
    torch.testing.assert_close(codebook.encode(cells, 2), codes[:, :2])  # the beginning of a longer one
    read = [codebook.decode(codebook.encode(cells, k)) for k in (1, 2, 3)]
    lost = [float(((cells - r) ** 2).sum()) for r in read]
    assert lost[0] > lost[1] > lost[2] > 0.0
    summed = torch.stack([s[c.long()] for s, c in zip(codebook.stages, codes.T, strict=True)]).sum(dim=0)
    torch.testing.assert_close(read[2], summed.clamp_min(0.0).half().float())


def test_a_map_is_read_where_it_was_sent_and_features_stay_0_or_above() -> None:
    codebook = drawn()
    features = torch.from_numpy(np.random.default_rng(4).normal(size=(80, 4, 4))).float().relu()
    whole = codebook.read(features, 2)
    assert float(whole.min()) == 0.0
    assert torch.equal(whole, whole.half().float())
    sent = torch.zeros(4, 4, dtype=torch.bool)
    sent[1, 2] = sent[3, 0] = True
    part = codebook.read(features, 2, sent)
    assert torch.equal(part[:, sent], whole[:, sent])
    assert not part[:, ~sent].any()
    assert torch.equal(whole[:, 1, 2], codebook.decode(codebook.encode(features[:, 1, 2][None], 2))[0])
    with pytest.raises(ValueError, match="length is 4, must be 1 to 3"):
        codebook.encode(features.flatten(1).T, 4)


def test_the_file_is_read_as_it_was_written_and_belongs_to_its_network(tmp_path: Path) -> None:
    net = load_weights(SHIPPED_WEIGHTS)
    path = beside(tmp_path / "net.safetensors", CODEBOOK)
    made = drawn()
    codebook = Codebook(made.stages, encoder_digest(net))
    save_codebook(codebook, path, {})
    read = load_codebook(path, net)
    torch.testing.assert_close(read.stages, codebook.stages)
    assert (read.encoder, read.longest) == (codebook.encoder, 3)
    other = CarNet(ModelConfig()).eval()
    with pytest.raises(InputError, match="fitted to another encoder than the weights'"):
        load_codebook(path, other)
    save_file({"stages": torch.zeros(2, 5, 80)}, path, metadata={"codebook": '{"encoder": ""}'})
    with pytest.raises(InputError, match=r"stages have shape \[2, 5, 80\], must be \[1 to 20, 256, 80\]"):
        load_codebook(path, net)
    save_weights(other, path)
    with pytest.raises(InputError, match="not a codebook of this project"):
        load_codebook(path, net)
    with pytest.raises(InputError, match="no such codebook; `python -m research fit codebook` makes one"):
        load_codebook(tmp_path / "none", net)


def test_the_shipped_codebook_has_every_length_and_longer_codes_come_nearer_to_features() -> None:
    net = load_weights(SHIPPED_WEIGHTS)
    book = load_codebook(beside(SHIPPED_WEIGHTS, CODEBOOK), net)
    assert (book.longest, len(codebook_digest(beside(SHIPPED_WEIGHTS, CODEBOOK)))) == (20, 14)
    ego = cross(10.0, 20.0, 0.3)[0]
    features = TorchDetector(town(), Perception(), 1)._encode([ego])[ego].features.result()
    lost = [float(((features - book.read(features, k)) ** 2).mean() / features.var()) for k in (1, 5, 20)]
    assert 0.6 > lost[0] > lost[1] > lost[2] > 0.0
    assert lost[2] < 0.1


def town() -> SceneModel:
    return SceneModel(Scene(), None, (-50, -50, 50, 50))


def test_late_fusion_detects_in_what_is_read() -> None:
    ego, peer = cross(10.0, 20.0, 0.3)[:2]
    detector = TorchDetector(town(), Perception(fusion="late", code_bytes=2), 1)
    jobs = [(ego, [Share(peer, what, 1.0, None, 1.0)]) for what in ("codes", "features")]
    assert not same(*detector.detect(jobs))


def test_a_codebook_that_is_missing_too_short_or_another_networks_is_one_error(tmp_path: Path) -> None:
    ego, peer = cross(10.0, 20.0, 0.3)[:2]
    short = tmp_path / "short.safetensors"
    save_codebook(Codebook(drawn().stages, encoder_digest(load_weights(SHIPPED_WEIGHTS))), short, {})
    for name, message in (
        (str(tmp_path / "none.safetensors"), r"none\.safetensors: no such codebook"),
        (str(short), r"perception.code_bytes is 10, must be at most 3, the stages of .*short"),
        ("disconet.codebook.safetensors", r"disconet\.codebook\.safetensors: fitted to another encoder"),
    ):
        with pytest.raises(InputError, match=message):
            TorchDetector(town(), Perception(codebook=name), 1).detect([(ego, [Share(peer, "codes", 0.05, None, 1.0)])])


FINE = ModelConfig(grid="fine")


def network(seed: int = 0) -> CarNet:
    """Random weights, the correction for lying between cells among them."""
    torch.manual_seed(seed)
    net = CarNet(FINE).eval()
    with torch.no_grad():
        for parameter in (*net.fusion.parameters(), *net.align.parameters()):
            parameter.add_(0.1 * torch.randn_like(parameter))
        net.head.out.bias[0] = -1.0
    return net


def test_each_exchanged_cell_is_spread_by_itself() -> None:
    net = network()
    features = torch.rand(1, 80, 64, 64)
    sent = torch.rand(1, 64 * 64) < 0.3
    with torch.inference_mode():
        whole, part = net.spread(features), net.spread(features * sent.view(1, 1, 64, 64))
    assert whole.shape == (1, 40, 128, 128)
    wide = net.sent(sent).view(1, 1, 128, 128)
    assert torch.allclose(whole * wide, part * wide, atol=1e-6)
    assert wide[0, 0, 2 * 7 : 2 * 8, 2 * 9 : 2 * 10].eq(sent.view(64, 64)[7, 9]).all()
    assert CarNet().sent(sent) is sent  # a coarse network fuses what is exchanged


def test_where_cells_lie_between_a_peers_cells() -> None:
    ego, peer = torch.tensor([10.0, 0.0, 0.5]), torch.tensor([[10.0, 0.0, 0.5], [10.4, 0.0, 0.0], [10.0, 0.0, 0.8]])
    under = support(ego, peer, 1.6, 128)
    assert torch.allclose(under.offset[0], torch.zeros(128, 128, 2), atol=1e-4)  # it stands where the ego stands
    assert under.turn.tolist() == pytest.approx([0.0, -0.5, 0.3])
    level = support(torch.zeros(3), torch.tensor([[0.4, -0.6, 0.0]]), 1.6, 128)
    assert level.offset[0, 64, 64].tolist() == pytest.approx([-0.25, 0.375], abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(3.2, 64), (1.6, 128)]), st.sampled_from([0.0, 5.0, 100.0, 300.0]))
def test_compiled_loops_lay_cells_as_tensors_do(seed: int, grid: tuple[float, int], spread_m: float) -> None:
    """Bit for bit, also where grids hardly overlap or not at all."""
    cell_m, n = grid
    rng = np.random.default_rng(seed)
    poses = torch.from_numpy(np.column_stack([rng.normal(0, spread_m, (3, 2)), rng.uniform(-7, 7, 3)])).float()
    if spread_m < 1.0:  # whole and half cells: some cells have exactly half of their support
        poses = torch.from_numpy(np.column_stack([rng.integers(-3, 4, (3, 2)) * cell_m / 2, np.zeros(3)])).float()
    sent = torch.from_numpy(rng.random((2, n * n)) < rng.random((2, 1)))
    seen: list[Sequence[Tensor]] = []

    def laid(place: Sequence[Any], *into: Any) -> None:
        seen.append([torch.from_numpy(v.copy()) for v in place])

    under = support(poses[0], poses[1:], cell_m, n)
    with mock.patch.object(warp, "_lay", lambda *of: laid(of[:4])):
        support(poses[0], poses[1:], cell_m, n)
    for compiled, plain in zip(under, warp._laid(seen[0], n), strict=False):
        assert torch.equal(compiled, plain)
    for compiled, plain in zip(arriving(under, sent), warp._arrived(under, sent), strict=True):
        assert torch.equal(compiled, plain)


@pytest.mark.parametrize("odd", [math.nan, math.inf])
def test_poses_that_are_not_finite_are_an_error(odd: float) -> None:
    peers = torch.tensor([[1.0, 2.0, 0.5], [odd, 0.0, 0.0]])
    with pytest.raises(ValueError, match=rf"^poses are \[0\.0, 0\.0, 0\.0\] and \[.*{odd}.*\], must be finite$"):
        support(torch.zeros(3), peers, 1.6, 128)


def test_the_correction_begins_as_none_and_leaves_silence() -> None:
    torch.manual_seed(0)
    align = Align(8)
    said = torch.rand(2, 30, 8)
    said[0, :10] = 0.0
    offset, turn = torch.rand(2, 30, 2) - 0.5, torch.tensor([0.0, 1.0])
    assert torch.equal(align(said, offset, turn), said)
    torch.nn.init.normal_(align.out.weight)
    torch.nn.init.normal_(align.out.bias)
    with torch.inference_mode():
        out = align(said, offset, turn)
        assert not out[0, :10].any()
        assert out[0, 10:].any()
        assert not torch.allclose(align(said, -offset, turn), out)
        assert not torch.allclose(align(said, offset, turn + 0.5), out)
        assert torch.allclose(align(said, offset, turn + 2 * math.pi), out, atol=1e-5)


def test_it_flies_as_the_harness_measures_it(tmp_path: Path) -> None:
    """One ego and three shares: in full, in part, and one that is trusted half."""
    scene = SceneModel(Scene(), Target(waypoints_m=((0, 0), (100, 0))), (-50, -50, 50, 50))
    save_weights(network(), tmp_path / "fine.safetensors")
    detector = TorchDetector(scene, Perception(), 1, tmp_path / "fine.safetensors")
    ego, *peers = cross(10.0, 20.0, 0.3)[:4]
    shares = [Share(peers[0], "features", 1.0, None, 1.0), Share(peers[1], "features", 0.05, None, 1.0)]
    shares.append(Share(peers[2], "features", 1.0, None, 0.5))
    (found,) = detector.detect([(ego, shares)])
    (alone,) = detector.detect([(ego, ())])
    known, net = detector._encode([ego, *peers]), detector._net
    with torch.inference_mode():
        maps = [known[c].maps.result() for c in (ego, *peers)]
        sent = torch.stack([detector._sent(s, known).flatten() for s in shares])
        assert int(sent[1].sum()) == int(0.05 * 4096)
        place = torch.tensor(
            [(c.est_pose[0] - ego.est_pose[0], c.est_pose[1] - ego.est_pose[1], c.est_pose[2]) for c in peers]
        )
        under = support(torch.tensor((0.0, 0.0, ego.est_pose[2])), place.float(), 1.6, 128)
        weights, arrived = arriving(under, net.sent(sent))
        rows = moved(torch.stack(maps[1:]), under, weights).permute(0, 2, 3, 1).flatten(1, 2)
        said = net.aligned(rows, under.offset.flatten(1, 2), under.turn).view(3, 128, 128, -1).permute(0, 3, 1, 2)
        trust = torch.tensor([[1.0, 1.0, 1.0, 0.5]])
        part = takes_part(arrived[None], under.inside[None], trust[:, 1:], "masked")
        out = net.head(net.fusion(torch.cat([maps[0][None], said])[None], part, trust))[0]
        wanted = detector._place(out, ego.est_pose)
    assert len(found) == len(wanted) > 50
    assert found.score == pytest.approx(wanted.score, abs=1e-4)
    assert not np.array_equal(found.score[:20], alone.score[:20])


def test_a_score_is_the_mean_of_heat_and_fit() -> None:
    out = torch.full((8, 128, 128), -20.0)
    out[1:7] = 0.0
    out[0, 40, 40], out[7, 40, 40] = math.log(0.9 / 0.1), math.log(0.4 / 0.6)
    (box,) = decode(out, 0.1)
    assert float(box[5]) == pytest.approx(math.sqrt(0.9 * 0.4))
    assert float(decode(out[:7], 0.1)[0, 5]) == pytest.approx(0.9)
