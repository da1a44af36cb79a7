"""Sharp images, 512² pixels of 0.4 m: the lift, the network's shapes, its files, and frames of the benchmark."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from perception_examples import capture
from safetensors.torch import save_file

from sortie.perception.errors import InputError
from sortie.perception.geometry import FULL, USUAL, Cameras, Geometry
from sortie.perception.network.bev import lift
from sortie.perception.network.checkpoint import load_weights, read_config, save_weights
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.perception.scene.render import camera_axes
from sortie.sim.cli.options import ImagePx

SHARP = Geometry(image_px=512)
NETWORK = ModelConfig(grid="fine", image_px=512)


def level(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Colours of a made ground: they rise by one level a metre ahead, by one to the left, and fall by a half for both."""
    return np.stack([128.0 + x_m, 128.0 + y_m, 128.0 - (x_m + y_m) / 2], axis=-1)


def pictures(cameras: Cameras, height_m: float) -> np.ndarray:
    """That ground in the pictures of a drone that hovers over the middle, by a pinhole in each pixel's centre."""
    column, row = np.meshgrid(np.arange(cameras.width_px) + 0.5, np.arange(cameras.height_px) + 0.5)
    lens = cameras.lens
    across = (2 * column / cameras.width_px - 1) * lens.half_h
    down = (2 * row / cameras.height_px - 1) * lens.half_v
    rays = np.stack([across, down, np.ones_like(down)], axis=-1) @ np.asarray(camera_axes(cameras), float)[:, None]
    far = height_m / np.maximum(-rays[..., 2], 1e-3)
    return np.clip(np.rint(level(rays[..., 0] * far, rays[..., 1] * far)), 0, 255).astype(np.uint8)


def test_a_sharp_image_averaged_over_two_by_two_pixels_is_the_usual_one() -> None:
    """And both are the ground: a plane of colours has in a pixel's middle what four quarters of it have on average."""
    images = []
    for geometry in (FULL, SHARP):
        c = capture()._replace(cameras=geometry.cameras)
        images.append(lift(pictures(c.cameras, 60.0)[None], [c], geometry)[0].double().numpy())
    usual, sharp = images
    assert (usual.shape, sharp.shape) == ((4, 256, 256), (4, 512, 512))
    averaged = sharp.reshape(4, 256, 2, 256, 2).mean(axis=(2, 4))
    axis = (np.arange(256) + 0.5) * 0.8 - 102.4
    x, y = np.meshgrid(axis, axis, indexing="ij")
    seen = (usual[3] == 255) & (averaged[3] == 255) & (np.hypot(x, y) < 70)
    assert seen.sum() > 0.9 * np.pi * (70 / 0.8) ** 2
    ground = level(x, y)[seen].T
    assert np.quantile(np.abs(averaged[:3, seen] - usual[:3, seen]), 0.999) < 1.1
    assert np.quantile(np.abs(usual[:3, seen] - ground), 0.999) < 1.1
    assert np.quantile(np.abs(averaged[:3, seen] - ground), 0.999) < 0.7, "rounding, averaged"
    assert np.abs((averaged[:3, seen] - ground).mean(axis=1)).max() < 0.05, "not even half a pixel aside, 0.2 levels"


def test_the_usual_geometry_stays_and_a_sharp_one_is_seen_by_finer_cameras() -> None:
    assert (FULL.image_m, FULL.cameras) == (0.8, USUAL)
    assert (SHARP.image_m, SHARP.cameras.width_px, SHARP.cameras.height_px) == (0.4, 320, 180)
    assert (SHARP.cell_m, SHARP.head_m) == (FULL.cell_m, FULL.head_m)
    assert {int(px.value) for px in ImagePx} == {FULL.image_px, SHARP.image_px}


def test_a_sharp_network_has_the_usual_features_and_one_layer_more() -> None:
    torch.manual_seed(2)
    usual, sharp = CarNet(ModelConfig(grid="fine")).eval(), CarNet(NETWORK).eval()
    image = torch.randint(0, 256, (1, 4, 512, 512), dtype=torch.uint8)
    with torch.inference_mode():
        assert sharp.encoder.stem(image).shape == (1, 16, 256, 256)
        features = sharp.encoder(image)
        assert features.shape == usual.encoder(image[..., ::2, ::2]).shape == (1, 80, 64, 64)
        quickly = folded(sharp).encoder(image)
        assert sharp.head(sharp.spread(features)).shape == (1, 8, 128, 128)
    assert torch.allclose(features, quickly, rtol=2e-3, atol=1e-4)
    shapes = [{k: v.shape for k, v in net.state_dict().items() if "encoder" not in k} for net in (usual, sharp)]
    assert shapes[0] == shapes[1]


def test_the_image_travels_with_the_weights_and_older_files_have_the_usual_one(tmp_path: Path) -> None:
    net = CarNet(NETWORK)
    save_weights(net, tmp_path / "sharp.safetensors")
    assert load_weights(tmp_path / "sharp.safetensors").config == NETWORK
    old = CarNet(ModelConfig(grid="fine"))
    model = {k: v for k, v in asdict(old.config).items() if k != "image_px"}
    tensors = {k: v.contiguous() for k, v in old.state_dict().items() if v.dtype.is_floating_point}
    save_file(tensors, tmp_path / "old.safetensors", metadata={"model": json.dumps(model)})
    assert load_weights(tmp_path / "old.safetensors").config == ModelConfig(grid="fine")
    save_file(tensors, tmp_path / "odd.safetensors", metadata={"model": json.dumps(model | {"image_px": 300})})
    with pytest.raises(InputError, match=r"odd\.safetensors: model\.image_px is 300, must be one of 256, 512"):
        read_config(tmp_path / "odd.safetensors")
