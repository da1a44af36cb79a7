"""What somebody else changed in a campaign's folder is named, refused by readers, and put right by the driver and the report."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from campaign_examples import Pretended, plan, table_bytes
from typer.testing import CliRunner

import sortie
from sortie.sim.campaign.drive import run_campaign
from sortie.sim.campaign.plan import CampaignPlan
from sortie.sim.campaign.report import write_report
from sortie.sim.campaign.rows import read_rows
from sortie.sim.campaign.store import FILE
from sortie.sim.campaign.table import MANIFEST, TABLE
from sortie.sim.cli.app import app
from sortie.sim.folders import RunError


@pytest.fixture
def flown(tmp_path: Path) -> tuple[CampaignPlan, Path]:
    """A campaign and its folder, with all 48 rows."""
    p, folder = plan(tmp_path), tmp_path / "a"
    run_campaign(p, folder, Pretended())
    return p, folder


def rewritten(folder: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    path = folder / TABLE
    pq.write_table(change(pq.read_table(path)), path)


def put(table: pa.Table, column: str, row: int, value: object) -> pa.Table:
    """A table with another value in one place."""
    values = table[column].to_pylist()
    values[row] = value
    return table.set_column(table.column_names.index(column), column, pa.array(values, table.schema.field(column).type))


CHANGES: dict[str, Callable[[pa.Table], pa.Table]] = {
    "a value": lambda t: put(t, "energy_j.total", 7, 1.5),
    "a key": lambda t: put(t, "key", 7, t["key"][8].as_py()),
    "a column less": lambda t: t.drop_columns(["energy_j.total"]),
    "a column more": lambda t: t.append_column("mine", t["run"]),
    "a row less": lambda t: t.slice(1),
    "a row twice": lambda t: pa.concat_tables([t, t.slice(3, 1)]),
    "rows of some runs left out": lambda t: t.filter(pc.greater(t["run"], 5)),
    "written again": lambda t: t,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_table_that_was_changed_is_refused_and_written_anew(
    flown: tuple[CampaignPlan, Path], change: Callable[[pa.Table], pa.Table]
) -> None:
    p, folder = flown
    before = table_bytes(folder)
    had = hashlib.sha256(before["table.parquet"]).hexdigest()
    rewritten(folder, change)
    now = hashlib.sha256((folder / TABLE).read_bytes()).hexdigest()
    fault = f"{folder / TABLE}: was changed, its SHA-256 is {now[:12]}…, manifest.json has {had[:12]}…"
    with pytest.raises(RunError) as told:
        sortie.open_campaign(folder)
    assert str(told.value) == f"{fault}; `sortie campaign report {folder}` writes both anew"
    noticed: list[str] = []
    run_campaign(p, folder, Pretended(), notice=noticed.append)
    assert noticed == [f"{fault}; it is written anew from campaign.sqlite"]
    assert table_bytes(folder) == before
    rewritten(folder, change)
    noticed.clear()
    write_report(folder, noticed.append)
    assert noticed == [f"{fault}; it is written anew from campaign.sqlite"]
    assert table_bytes(folder) == before
    assert sortie.open_campaign(folder).rows.num_rows == 48


def test_a_file_of_somebody_else_is_named_and_not_read(flown: tuple[CampaignPlan, Path]) -> None:
    p, folder = flown
    rows = sortie.open_campaign(folder).rows
    pq.write_table(rows.slice(0, 5), folder / "runs" / "mine.parquet")
    line = (
        f"{folder}/runs/mine.parquet: not written by the campaign, and not read; only runs/table.parquet is its table"
    )
    with pytest.warns(UserWarning, match="mine") as warned:
        again = sortie.open_campaign(folder)
    assert [str(w.message) for w in warned] == [line]
    assert again.rows.equals(rows)
    assert (again.finished, again.failed, again.flown) == (48, 0, 0)
    (folder / "runs" / "thesis.tex").touch()
    (folder / "runs" / ".table.parquet.1234abcd.partial").touch()  # what a killed driver leaves is no foreign file
    noticed: list[str] = []
    run_campaign(p, folder, Pretended(), notice=noticed.append)
    assert noticed == [line.replace("mine.parquet", "mine.parquet and 1 more")]
    result = CliRunner().invoke(app, ["campaign", "report", str(folder)])
    assert (result.exit_code, result.stderr) == (0, noticed[0] + "\n")
    assert "48 of 48 runs" in (folder / "report.md").read_text()


def test_the_manifest_says_what_the_campaign_and_its_table_are(flown: tuple[CampaignPlan, Path]) -> None:
    p, folder = flown
    manifest = json.loads((folder / MANIFEST).read_text())
    table = pq.read_table(folder / TABLE)
    assert manifest == {
        "format": 2,
        "campaign": "small_ones",
        "plan": p.digest,
        "version": p.code,
        "runs": 48,
        "columns": {field.name: str(field.type) for field in table.schema},
        "files": {
            "runs/table.parquet": {"rows": 48, "sha256": hashlib.sha256((folder / TABLE).read_bytes()).hexdigest()}
        },
    }


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda m: "{", "is broken"),
        (lambda m: "[1]", "is broken"),
        (lambda m: "[" * 100_000, "is broken"),
        (lambda m: json.dumps({**m, "files": {TABLE: {"rows": "48", "sha256": ""}}}), "is broken"),
        (lambda m: json.dumps({**m, "files": {}}), "was changed, it must list runs/table.parquet alone"),
        (
            lambda m: json.dumps({**m, "files": {**m["files"], "runs/mine.parquet": m["files"][TABLE]}}),
            "was changed, it must list runs/table.parquet alone",
        ),
        (lambda m: json.dumps({**m, "runs": 49}), "was changed, its field 'runs' is not the campaign's"),
        (lambda m: json.dumps({**m, "mine": 1}), "was changed, its field 'mine' is not the campaign's"),
        (lambda m: json.dumps({**m, "columns": {}}), "was changed, its field 'columns' is not the campaign's"),
        (lambda m: None, "is missing, so runs/table.parquet cannot be checked"),
    ],
)
def test_a_manifest_that_was_changed_is_one_line(
    flown: tuple[CampaignPlan, Path], change: Callable[[dict[str, Any]], str | None], fault: str
) -> None:
    _, folder = flown
    path = folder / MANIFEST
    before = path.read_bytes()
    text = change(json.loads(before))
    if text is None:
        path.unlink()
    else:
        path.write_text(text)
    with pytest.raises(RunError) as told:
        sortie.open_campaign(folder)
    assert str(told.value) == f"{path}: {fault}; `sortie campaign report {folder}` writes both anew"
    assert CliRunner().invoke(app, ["campaign", "report", str(folder)]).exit_code == 0
    assert path.read_bytes() == before


def stored(folder: Path, p: CampaignPlan, run: int, text: str) -> None:
    """Put a row's text into the file, with the hash that belongs to it."""
    sha256 = hashlib.sha256(f"{p.digest} {run} {text}".encode()).hexdigest()
    with closing(sqlite3.connect(folder / FILE)) as db, db:
        assert db.execute("UPDATE rows SET row = ?, sha256 = ? WHERE run = ?", (text, sha256, run)).rowcount == 1


