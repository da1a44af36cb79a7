"""Weights on disk: safetensors with the network's configuration and its history in the metadata."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from sortie.perception.errors import InputError
from sortie.perception.geometry import IMAGE_PX, SHARP_PX
from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.scenarios.plugins.reference import installed, is_file
from sortie.scenarios.replacing import replacing


def save_weights(net: CarNet, path: Path, facts: dict[str, Any] | None = None) -> None:
    """Write every tensor of `net` and its configuration, under a temporary name first; `facts` is JSON about its making."""
    metadata = {"model": json.dumps(asdict(net.config)), "sortie": json.dumps(facts or {})}
    tensors = {k: v.contiguous() for k, v in net.state_dict().items() if v.dtype.is_floating_point}
    with replacing(path) as part:
        save_file(tensors, part, metadata=metadata)
        part.chmod(0o644)  # the library makes it private


EARLIER = {"exchange": "rectified", "decoder": "shallow"}
"""Fields that earlier files have, with the only values that they may have."""


def load_weights(path: Path, own: Fusion | None = None) -> CarNet:
    """A network in evaluation mode from a safetensors file.

    Args:
        path: the file.
        own: a fusion of one's own. Its parameters come from the file where the file was made for such a fusion.
            From a file for a built-in fusion only encoder and head are taken.

    Raises:
        InputError: naming the file, and the tensor or configuration field that is missing, unknown or of another shape.
    """
    config = read_config(path)
    if own is None and config.fusion not in FUSIONS:
        raise InputError(f"{path}: made for fusion {config.fusion!r}, which perception.fusion does not name")
    return filled(CarNet(config, own), path, own)


def filled(net: CarNet, path: Path, own: Fusion | None = None) -> CarNet:
    """The network in evaluation mode with the tensors of a file; arguments and errors as for `load_weights`."""
    found = load_file(path)
    if own is not None and net.config.fusion in FUSIONS:
        found = {k: v for k, v in found.items() if not k.startswith("fusion.")}
        found |= {f"fusion.{k}": v for k, v in own.state_dict().items() if v.dtype.is_floating_point}
    wanted = {k: v for k, v in net.state_dict().items() if v.dtype.is_floating_point}
    for name, tensor in wanted.items():
        if name not in found:
            raise InputError(f"{path}: tensor {name} is missing")
        if found[name].shape != tensor.shape:
            raise InputError(f"{path}: tensor {name} has shape {list(found[name].shape)}, must be {list(tensor.shape)}")
        if not bool(torch.isfinite(found[name]).all()):
            raise InputError(f"{path}: tensor {name} holds values that are not finite")
    extra = sorted(set(found) - set(wanted))
    if extra:
        raise InputError(f"{path}: tensor {extra[0]} is not part of the network")
    net.load_state_dict(found, strict=False)
    return net.eval()


def read_config(path: Path) -> ModelConfig:
    """The configuration of the network that a weights file holds; the default's where the file says nothing of it."""
    return checked(path, {name: value for name, value in read_model(path).items() if EARLIER.get(name) != value})


def read_model(path: Path) -> dict[str, Any]:
    """The configuration as a weights file has it, unchecked."""
    model: dict[str, Any] = _metadata(path).get("model", {})
    return model


def checked(path: Path, given: dict[str, Any]) -> ModelConfig:
    """The configuration from its fields.

    Raises:
        InputError: an unknown field, or a value that it cannot have, naming the file.
    """
    known = {f.name: f for f in fields(ModelConfig)}
    for name in given:
        if name not in known:
            raise InputError(f"{path}: model.{name} is not known, must be one of {', '.join(known)}")
    config = ModelConfig(**given)
    for name, value, allowed in (
        (
            "fusion",
            config.fusion,
            (*FUSIONS, *installed("fusion"), *([config.fusion] if is_file(config.fusion) else [])),
        ),
        ("grid", config.grid, ("coarse", "fine")),
        ("half_extent_m", config.half_extent_m, (102.4, 51.2)),
        ("image_px", config.image_px, (IMAGE_PX, SHARP_PX)),
    ):
        if value not in allowed:
            raise InputError(f"{path}: model.{name} is {value!r}, must be one of {', '.join(map(str, allowed))}")
    return config


def read_facts(path: Path) -> dict[str, Any]:
    """What the file says of its making: data, runs, validation."""
    facts: dict[str, Any] = _metadata(path).get("sortie", {})
    return facts


def _metadata(path: Path) -> dict[str, dict[str, Any]]:
    if not path.is_file():
        raise InputError(f"{path}: no such weights file; `python -m research train` makes one")
    try:
        with safe_open(path, framework="pt") as file:
            return {k: json.loads(v) for k, v in (file.metadata() or {}).items() if k in ("model", "sortie")}
    except (SafetensorError, OSError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: not a weights file of this project ({error})") from None
