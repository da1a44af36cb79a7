"""Two policies in one recording: each is what it is alone, and the plots that they share have a line for each."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest
from rerun.chunk import RrdReader
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.playback.comparison import roots
from sortie.sim.playback.recording import save_comparison, save_rrd
from sortie.sim.results.record import SortieRecord


@pytest.fixture(scope="module")
def flown() -> list[tuple[str, SortieRecord]]:
    sparse = example("duration_s=3.5")
    return [("worked", run_sortie(sparse)), ("all-4(received_budget=0.1)", run_sortie(sparse, "all-4"))]


def columns(path: Path) -> dict[tuple[str, str], list[object]]:
    """(entity, component) → all values, in order of time."""
    found: dict[tuple[str, str], list[tuple[int, object]]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        stamps = batch["sim_time"].cast(pa.int64()).to_pylist() if "sim_time" in names else [-1] * batch.num_rows
        for name in names:
            if name not in ("rerun.controls.RowId", "sim_time", "frame"):
                values = found.setdefault((chunk.entity_path, name), [])
                values += [(t, v) for t, v in zip(stamps, batch[name].to_pylist(), strict=True) if v is not None]
    return {key: [v for _, v in sorted(values, key=lambda v: v[0])] for key, values in found.items()}


def test_each_policy_is_drawn_below_its_root_as_it_is_alone(
    flown: list[tuple[str, SortieRecord]], tmp_path: Path
) -> None:
    save_comparison(flown, tmp_path / "both.rrd")
    both = columns(tmp_path / "both.rrd")
    for root, (_, record) in zip(("worked", "all-4_received_budget_0_1"), flown, strict=True):
        save_rrd(record, tmp_path / "one.rrd")
        alone = {key: v for key, v in columns(tmp_path / "one.rrd").items() if not key[0].startswith("/__")}
        below = {(e.removeprefix(f"/{root}") or "/", c): v for (e, c), v in both.items() if e.startswith(f"/{root}")}
        assert repr(sorted(below.items())) == repr(sorted(alone.items()))  # by what is written: NaN is not itself
    traffic = [
        e for (e, c) in both if e.endswith("/plots/traffic/features_delivered") and c == "Scalars:scalars"
    ]  # fmt: skip
    assert len(traffic) == 2


def test_the_layout_has_a_scene_each_and_plots_with_a_line_each(
    flown: list[tuple[str, SortieRecord]], tmp_path: Path
) -> None:
    save_comparison(flown, tmp_path / "both.rrd")
    reader = RrdReader(tmp_path / "both.rrd")
    assert len(reader.recordings()) == 1
    batches = [k.to_record_batch() for k in reader.stream(store=reader.blueprints()[0]).to_chunks()]

    def all_of(name: str) -> list[str]:
        return [v for b in batches if name in b.schema.names for row in b[name].to_pylist() for v in row or ()]

    kinds = sorted(all_of("ViewBlueprint:class_identifier"))
    assert kinds == ["3D", "3D", "StateTimeline", "StateTimeline", "TextLog", "TextLog", *["TimeSeries"] * 4]
    shown = all_of("ViewContents:query")
    for entity in ("features_delivered", "p99_ms", "lost/percent", "busy_percent"):
        assert [q.split("/")[1] for q in shown if q.rstrip().endswith(entity)] == [
            "worked",
            "all-4_received_budget_0_1",
        ]


def test_labels_that_look_alike_have_roots_of_their_own() -> None:
    assert roots(["best-2(received_budget=0.1)", "best-2 received_budget 0.1", "silence", "§"]) == [
        "best-2_received_budget_0_1", "best-2_received_budget_0_1_1", "silence", "policy",
    ]  # fmt: skip
