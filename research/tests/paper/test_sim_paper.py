"""`python -m research paper`: the plane's measures, the report's folder, the README, a frame in Rerun, the command."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from laboratory import command
from paper_examples import ELSEWHERE, FACTS, Made, papers_world
from rerun.chunk import RrdReader
from sim_examples import example

from research.paper import making as paper
from research.paper import plane_cost, report, rows
from research.paper.claims import OVERHEAD
from research.paper.measures import Elsewhere
from research.paper.picture import Picture
from research.paper.playback import SHADES, save_frame
from research.paper.results import TableSettings
from research.paper.sensitivity import Varied
from research.paper.ways import Ways
from sortie.perception.geometry import CELLS, FULL, Geometry
from sortie.perception.types import Boxes
from sortie.policies.registry import resolve
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError

# --- the plane -------------------------------------------------------------------------------------


def directives(*steps: tuple[float, int, str, float, str]) -> pa.Table:
    names = ("t_s", "peer", "representation", "rate_hz", "reason")
    return pa.Table.from_pylist([dict(zip(names, step, strict=True)) for step in steps])


def test_rungs_are_met_in_their_order_and_for_the_battery() -> None:
    down = [
        (1.0, 0, "features", 10.0, "battery ≥ 60 %"),
        (35.0, 0, "features", 5.0, "battery < 60 %"),
        (90.0, 0, "detections", 2.0, "battery < 30 %, track: ROI 32 m"),
    ]
    assert plane_cost.rungs_met(directives(*down)) == 3
    assert plane_cost.rungs_met(directives(down[0], down[2])) == 1
    assert plane_cost.rungs_met(directives(*reversed(down))) == 1
    assert plane_cost.rungs_met(directives(*down[:2], (60.0, 0, "detections", 2.0, "goodput 1.0 < 5 Mb/s"))) == 2


def test_the_link_drop_counts_until_the_last_link_has_no_features() -> None:
    steps = [
        (1.0, 0, "features", 10.0, ""),
        (1.0, 1, "features", 10.0, ""),
        (60.1, 0, "detections", 2.0, ""),
        (60.3, 1, "none", 0.0, ""),
        (70.0, 1, "features", 10.0, ""),
    ]
    assert plane_cost.without_features_s(directives(*steps), 60.0) == pytest.approx(0.3)
    assert np.isnan(plane_cost.without_features_s(directives(*steps[:3]), 60.0))
    assert plane_cost.without_features_s(directives((1.0, 0, "detections", 2.0, "")), 60.0) == 0.0


def test_rates_are_those_of_the_record() -> None:
    record = run_sortie(example())
    got = plane_cost.rates(record)
    assert got["descriptor_bytes"].value == 180
    assert got["counted_kb_per_s"].value == pytest.approx((4 * 180 * 10 + 80 * 36) / 1e3)
    sent = sum(record.tables["transmissions"]["payload_bytes"].to_pylist())
    assert got["data_mb_per_s"].value == pytest.approx(sent / 6 / 1e6)
    flown = sum(record.tables["descriptors"]["wire_bytes"].to_pylist()) + 36 * record.totals["directives"]
    assert got["context_kb_per_s"].value == pytest.approx(flown / 6 / 1e3)
    assert got["context_percent"].value == pytest.approx(100 * flown / sent)


def test_a_live_flight_answers_what_takes_real_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = tmp_path / "live.json"
    told.write_text(
        '{"drones": 4, "policy": "worked", "flown_s": 120.0, "machine": "a computer", "drones_cpu_percent": 11.4, '
        '"bench_cpu_percent": 4.6, "data_bytes_per_s": 18002300.0}'
    )
    monkeypatch.setattr(plane_cost.platform, "machine", lambda: "x86_64")
    found = plane_cost.measured_live(told)
    assert (found["ros2_core_percent"].value, found["x86_container_mb_per_s"].value) == (11.4, 18.0023)
    assert found["ros2_core_percent"].note == (
        "4 processes on Cyclone DDS, worked, 120 s, a computer; the bench took 5 %"
    )
    names = {c.measure.name for c in OVERHEAD if isinstance(c.measure, Elsewhere)}
    assert set(found) <= names
    monkeypatch.setattr(plane_cost.platform, "machine", lambda: "aarch64")
    assert set(plane_cost.measured_live(told)) == {"ros2_core_percent"}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"drones": 4}'])
def test_a_file_that_no_live_flight_wrote_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "live.json").write_text(text)
    with pytest.raises(ValueError, match=r"live\.json: not what sortie live --out writes$"):
        plane_cost.measured_live(tmp_path / "live.json")
    with pytest.raises(ValueError, match=r"gone\.json: No such file or directory$"):
        plane_cost.measured_live(tmp_path / "gone.json")


@pytest.mark.parametrize(("machine", "answers"), [("x86_64", True), ("AMD64", True), ("aarch64", False)])
def test_latency_is_of_a_tick_of_the_whole_fleet(machine: str, answers: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plane_cost.platform, "machine", lambda: machine)
    scenario, views = example(), []

    def watched(view):  # type: ignore[no-untyped-def]
        views.append(view)
        return []

    run_sortie(scenario, watched)
    got = plane_cost.latency(resolve("worked", {}), views, scenario)
    assert 0 < got["policy_ms_p50"].value <= got["policy_ms_p99"].value
    assert f"{len(views) // 5} ticks" in got["policy_ms_p50"].note
    assert got["deadline_over_p50"].value == pytest.approx(100 / got["policy_ms_p50"].value)
    assert got.get("x86_policy_ms_p50") == (got["policy_ms_p50"] if answers else None)
    assert set(got) <= {c.measure.name for c in OVERHEAD if isinstance(c.measure, Elsewhere)}


VARIED = [
    Varied("gain", i, "tau", t, 18.0, 16.0, 20.0, "reproduced") for i in ("zero", "masked") for t in ("0.1", "0.3")
]


# --- the report's folder ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result() -> paper.PaperResult:
    scores = {"zero": Made({}, papers_world), "masked": Made({}, papers_world)}
    return paper.PaperResult(rows.judge(scores, ELSEWHERE), rows.points(scores), VARIED, dict(FACTS), made_picture())


def made_picture() -> Picture:
    counts = np.zeros((CELLS, CELLS), np.int64)
    counts[40, 20], counts[10, 10] = 1, 4
    pose = np.array([(10.0 * i, 0.0, 0.0) for i in range(5)])
    cars = Boxes(np.array([[5.0, 6.0], [7.0, 8.0]]), np.array([[4.5, 1.8]] * 2), np.array([0.0, np.pi / 2]), np.ones(2))
    views = np.zeros((5, 5, 90, 160, 3), np.uint8)
    return Picture(
        "scene 7, frame 0",
        1,
        FULL,
        pose,
        pose,
        cars,
        cars.take(np.array([0])),
        (5.0, 6.0, 32.0),
        ((0.25, counts), (0.02, counts * 0)),
        views,
    )


def test_the_report_is_written_whole_and_an_older_one_replaced(
    result: paper.PaperResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "docs" / "paper"
    files = paper.write(result, out)
    assert [f.name for f in files] == sorted([paper.REPORT, paper.TABLE, paper.POINTS, paper.VARIED, *paper.FIGURES])
    assert rows.read(out / paper.TABLE) == (result.rows, result.facts)
    text = report.report(result.rows, result.facts, list(paper.FIGURES.items()), VARIED)
    assert (out / paper.REPORT).read_text() == text
    assert "**score threshold τ**, masked fusion:" in text
    monkeypatch.setattr(paper.figures, "available", lambda: False)  # drawing takes seconds
    paper.write(replace(result, facts={**result.facts, "seed": 5}), out)
    assert rows.read(out / paper.TABLE)[1]["seed"] == 5
    assert not (out / "forest.png").exists(), "nothing of the older report is left"
    assert [p.name for p in out.parent.iterdir()] == ["paper"]


def test_a_report_that_dies_while_it_is_written_leaves_the_older_one(
    result: paper.PaperResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "paper"
    monkeypatch.setattr(paper.figures, "available", lambda: False)
    paper.write(result, out)
    monkeypatch.setattr(paper.figures, "available", lambda: True)

    def dies(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(paper.figures, "save", dies)
    with pytest.raises(RunError, match="paper: cannot be written: No space left on device"):
        paper.write(replace(result, facts={**result.facts, "seed": 5}), out)
    assert rows.read(out / paper.TABLE)[1]["seed"] == FACTS["seed"]
    assert [p.name for p in tmp_path.iterdir()] == ["paper"]


def test_without_matplotlib_there_are_tables_alone(
    result: paper.PaperResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper.figures, "available", lambda: False)
    files = paper.write(result, tmp_path / "paper")
    assert [f.name for f in files] == sorted([paper.REPORT, paper.TABLE, paper.POINTS, paper.VARIED])
    assert "![" not in (tmp_path / "paper" / paper.REPORT).read_text()


def test_a_folder_that_is_no_report_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match=r"holds thesis\.tex, which no report wrote"):
        paper.ensure_writable(tmp_path)
    with pytest.raises(RunError, match=r"thesis\.tex: is a file, a report needs a folder"):
        paper.ensure_writable(tmp_path / "thesis.tex")
    report = tmp_path / "report"
    report.mkdir()
    for name in (paper.REPORT, paper.TABLE, paper.POINTS, paper.VARIED, *paper.FIGURES):
        (report / name).write_text("made")
    paper.ensure_writable(report)
    (report / "thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match=r"report: holds thesis\.tex, which no report wrote"):
        paper.ensure_writable(report)


def test_a_readme_without_the_markers_says_so(result: paper.PaperResult, tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("# Nothing\n")
    with pytest.raises(RunError, match=r"README\.md: must hold <!-- paper:begin --> and <!-- paper:end --> once each"):
        paper.put_into_readme(readme, result.rows, result.facts, "research/pages/paper/README.md")
    assert [p.name for p in tmp_path.iterdir()] == ["README.md"]


# --- a frame in Rerun ------------------------------------------------------------------------------


def test_a_frame_reads_back_from_its_recording(tmp_path: Path) -> None:
    save_frame(made_picture(), tmp_path / "frame.rrd")
    found = {}
    for chunk in RrdReader(tmp_path / "frame.rrd").stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.startswith(("Boxes3D", "Image", "Points3D", "LineStrips3D")):
                found[chunk.entity_path, name] = batch[name].to_pylist()[0]
    assert np.array(found["/world/truth", "Boxes3D:centers"])[:, :2].tolist() == [[5.0, 6.0], [7.0, 8.0]]
    assert len(found["/world/found", "Boxes3D:centers"]) == 1
    assert len(found["/world/drones", "Points3D:positions"]) == 5
    assert ("/world/mission", "LineStrips3D:strips") in found
    cells = np.array(found["/shared/budget_0.25/cells", "Boxes3D:centers"])
    # the ego stands at (10, 0) and looks east: row 40 is (40.5 − 32) · 3.2 m ahead, column 20 to its right
    assert cells[:, :2].tolist() == pytest.approx(
        np.array([[10 + 8.5 * 3.2, -11.5 * 3.2], [10 - 21.5 * 3.2, -21.5 * 3.2]])[::-1]
    )
    r, g, b, a = SHADES[4]
    assert found["/shared/budget_0.25/cells", "Boxes3D:colors"][0] == (r << 24 | g << 16 | b << 8 | a)
    assert {e for e, _ in found if e.startswith("/views/")} == {
        f"/views/drone_{d}/{c}" for d in range(5) for c in ("front", "left", "right", "back", "nadir")
    }
    assert [p.name for p in tmp_path.iterdir()] == ["frame.rrd"]


def test_a_frame_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"frame\.rrd: cannot be written"):
        save_frame(made_picture(), tmp_path / "file" / "frame.rrd")


# --- the command -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--unsent", "nothing"), "unsent is 'nothing', must be zero, masked or both"),
        (("--cells-by", "luck"), "cells_by is 'luck', must be confidence or norm"),
        (("--tau", "1.5"), "tau is 1.5, must be at least 0.01 and below 1"),
        (("--frames", "241"), "frames is 241, must be 1 to the test split's 240"),
        (("--frame", "240"), "frames is 241, must be 1 to the test split's 240"),
        (("--weights", "none.safetensors"), "none.safetensors: no such weights file"),
        (("--out", "file"), "file: is a file, a report needs a folder"),
    ],
)
def test_what_a_user_can_mend_is_one_line(
    arguments: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert command("paper", "--work", "work", *arguments) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("error: ")
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["file"], "nothing was made"


@pytest.mark.slow
def test_two_frames_from_nothing_to_a_report_and_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "R.md").write_text(f"# R\n{report.BEGIN}\n{report.END}\n")
    assert command("paper", "--frames", "2", "--work", "work", "--out", "out", "--readme", "R.md") == 0
    first, facts = rows.read(Path("out/paper.parquet"))
    assert {r.verdict for r in first} > {"reproduced", "not comparable", "not measurable here"}
    assert facts["command"] == "python -m research paper --frames 2"
    assert "[out/README.md](out/README.md)" in Path("R.md").read_text()
    printed = capsys.readouterr().out
    assert "Cooperation gains" in printed
    assert report.tally(r for r in first if r.instrument == "zero") in printed.replace("\n", " ").replace("  ", " ")
    assert (
        command("paper", "--frames", "2", "--work", "work", "--out", "again", "--workers", "1", "--against", "out") == 0
    )
    assert "of 112 verdicts are those of out (two tables of one truth differ in" in capsys.readouterr().out.replace(
        "\n", " "
    )
    again, _ = rows.read(Path("again/paper.parquet"))
    timed = {"plane.median", "plane.p99", "plane.deadline", "plane.x86.median"}
    assert [r for r in again if r.id not in timed] == [r for r in first if r.id not in timed]
    assert command("paper", "--frame", "1", "--work", "work", "--out", "out") == 0
    assert Path("work/frames/seed0_frame1_ego0.rrd").stat().st_size > 10_000


def test_a_frame_is_drawn_by_the_instrument_that_was_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[Any] = []
    sharp = SimpleNamespace(geometry=Geometry(image_px=512))
    drawn: list[Geometry] = []
    monkeypatch.setattr(paper, "bench_frames", lambda seed, count, root, geometry: drawn.append(geometry))
    monkeypatch.setattr(paper, "camera_views", lambda seed, frame, geometry: drawn.append(geometry))
    monkeypatch.setattr(
        paper.CarNetInstrument, "load", lambda path, device, fusion_params: seen.append(fusion_params) or sharp
    )
    monkeypatch.setattr(paper, "picture", lambda instrument, frames, f, **options: seen.append(options))
    settings = TableSettings(("zero",), "norm", 0.3, ways=Ways("zeros", "region_first"))
    job = paper.PaperSettings(tmp_path / "w", settings, fusion_params={"temperature": math.inf})
    paper.frame_picture(job, tmp_path, 0)
    params, options = seen
    assert drawn == [sharp.geometry] * 2, "frames and pictures as the network was trained on"
    assert params == {"temperature": math.inf}
    assert (options["tau"], options["cells_by"], options["ways"]) == (0.3, "norm", ("zeros", "region_first"))
