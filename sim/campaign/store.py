"""A campaign's folder: one SQLite file with the plan and a row per finished run, and the Parquet table made of it.

    campaign.sqlite     the plan, and the rows; a row is committed before progress counts it
    runs/table.parquet  the rows of finished parts; written at the end and with every report

A part is a fixed stretch of runs. The table is a function of the rows alone, so an interruption leaves no trace in it.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa

from sortie.sim.campaign.plan import FORMAT, CampaignPlan
from sortie.sim.campaign.table import columns, row_of, write_table
from sortie.sim.campaign.work import RunResult
from sortie.sim.folders import RunError, ensure_place

FILE = "campaign.sqlite"
TIMEOUT_S = 60
"""How long a driver waits for a report that reads, and a report for a driver that writes."""
_DISK = {
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_BUSY,
}


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
            with _errors(folder):
                plan = _plan(self._db, folder)
                if plan is None:
                    raise RunError(f"{folder}: no campaign there ({FILE} is empty)")
                self._use(plan)
        except BaseException:
            self._db.close()
            raise

    def _use(self, plan: CampaignPlan) -> None:
        self.plan = plan
        self._schema = pa.schema(list(columns(plan).items()), {"sortie.campaign": plan.digest})
        self.parts = -(-plan.runs // plan.shard)

    def runs_of(self, part: int) -> range:
        """The runs of a part."""
        return range(part * self.plan.shard, min(self.plan.runs, (part + 1) * self.plan.shard))

    def part(self, part: int) -> pa.Table | None:
        """The rows of a part in the order of runs; None until all of them are there.

        Raises:
            RunError: one is broken.
        """
        runs = self.runs_of(part)
        rows = list(self._rows(runs.start, runs.stop))
        if len(rows) < len(runs):
            return None
        with _errors(self.folder):
            return pa.Table.from_pylist(rows, schema=self._schema)

    def row(self, run: int) -> dict[str, Any] | None:
        """One run's row; None where it has not been flown. Raises RunError where it is broken."""
        return next(self._rows(run, run + 1), None)

    def is_empty(self) -> bool:
        """Whether no run has a row yet."""
        with _errors(self.folder):
            return self._db.execute("SELECT run FROM rows LIMIT 1").fetchone() is None

    def count(self) -> tuple[int, int]:
        """How many runs have a row, and how many of these failed. Raises RunError where a row is broken."""
        rows = [row["status"] for row in self._rows(0, self.plan.runs)]
        return len(rows), rows.count("failed")

    def export(self) -> None:
        """Write the finished parts as a Parquet table.

        Raises:
            RunError: the disk refuses, or a row is broken.
        """
        with _errors(self.folder):
            write_table(self.folder, self.plan, filter(None, map(self.part, range(self.parts))))

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def _rows(self, start: int, stop: int) -> Iterator[dict[str, Any]]:
        """The rows of runs, in order."""
        ask = "SELECT row FROM rows WHERE run >= ? AND run < ? ORDER BY run"
        with _errors(self.folder):
            for (text,) in self._db.execute(ask, (start, stop)):
                yield dict(zip(self._schema.names, json.loads(text), strict=True))