SHAPES: dict[str, Callable[[list[Any]], object]] = {
    "a value less": lambda row: row[:-1],
    "a value more": lambda row: [*row, 1.0],
    "text for a number": lambda row: [*row[:-1], "12"],
    "a truth for a number": lambda row: [*row[:-1], True],
    "no number": lambda row: [*row[:-1], float("nan")],
    "another status": lambda row: [*row[:6], "perhaps", *row[7:]],
    "another run": lambda row: [row[0] + 1, *row[1:]],
    "an object": lambda row: {"run": row[0]},
    "nothing": lambda row: None,
    "text": lambda row: "done",
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_a_row_of_a_wrong_shape_is_told_and_flown_again(
    flown: tuple[CampaignPlan, Path], shape: Callable[[list[Any]], object]
) -> None:
    """Its hash is right: whoever wrote it wrote that too."""
    p, folder = flown
    before = table_bytes(folder)
    with closing(sqlite3.connect(folder / FILE)) as db:
        row = json.loads(db.execute("SELECT row FROM rows WHERE run = 31").fetchone()[0])
    stored(folder, p, 31, json.dumps(shape(row)))
    with pytest.raises(RunError, match=r"campaign\.sqlite: the row of run 31 is broken; the campaign's command flies"):
        read_rows(folder)
    rest, noticed = Pretended(), list[str]()
    run_campaign(p, folder, rest, notice=noticed.append)
    assert rest.flown == [31]
    assert noticed == [f"{folder / FILE}: 1 broken rows are flown again: runs 31"]
    assert table_bytes(folder) == before


def test_of_many_broken_rows_some_are_named(flown: tuple[CampaignPlan, Path]) -> None:
    p, folder = flown
    with closing(sqlite3.connect(folder / FILE)) as db, db:
        db.execute("UPDATE rows SET row = 'x' WHERE run < 7")
    noticed: list[str] = []
    run_campaign(p, folder, Pretended(), notice=noticed.append)
    assert noticed == [f"{folder / FILE}: 7 broken rows are flown again: runs 0, 1, 2, 3, 4, …"]


@pytest.mark.parametrize("spec", ["[]", "7", "null", '{"format": 2}', '"text"', "[" * 100_000, "{"])
def test_a_plan_of_a_wrong_shape_is_one_line(flown: tuple[CampaignPlan, Path], spec: str) -> None:
    p, folder = flown
    with closing(sqlite3.connect(folder / FILE)) as db, db:
        db.execute("UPDATE plan SET spec = ?, digest = ?", (spec, CampaignPlan({"format": 2}).digest))
    for use in (lambda: run_campaign(p, folder, Pretended()), lambda: sortie.open_campaign(folder)):
        with pytest.raises(RunError) as told:
            use()
        text = str(told.value)
        assert text.startswith((f"{folder / FILE}: is broken (", f"{folder}: holds results of another campaign"))
        assert "\n" not in text
