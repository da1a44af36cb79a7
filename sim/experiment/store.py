"""A campaign's folder: one SQLite file with the plan and the flights, and the Parquet table made of them.

    campaign.sqlite     the plan, the flights (`flight_file.py`), and which flight is which run's
    runs/table.parquet  the rows of finished parts; written at the end and with every report

A part is a fixed stretch of runs. The table is a function of the flights alone, so an interruption leaves no trace in it.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sortie.scenarios.replacing import replacing
from sortie.scenarios.schema.campaign import Choice, Column, Grid
from sortie.sim.experiment.flight import Flight, Task
from sortie.sim.experiment.flight_file import (
    COLUMNS,
    TIMEOUT_S,
    FlightFile,
    changed,
    ensure_table,
    errors,
    flight_of,
    put,
)
from sortie.sim.experiment.plan import FORMAT, CampaignPlan
from sortie.sim.folders import RunError, ensure_place

FILE = "campaign.sqlite"
TABLES = ("plan", "runs", "rows")
"""Beside the flights; `rows` is of older versions."""
TOGETHER = 500
"""Rows that are written at once where they are there already."""
TABLE = "runs/table.parquet"
FIXED: dict[str, pa.DataType] = {
    "run": pa.int64(),
    "unit": pa.int64(),
    "cell": pa.int64(),
    "replication": pa.int64(),
    "policy": pa.string(),
    "seed": pa.int64(),
    "status": pa.string(),
    "error": pa.string(),
    "fingerprint": pa.string(),
    "key": pa.string(),
}
"""Columns of every table. Each varied field (its value) and each metric (float, null without one) adds a column."""


def columns(plan: CampaignPlan) -> dict[str, pa.DataType]:
    """The table's columns and their types."""
    types = dict(FIXED)
    for name, spread in plan.campaign.vary.items():
        values: Sequence[Any] = ()
        if isinstance(spread, Choice | Grid):
            values = spread.values
        elif isinstance(spread, Column):
            values = plan.spec["columns"][name]
        numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        types[name] = pa.float64() if numbers else pa.string()
    for name in plan.campaign.metrics:
        if name in types:
            raise RunError(f"metrics: {name}, is the name of another column")
        types[name] = pa.float64()
    return types


def _stored(value: Any, kind: pa.DataType) -> Any:
    """A varied field's value as its column has it: what is no number and no text is JSON."""
    return json.dumps(value) if kind == pa.string() and not isinstance(value, str) else value


class CampaignTable:
    """The rows of a campaign's folder, for reading; a driver may write at the same time.

    Raises:
        RunError: no campaign there, or a file that is broken or of another format.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if not (folder / FILE).is_file():
            raise RunError(f"{folder}: no campaign there ({FILE} is missing)")
        self._db = sqlite3.connect(folder / FILE, timeout=TIMEOUT_S)
        try:
            with errors(folder / FILE):
                plan = _plan(self._db, folder)
                if plan is None:
                    raise RunError(f"{folder}: no campaign there ({FILE} is empty)")
                self._use(plan)
                _take_older(self._db, plan, temporary=True)
        except BaseException:
            self._db.close()
            raise

    def _use(self, plan: CampaignPlan) -> None:
        self.plan = plan
        self.schema = pa.schema(list(columns(plan).items()))
        self.parts = -(-plan.runs // plan.shard)

    def runs_of(self, part: int) -> range:
        """The runs of a part."""
        return range(part * self.plan.shard, min(self.plan.runs, (part + 1) * self.plan.shard))

    def part(self, part: int) -> pa.Table | None:
        """The rows of a part in the order of runs; None until all of them are there."""
        runs = self.runs_of(part)
        rows = list(self._rows(runs.start, runs.stop))
        if len(rows) < len(runs):
            return None
        with errors(self.folder / FILE):
            return pa.Table.from_pylist(rows, schema=self.schema)

    def row(self, run: int) -> dict[str, Any] | None:
        """One run's row; None where it has not been flown."""
        return next(self._rows(run, run + 1), None)

    def is_empty(self) -> bool:
        """Whether no run has a row yet."""
        with errors(self.folder / FILE):
            return self._db.execute("SELECT run FROM runs LIMIT 1").fetchone() is None

    def count(self) -> tuple[int, int]:
        """How many runs have a row, and how many of these failed."""
        ask = "SELECT count(*), total(error != '') FROM runs JOIN flights USING (key)"
        with errors(self.folder / FILE):
            rows, failed = self._db.execute(ask).fetchone()
        return rows, int(failed)

    def export(self) -> None:
        """Write the finished parts as a Parquet table.

        Raises:
            RunError: the disk refuses, or a row is broken.
        """
        how: dict[str, Any] = {"compression": "zstd", "write_page_checksum": True}
        with (
            errors(self.folder / FILE),
            replacing(self.folder / TABLE) as partial,
            pq.ParquetWriter(partial, self.schema, **how) as writer,
        ):
            for part in filter(None, map(self.part, range(self.parts))):
                writer.write_table(part)

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def _rows(self, start: int, stop: int) -> Iterator[dict[str, Any]]:
        """The rows of runs, in order, with the table's columns."""
        ask = f"SELECT run, {COLUMNS} FROM runs JOIN flights USING (key) WHERE run >= ? AND run < ? ORDER BY run"  # noqa: S608
        with errors(self.folder / FILE):
            for run, *columns in self._db.execute(ask, (start, stop)):
                yield self._row(run, flight_of(columns))

    def _row(self, run: int, flight: Flight) -> dict[str, Any]:
        at, plan = self.plan.at(run), self.plan
        varied = plan.varied(at.cell).items()
        return {
            **at._asdict(),
            "policy": plan.policies[at.policy],
            "seed": plan.seed(at.cell),
            "status": "failed" if flight.error else "done",
            "error": flight.error,
            "fingerprint": flight.fingerprint,
            "key": flight.key,
            **{name: _stored(value, self.schema.field(name).type) for name, value in varied},
            **{name: flight.values[name] for name in plan.campaign.metrics},
        }


