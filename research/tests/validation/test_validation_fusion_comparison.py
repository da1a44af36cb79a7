"""The comparison of fusion methods, on one frame: every row is there, and methods that send nothing send no bytes."""

from __future__ import annotations

from pathlib import Path

from research.benchmark.dataset import Benchmark, load_frames, make_split
from research.validation import fusion_comparison
from sortie.perception.network.checkpoint import load_weights
from sortie.scenarios.shipped import NETWORKS


def test_one_frame_gives_every_row(tmp_path: Path) -> None:
    split = make_split(Benchmark(), "test", tmp_path, scenes=1, workers=1)
    rows = fusion_comparison.measure({"disconet": load_weights(NETWORKS / "disconet.safetensors")}, load_frames(split))
    assert [(r.method, r.received_budget) for r in rows] == [
        ("disconet", 1.0), ("disconet", 0.05), ("none", 0.0), ("late, nms", 0.0), ("late, average", 0.0),
    ]  # fmt: skip
    whole, starved, none, *late = rows
    assert whole.bytes_per_frame == 20 * 4096 * 160
    assert 0.05 < starved.bytes_per_frame / whole.bytes_per_frame < 0.06
    assert none.bytes_per_frame == 0
    assert all(0 < r.bytes_per_frame < 1e5 for r in late)
    assert fusion_comparison.table(rows).markdown().count("\n") == 6
