"""Where a network runs: by name, or on what is there."""

from __future__ import annotations

import pytest
import torch

from research.paper.instrument import CarNetInstrument, fingerprint
from research.train.devices import device_named, gpu_name, measuring_device
from sortie.perception.network.model import CarNet


def test_a_device_is_chosen_by_name_or_left_to_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert {str(device_named(name)) for name in (None, "auto", "cpu")} == {"cpu"}
    with pytest.raises(ValueError, match="device is 'cuda', must be one of auto, cpu here"):
        device_named("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert [str(device_named(name)) for name in (None, "auto", "cuda:1")] == ["cuda", "cuda", "cuda:1"]
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "Some Card")
    assert gpu_name(torch.device("cuda")) == "Some Card"
    assert gpu_name(torch.device("cpu")) == ""


def test_figures_are_measured_in_whole_float32_and_repeatably_on_a_gpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    flags = torch.backends.cudnn
    for name, value in (("allow_tf32", True), ("deterministic", False)):
        monkeypatch.setattr(flags, name, value)
    assert measuring_device("cpu") == torch.device("cpu")
    assert (flags.allow_tf32, flags.deterministic) == (True, False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert measuring_device("auto") == torch.device("cuda")
    assert (flags.allow_tf32, flags.deterministic) == (False, True)


def test_what_a_gpu_computed_is_not_taken_for_what_a_processor_did(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("research.paper.instrument.gpu_name", lambda device: "Some Card")
    net = CarNet()
    assert CarNetInstrument(net).fingerprint == f"{fingerprint(net)} on Some Card"
