"""Codes: a codebook by brute force, its file, and what a detector fuses of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from perception_examples import cross
from safetensors.torch import save_file

from sortie.perception.budget import content_bytes
from sortie.perception.errors import InputError
from sortie.perception.files import codebook_digest
from sortie.perception.network.checkpoint import load_weights, save_weights
from sortie.perception.network.codebook import (
    ENTRIES,
    Codebook,
    encoder_digest,
    load_codebook,
    save_codebook,
)
from sortie.perception.network.detector import SHIPPED_WEIGHTS, TorchDetector
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.schema import Perception, Scene
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
    torch.testing.assert_close(
        codebook.encode(cells, 2), codes[:, :2]
    )  # a shorter code is the beginning of a longer one
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


def test_the_shipped_codebook_belongs_to_the_shipped_network_and_has_every_length() -> None:
    codebook = load_codebook(beside(SHIPPED_WEIGHTS, CODEBOOK), load_weights(SHIPPED_WEIGHTS))
    assert codebook.longest == 20
    assert len(codebook_digest(beside(SHIPPED_WEIGHTS, CODEBOOK))) == 14


def test_a_shipped_codebook_may_be_named_without_its_folder() -> None:
    """As its network: here another network's, so that it is found and refused."""
    scene, (ego, peer) = SceneModel(Scene(), None, (-50, -50, 50, 50)), cross(0.0, 0.0, 0.3)[:2]
    detector = TorchDetector(scene, Perception(codebook="disconet.codebook.safetensors"), 1)
    with pytest.raises(
        InputError, match=r"disconet\.codebook\.safetensors: fitted to another encoder than the weights'"
    ):
        detector.detect([(ego, [Share(peer, "codes", 0.1, None, 1.0)])])


def test_a_cell_of_codes_has_so_many_bytes_beside_index_and_codebook() -> None:
    for length in (5, 20):
        assert content_bytes("codes", cells=205, code_bytes=length) == 8 + 205 * length + 308
    assert content_bytes("codes", cells=4096, code_bytes=10) == 8 + 40960
    assert content_bytes("features", cells=205) / content_bytes("codes", cells=205, code_bytes=5) > 24


# --- what is fused -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return SceneModel(Scene(), None, (-50, -50, 50, 50))


@pytest.fixture(scope="module")
def fleet() -> list[Capture]:
    return cross(10.0, 20.0, 0.3)[:3]


def same(a: Boxes, b: Boxes) -> bool:
    return len(a) == len(b) and all(np.array_equal(getattr(a, f), getattr(b, f)) for f in Boxes.__slots__)


def codes(c: Capture, rho: float = 0.05) -> Share:
    return Share(c, "codes", rho, None, 1.0)


def test_longer_codes_come_nearer_to_features(scene: SceneModel, fleet: list[Capture]) -> None:
    net = load_weights(SHIPPED_WEIGHTS)
    book = load_codebook(beside(SHIPPED_WEIGHTS, CODEBOOK), net)
    detector = TorchDetector(scene, Perception(), 1)
    features = detector._encode(fleet[:1])[fleet[0]].features.result()
    lost = [float(((features - book.read(features, k)) ** 2).mean() / features.var()) for k in (1, 5, 20)]
    assert 0.6 > lost[0] > lost[1] > lost[2] > 0.0
    assert lost[2] < 0.1


def test_late_fusion_detects_in_what_is_read(scene: SceneModel, fleet: list[Capture]) -> None:
    detector = TorchDetector(scene, Perception(fusion="late", code_bytes=2), 1)
    coarse, plain = detector.detect(
        [(fleet[0], [codes(fleet[1], 1.0)]), (fleet[0], [codes(fleet[1], 1.0)._replace(representation="features")])]
    )
    assert not same(coarse, plain)


def test_a_codebook_that_is_missing_or_too_short_is_one_error(
    scene: SceneModel, fleet: list[Capture], tmp_path: Path
) -> None:
    job = [(fleet[0], [codes(fleet[1])])]
    with pytest.raises(InputError, match=r"none\.safetensors: no such codebook"):
        TorchDetector(scene, Perception(codebook=str(tmp_path / "none.safetensors")), 1).detect(job)
    path = tmp_path / "short.safetensors"
    save_codebook(Codebook(drawn().stages, encoder_digest(load_weights(SHIPPED_WEIGHTS))), path, {})
    with pytest.raises(InputError, match=r"perception.code_bytes is 10, must be at most 3, the stages of .*short"):
        TorchDetector(scene, Perception(codebook=str(path)), 1).detect(job)
