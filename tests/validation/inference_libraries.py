"""The detector's forward of a fleet-frame (five encoders and heads) by our inference and by libraries, on two cores.

    pip install onnx onnxruntime openvino
    python tests/validation/inference_libraries.py

Every variant computes the same five results, by turns, forty times; the table has the fastest turn and the median.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.network import inference
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.detector import SHIPPED_WEIGHTS
from sortie.perception.network.model import CarNet, colours

DRONES, THREADS, TURNS = 5, 2, 40


class Forward(nn.Module):
    """One drone's image to the head's output."""

    def __init__(self, net: CarNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: Tensor) -> Tensor:
        out: Tensor = self.net.head(self.net.encoder(image))
        return out


class Exportable(Forward):
    """The same without compiled loops, for libraries that read the operators."""

    def forward(self, image: Tensor) -> Tensor:
        encoder: Any = self.net.encoder
        stem = encoder.stem
        first = F.conv2d(colours(image), stem.seen, None, stem.stride, stem.padding)
        out: Tensor = self.net.head(encoder.body(encoder.down(torch.relu(first + stem.where))).half().float())
        return out


def plainly_folded(net: CarNet) -> CarNet:
    """Batch norms folded, convolutions left to torch."""
    suits, inference.suits = inference.suits, lambda conv: False
    try:
        return inference.folded(net)
    finally:
        inference.suits = suits


def variants(net: CarNet, images: list[Tensor], folder: Path) -> dict[str, Callable[[], list[Any]]]:
    """A function a variant that returns the results for all images."""
    import onnxruntime
    import openvino

    pool = ThreadPoolExecutor(THREADS, initializer=torch.set_num_threads, initargs=(1,))

    def side_by_side(one: Callable[[Tensor], Any]) -> Callable[[], list[Any]]:
        return lambda: list(pool.map(torch.inference_mode()(one), images))

    plain = Exportable(plainly_folded(net)).eval()
    path = folder / "net.onnx"
    torch.onnx.export(plain, (images[0],), str(path), input_names=["x"], opset_version=17, dynamo=False)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    settings = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": THREADS}
    ov = openvino.Core().compile_model(str(path), "CPU", settings)
    compiled = torch.compile(plain)
    with torch.inference_mode():
        compiled(images[0])  # compiles
    return {
        "Sortie (folded, Winograd)": side_by_side(Forward(inference.folded(net))),
        "OpenVINO": lambda: [ov({0: image.numpy()})[0].copy() for image in images],
        "ONNX Runtime": lambda: [session.run(None, {"x": image.numpy()})[0] for image in images],
        "torch.compile": side_by_side(compiled),
        "torch, batch norms folded": side_by_side(Forward(plainly_folded(net))),
        "torch": side_by_side(Forward(net)),
    }


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    net = load_weights(SHIPPED_WEIGHTS).eval()
    rng = np.random.default_rng(0)
    images = [torch.from_numpy(rng.integers(0, 255, (1, 4, 256, 256), dtype=np.uint8)) for _ in range(DRONES)]
    with tempfile.TemporaryDirectory() as folder:
        every = variants(net, images, Path(folder))
        first = {name: [np.asarray(result) for result in run()] for name, run in every.items()}
        times_s: dict[str, list[float]] = {name: [] for name in every}
        for _ in range(TURNS):
            for name, run in every.items():
                begin_s = time.perf_counter()
                run()
                times_s[name].append(time.perf_counter() - begin_s)
    ours = first["Sortie (folded, Winograd)"]
    print("| forward of five drones | fastest, ms | median, ms | largest difference |\n|---|---|---|---|")  # noqa: T201
    for name, results in first.items():
        off = max(float(np.abs(a - b).max()) for a, b in zip(results, ours, strict=True))
        print(f"| {name} | {1e3 * min(times_s[name]):.1f} | {1e3 * np.median(times_s[name]):.1f} | {off:.1g} |")  # noqa: T201


if __name__ == "__main__":
    main()