class CampaignStore(CampaignTable):
    """The folder while a campaign runs. Flights that are there already, and whose files hold what they held, are not flown again.

    Raises:
        RunError: a folder that cannot be used.
    """

    def __init__(
        self, folder: Path, plan: CampaignPlan, *, resume_only: bool = False, retry_failed: bool = False
    ) -> None:
        self.folder = folder
        self._use(plan)
        ensure_usable(folder, plan)
        if resume_only and not (folder / FILE).is_file():
            raise RunError(f"{folder}: no campaign there to resume ({FILE} is missing)")
        self._file = FlightFile(folder / FILE, TABLES)
        self.said: list[str] = []
        """Lines on flights that are there and are not taken."""
        try:
            self._db = self._file.db
            self._open(retry_failed)
        except BaseException:
            self.close()
            raise

    def _open(self, retry_failed: bool) -> None:
        with errors(self.folder / FILE), self._db:
            old = _usable(self._db, self.folder, self.plan)
            if old is not None:
                _take_older(self._db, old, temporary=False)
            self._db.execute("CREATE TABLE IF NOT EXISTS plan (spec TEXT)")
            self._db.execute("CREATE TABLE IF NOT EXISTS runs (run INTEGER PRIMARY KEY, key TEXT)")
            self._forget_changed()
            if old is None or (changes := _differences(old.spec, self.plan.spec)):
                self._db.execute("DELETE FROM plan")
                self._db.execute("INSERT INTO plan (spec) VALUES (?)", (json.dumps(self.plan.spec),))
            if old is not None and (named := [name for name in changes if not name.startswith("files")]):
                self._db.execute("DELETE FROM runs")
                self.said.append(f"{self.folder}: its {named[0]} was another; flights that fit are not flown again")
        self._done = bytearray(self.plan.runs)
        self.failed = 0
        """Runs on disk that failed."""
        ask = "SELECT run, error != '' FROM runs JOIN flights USING (key)"
        with errors(self.folder / FILE):
            for run, failed in self._db.execute(ask):
                if not (failed and retry_failed):
                    self._done[run] = 1
                    self.failed += failed
        self.finished = sum(self._done)
        """Runs whose rows are on disk."""

    def _forget_changed(self) -> None:
        """Flights whose files have changed since are flown again."""
        for (files,) in self._db.execute("SELECT DISTINCT files FROM flights").fetchall():
            digests: dict[str, str] = json.loads(files)
            if not (others := changed(digests)):
                continue
            if gone := [path for path in others if digests[path] and not Path(path).is_file()]:
                raise RunError(f"{gone[0]}: is gone, and flights in {self.folder} have read it; put it back first")
            keys = "SELECT key FROM flights WHERE files = ?"
            self._db.execute(f"DELETE FROM runs WHERE key IN ({keys})", (files,))  # noqa: S608
            count = self._db.execute("DELETE FROM flights WHERE files = ?", (files,)).rowcount
            self.said.append(f"{self.folder}: {others[0]} has changed since; {count} flights with it are flown again")

    def is_done(self, part: int) -> bool:
        """Whether all rows of a part are on disk."""
        runs = self.runs_of(part)
        return self._done.find(0, runs.start, runs.stop) < 0

    def missing(self, stop: int) -> Iterator[Task]:
        """Runs before `stop` that have no row yet, in order; one that was flown under another plan gets its row now."""
        with errors(self.folder / FILE):
            others = self._db.execute("SELECT count(*) FROM flights").fetchone()[0] > self.finished
        there: list[tuple[Task, Flight]] = []
        for run in range(stop):
            if self._done[run]:
                continue
            task = self.plan.task(run)
            if others and (row := self._file.find(task)) is not None:
                there.append((task, row))
            else:
                yield task
            if len(there) == TOGETHER:
                self.add(there)
                there = []
        self.add(there)

    def add(self, landed: Sequence[tuple[Task, Flight]]) -> None:
        """Put rows on disk; a row that is there already stays.

        Raises:
            RunError: the disk refuses; none of these rows is kept, those added before are.
        """
        new = {task.number: (task, row) for task, row in landed if not self._done[task.number]}
        with errors(self.folder / FILE), self._db:
            put(self._db, new.values())
            pairs = [(run, row.key) for run, (_, row) in new.items()]
            self._db.executemany("REPLACE INTO runs VALUES (?, ?)", pairs)
        for run, (_, row) in new.items():
            self._done[run] = 1
            self.failed += bool(row.error)
        self.finished += len(new)

    def drop_after(self, part: int) -> None:
        """Remove what was flown beyond a part: the campaign has stopped there."""
        stop = self.runs_of(part).stop
        with errors(self.folder / FILE), self._db:
            self._db.execute("DELETE FROM runs WHERE run >= ?", (stop,))
        ask = "SELECT count(*) FROM runs JOIN flights USING (key) WHERE error != ''"
        self.failed = self._db.execute(ask).fetchone()[0]

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def ensure_usable(folder: Path, plan: CampaignPlan) -> None:
    """Refuse a folder that a campaign cannot use, before a cluster is started for nothing.

    Raises:
        RunError: it cannot be written, or holds something else, or flights of other code.
    """
    if (folder / FILE).is_file():
        with errors(folder / FILE), closing(sqlite3.connect(folder / FILE, timeout=TIMEOUT_S)) as db:
            _usable(db, folder, plan)
        return
    ensure_place(folder)
    if folder.is_dir() and (names := sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))):
        raise RunError(f"{folder}: holds {names[0]} and no {FILE}; name another folder for the campaign")


