"""The detector's forward pass by the hand-written kernel and by libraries: `make bench-all` runs these; nothing here asserts a time.

A forward pass is one drone's image through encoder and head, in float32. ONNX Runtime and OpenVINO are no dependencies:
`pip install onnx onnxruntime openvino` adds their rows.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from perception_examples import cross
from torch import Tensor, nn

from sortie.perception.network import inference
from sortie.perception.network.bev import lift
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.detector import SHIPPED_WEIGHTS, TorchDetector
from sortie.perception.network.model import CarNet, colours
from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.schema import Perception, Scene

pytestmark = pytest.mark.slow

Forward = Callable[[Tensor], Tensor]
Parts = tuple[Forward, Forward]
"""Encoder, uint8 [1, 4, 256, 256] → [1, 80, 64, 64], and head, → [1, 8, 128, 128]: apart, as the exchange lies between them."""
IMAGE = torch.zeros(1, 4, 256, 256, dtype=torch.uint8)


class PlainStem(nn.Module):
    """`inference.QuickStem` in torch's operators only, which the libraries can read."""

    def __init__(self, stem: inference.QuickStem) -> None:
        super().__init__()
        self.stem = stem

    def forward(self, image: Tensor) -> Tensor:
        x = nn.functional.conv2d(colours(image), self.stem.seen, None, self.stem.stride, self.stem.padding)
        return (x + self.stem.where).relu()


def plain() -> CarNet:
    """The network as it was trained."""
    return load_weights(SHIPPED_WEIGHTS).eval()


def flown() -> CarNet:
    """The network as the detector flies it."""
    return inference.folded(plain())


def folded() -> CarNet:
    """The network with its batch norms folded, its first layer split and plain convolutions: what a library is given."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inference, "suits", lambda conv: False)
        net = inference.folded(plain())
    net.encoder.stem = PlainStem(net.encoder.stem)  # type: ignore[arg-type, assignment]
    return net


def parts_of(net: CarNet) -> tuple[nn.Module, nn.Module]:
    """Encoder and head, the layer that makes an exchanged map fine with the head."""
    return net.encoder, nn.Sequential(net.spread, net.head)


def by_torch(net: CarNet) -> Parts:
    """Layer by layer."""
    return parts_of(net)


def by_compiler(freezing: bool = False) -> Parts:
    """By torch's compiler, the weights fixed or not. The number of threads is fixed when it first runs."""
    from torch._inductor import config

    config.freezing = freezing
    encoder, head = parts_of(folded())
    parts = torch.compile(encoder), torch.compile(head)
    with torch.no_grad():
        parts[1](parts[0](IMAGE))
    return parts


def exported(folder: Path) -> list[Path]:
    """Encoder and head as ONNX files."""
    pytest.importorskip("onnx")
    parts, paths = parts_of(folded()), [folder / "encoder.onnx", folder / "head.onnx"]
    with torch.no_grad():
        for part, seen, path in zip(parts, (IMAGE, parts[0](IMAGE)), paths, strict=True):
            torch.onnx.export(part, (seen,), str(path), input_names=["seen"], dynamo=False)
    return paths


def by_onnx_runtime(folder: Path, threads: int) -> Parts:
    """By ONNX Runtime."""
    runtime = pytest.importorskip("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1

    def part(path: Path) -> Forward:
        session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        return lambda seen: torch.from_numpy(session.run(None, {"seen": seen.contiguous().numpy()})[0])

    encoder, head = exported(folder)
    return part(encoder), part(head)


def by_openvino(folder: Path, hint: str, streams: int) -> Parts:
    """By OpenVINO on two threads, with one request for each thread that calls it."""
    library = pytest.importorskip("openvino")
    settings = {"INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": hint}
    settings |= {"NUM_STREAMS": str(streams), "INFERENCE_NUM_THREADS": "2"}

    def part(path: Path) -> Forward:
        model, own = library.Core().compile_model(str(path), "CPU", settings), threading.local()

        def forward(seen: Tensor) -> Tensor:
            if not hasattr(own, "request"):
                own.request = model.create_infer_request()
            (out,) = own.request.infer([seen.contiguous().numpy()]).values()
            return torch.from_numpy(out.copy())

        return forward

    encoder, head = exported(folder)
    return part(encoder), part(head)


WAYS: dict[str, tuple[int, Callable[[Path], Parts]]] = {
    "plain torch, 2 threads": (1, lambda folder: by_torch(plain())),
    "plain torch, side by side": (2, lambda folder: by_torch(plain())),
    "folded torch, side by side": (2, lambda folder: by_torch(folded())),
    "as flown, side by side": (2, lambda folder: by_torch(flown())),
    "torch.compile, 2 threads": (1, lambda folder: by_compiler()),
    "torch.compile, side by side": (2, lambda folder: by_compiler()),
    "torch.compile frozen, side by side": (2, lambda folder: by_compiler(freezing=True)),
    "ONNX Runtime, 2 threads": (1, lambda folder: by_onnx_runtime(folder, 2)),
    "ONNX Runtime, side by side": (2, lambda folder: by_onnx_runtime(folder, 1)),
    "OpenVINO latency, 2 threads": (1, lambda folder: by_openvino(folder, "LATENCY", 1)),
    "OpenVINO throughput, side by side": (2, lambda folder: by_openvino(folder, "THROUGHPUT", 2)),
}
"""How many tasks run at a time on two cores, and what makes the network's parts."""


def images() -> list[Tensor]:
    """Five drones' bird's-eye images of one moment, as the detector makes them."""
    detector = TorchDetector(SceneModel(Scene(), None, (-50, -50, 50, 50)), Perception(), seed=1)
    fleet = cross(10.0, 20.0, 0.3)
    views = detector._renderer.render(fleet)
    return [lift(views[i : i + 1], fleet[i : i + 1]) for i in range(len(fleet))]


class Workers:
    """Threads that run encoders and heads as tasks, each with its share of two cores."""

    def __init__(self, way: str, folder: Path) -> None:
        at_a_time, make = WAYS[way]
        torch.set_num_threads(2 // at_a_time)
        self._encoder, self._head = make(folder)
        self._pool = ThreadPoolExecutor(at_a_time, initializer=torch.set_num_threads, initargs=(2 // at_a_time,))

    def __call__(self, fleet: list[Tensor]) -> list[Tensor]:
        """One output an image."""
        features = [self._pool.submit(self._run, self._encoder, lambda seen=seen: seen) for seen in fleet]
        outs = [self._pool.submit(self._run, self._head, f.result) for f in features]
        return [out.result() for out in outs]

    @staticmethod
    def _run(part: Forward, seen: Callable[[], Tensor]) -> Tensor:
        with torch.no_grad():
            return part(seen())


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    """Torch's number of threads, put back."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.filterwarnings("ignore")  # torch's compiler warns of its own calls
@pytest.mark.parametrize("way", WAYS)
def test_five_forward_passes(benchmark: Any, tmp_path: Path, way: str) -> None:
    """A fleet-frame on two cores, and how far its numbers are from plain torch's."""
    fleet = images()
    want = Workers("plain torch, 2 threads", tmp_path)(fleet)
    got = benchmark(Workers(way, tmp_path), fleet)
    apart = max(float((g - w).abs().max()) for g, w in zip(got, want, strict=True))
    benchmark.extra_info["largest difference"] = apart
    assert apart < 0.05