class CampaignStore(CampaignTable):
    """The folder while a campaign runs.

    Raises:
        RunError: a folder that cannot be used, or that holds another campaign's results.
    """

    def __init__(
        self, folder: Path, plan: CampaignPlan, *, resume_only: bool = False, retry_failed: bool = False
    ) -> None:
        self.folder = folder
        self._use(plan)
        ensure_usable(folder, plan)
        if resume_only and not (folder / FILE).is_file():
            raise RunError(f"{folder}: no campaign there to resume ({FILE} is missing)")
        with _errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        self._db = sqlite3.connect(folder / FILE, timeout=TIMEOUT_S)  # makes no file before it is used
        try:
            self._open(retry_failed)
        except BaseException:
            self.close()
            raise

    def _open(self, retry_failed: bool) -> None:
        with _errors(self.folder):
            self._db.execute("PRAGMA synchronous = EXTRA")  # a committed row survives a power cut
            if _check_same(self._db, self.folder, self.plan):
                with self._db:
                    self._db.execute("BEGIN")
                    self._db.execute("CREATE TABLE plan (spec TEXT)")
                    self._db.execute("CREATE TABLE rows (run INTEGER PRIMARY KEY, row TEXT)")
                    self._db.execute("INSERT INTO plan VALUES (?)", (json.dumps(self.plan.spec),))
        self._done = bytearray(self.plan.runs)
        self.failed = 0
        """Runs on disk that failed."""
        with _errors(self.folder):
            for row in self._rows(0, self.plan.runs):
                failed = row["status"] == "failed"
                if not (failed and retry_failed):
                    self._done[row["run"]] = 1
                    self.failed += failed
        self.finished = sum(self._done)
        """Runs whose rows are on disk."""

    def is_done(self, part: int) -> bool:
        """Whether all rows of a part are on disk."""
        runs = self.runs_of(part)
        return self._done.find(0, runs.start, runs.stop) < 0

    def missing(self) -> Iterator[int]:
        """Runs that have no row yet, in order."""
        return (run for run in range(self.plan.runs) if not self._done[run])

    def add(self, results: Sequence[RunResult]) -> None:
        """Put rows on disk; a row that is there already stays.

        Raises:
            RunError: the disk refuses; none of these rows is kept, those added before are.
        """
        new = {r.run: r for r in results if not self._done[r.run]}  # a worker thought dead may answer after all
        with _errors(self.folder), self._db:
            for run, result in new.items():
                text = json.dumps(list(row_of(self.plan, self._schema, result).values()))
                self._db.execute("REPLACE INTO rows (run, row) VALUES (?, ?)", (run, text))
        for run, result in new.items():
            self._done[run] = 1
            self.failed += result.status == "failed"
        self.finished += len(new)

    def drop_after(self, part: int) -> None:
        """Remove what was flown beyond a part: the campaign has stopped there."""
        stop = self.runs_of(part).stop
        with _errors(self.folder), self._db:
            self._db.execute("DELETE FROM rows WHERE run >= ?", (stop,))
        self.failed = sum(row["status"] == "failed" for row in self._rows(0, stop))


def ensure_usable(folder: Path, plan: CampaignPlan) -> None:
    """Refuse a folder that a campaign cannot use, before a cluster is started for nothing.

    Raises:
        RunError: it cannot be written, or holds something else than this campaign.
    """
    if (folder / FILE).is_file():
        with _errors(folder), closing(sqlite3.connect(folder / FILE, timeout=TIMEOUT_S)) as db:
            _check_same(db, folder, plan)
        return
    ensure_place(folder)
    if folder.is_dir() and (names := sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))):
        raise RunError(f"{folder}: holds {names[0]} and no {FILE}; name another folder for the campaign")


def _check_same(db: sqlite3.Connection, folder: Path, plan: CampaignPlan) -> bool:
    """Refuse results of another campaign, or of other code; returns whether there are none yet."""
    old, spec = _plan(db, folder), json.loads(json.dumps(plan.spec))
    if old is None or old.digest == plan.digest:
        return old is None
    if {**old.spec, "code": 0} == {**spec, "code": 0}:
        raise RunError(f"{folder}: holds results of Sortie {old.code}, this is {plan.code}; name another folder")
    differs = next(key for key in {**spec, **old.spec} if old.spec.get(key) != spec.get(key))
    raise RunError(
        f"{folder}: holds results of another campaign, its {_name(old.spec, spec, differs)} differs; name another folder"
    )


def _name(old: Mapping[str, Any], new: Mapping[str, Any], key: str) -> str:
    """A specification's field that differs, named to its second level."""
    a, b = old.get(key), new.get(key)
    if isinstance(a, dict) and isinstance(b, dict):
        return f"{key}.{next(k for k in {**b, **a} if a.get(k) != b.get(k))}"
    return key


def _plan(db: sqlite3.Connection, folder: Path) -> CampaignPlan | None:
    """The plan that a file holds; None where a driver broke off before it wrote one."""
    if db.execute("SELECT count(*) FROM sqlite_master").fetchone() == (0,):
        return None
    (text,) = db.execute("SELECT spec FROM plan").fetchone()
    spec = json.loads(text)
    if spec["format"] != FORMAT:
        raise RunError(f"{folder}: holds results of format {spec['format']}, must be {FORMAT}; name another folder")
    return CampaignPlan(spec)


@contextmanager
def _errors(folder: Path) -> Iterator[None]:
    """What a disk or a broken file does, as one line."""
    try:
        yield
    except sqlite3.Error as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF not in _DISK:
            raise RunError(f"{folder / FILE}: is broken ({error}); remove it to fly the campaign again") from error
        raise _refused(folder, str(error)) from error
    except OSError as error:
        raise _refused(folder, error.strerror or str(error)) from error
    except RunError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise RunError(f"{folder / FILE}: is broken ({what}); remove it to fly the campaign again") from error


def _refused(folder: Path, reason: str) -> RunError:
    return RunError(
        f"{folder}: cannot be written: {reason}; what is finished is kept, the same command goes on once this is put right"
    )