def _usable(db: sqlite3.Connection, folder: Path, plan: CampaignPlan) -> CampaignPlan | None:
    """The plan that a file holds; a campaign never mixes flights of two versions."""
    old = _plan(db, folder)
    if old is not None and old.code != plan.code:
        raise RunError(f"{folder}: holds results of Sortie {old.code}, this is {plan.code}; name another folder")
    return old


def _differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """The fields of two specifications that differ, named to their second level."""
    new, found = json.loads(json.dumps(new)), []
    for key in {**new, **old}:
        a, b = old.get(key), new.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            found += [f"{key}.{name}" for name in {**b, **a} if a.get(name) != b.get(name)]
        elif a != b:
            found.append(key)
    return found


def _plan(db: sqlite3.Connection, folder: Path) -> CampaignPlan | None:
    """The plan that a file holds; None where a driver broke off before it wrote one."""
    if db.execute("SELECT count(*) FROM sqlite_master WHERE name = 'plan'").fetchone() == (0,):
        return None
    row = db.execute("SELECT spec FROM plan").fetchone()
    if row is None:
        return None
    spec = json.loads(row[0])
    if spec["format"] != FORMAT:
        raise RunError(f"{folder}: holds results of format {spec['format']}, must be {FORMAT}; name another folder")
    return CampaignPlan(spec)


def _take_older(db: sqlite3.Connection, plan: CampaignPlan, *, temporary: bool) -> None:
    """Take the rows of a folder of before flights had a table of their own; `temporary` for this reader alone."""
    tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master")}
    if "rows" not in tables or "runs" in tables:
        return
    temp = "TEMP " * temporary
    ensure_table(db, temp)
    db.execute(f"CREATE {temp}TABLE runs (run INTEGER PRIMARY KEY, key TEXT)")
    names = list(columns(plan))
    for run, text in db.execute("SELECT run, row FROM rows").fetchall():
        row = dict(zip(names, json.loads(text), strict=True))
        values = json.dumps({name: row[name] for name in plan.campaign.metrics})
        content = (row["key"], plan.code, row["error"], row["fingerprint"], values, None, "{}")
        db.execute("REPLACE INTO flights VALUES (?, ?, ?, ?, ?, ?, ?)", content)
        db.execute("INSERT INTO runs VALUES (?, ?)", (run, row["key"]))
