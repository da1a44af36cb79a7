"""The processor that a network runs on: `device` of the commands."""

from __future__ import annotations

import torch

from sortie.perception.errors import InputError


def device_named(name: str | None) -> torch.device:
    """The device of a name: "cpu", "cuda", or one of several GPUs as in "cuda:1". With "auto" or None, a GPU where there is one.

    Raises:
        InputError: there is none of that name here.
    """
    there = ["auto", "cpu"]
    if torch.cuda.is_available():
        there += ["cuda", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))]
    if name is not None and name not in there:
        raise InputError(f"device is {name!r}, must be one of {', '.join(there)} here")
    return torch.device(("cuda" if "cuda" in there else "cpu") if name in (None, "auto") else name)


def measuring_device(name: str | None) -> torch.device:
    """As `device_named`. In this process a GPU then computes in whole float32, and in the same order each time."""
    device = device_named(name)
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False  # 10 bits of mantissa would move boxes by centimetres
        torch.backends.cudnn.deterministic = True
    return device


def gpu_name(device: torch.device) -> str:
    """What the maker calls a GPU; empty for a CPU."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else ""
