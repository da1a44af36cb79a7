"""A campaign's folder: what is finished stays, whatever happens to the driver.

    campaign.json            the specification; with the code version in it, its digest says whose results these are
    runs/part-00000.parquet  one row a run, in the order of runs; a part is written whole, renamed, and never touched again
    journal/00000.jsonl      rows of a part that is not finished: each line with its checksum, on disk before it counts

A part is a function of its rows, so the table does not tell how often, or where, a campaign was interrupted.
"""

from __future__ import annotations

import fcntl
import json
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from scenarios.campaign import Choice, Column, Grid
from sim.campaign.plan import FORMAT, Plan
from sim.campaign.work import Result
from sim.folders import RunError, ensure_folder, write_text

MANIFEST, RUNS, JOURNAL = "campaign.json", "runs", "journal"
FIXED: dict[str, pa.DataType] = {
    "run": pa.int64(), "unit": pa.int64(), "cell": pa.int64(), "replication": pa.int64(), "policy": pa.string(),
    "seed": pa.int64(), "status": pa.string(), "error": pa.string(), "fingerprint": pa.string(), "key": pa.string(),
}  # fmt: skip
"""Columns that every table has; then one a varied field (its value) and one a metric (float, null without one)."""


def read_plan(folder: Path) -> Plan:
    """The plan of a campaign's folder.

    Raises:
        RunError: there is none, or one of another format.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
        spec = manifest["spec"]
        if spec["format"] != FORMAT:
            raise RunError(f"{folder}: holds results of format {spec['format']}, must be {FORMAT}; name another folder")
        plan = Plan(spec)
        if plan.digest != manifest["digest"]:
            raise RunError(f"{folder / MANIFEST}: was changed by hand, its digest is another")
    except FileNotFoundError:
        raise RunError(f"{folder}: no campaign there ({MANIFEST} is missing)") from None
    except RunError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{folder / MANIFEST}: cannot be read: {error}") from None
    return plan


def columns(plan: Plan) -> dict[str, pa.DataType]:
    """The table's columns and their types."""
    found = dict(FIXED)
    for name, spread in plan.campaign.vary.items():
        values: Sequence[Any] = ()
        if isinstance(spread, Choice | Grid):
            values = spread.values
        elif isinstance(spread, Column):
            values = plan.spec["columns"][name]
        numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        found[name] = pa.float64() if numbers else pa.string()
    for name in plan.campaign.metrics:
        if name in found:
            raise RunError(f"metrics: {name}, is the name of another column")
        found[name] = pa.float64()
    return found


class Store:
    """The folder while a campaign runs: rows go in, finished parts come out.

    Raises:
        RunError: a folder that cannot be used, that another driver uses, or that holds another campaign's results.
    """

    def __init__(self, folder: Path, plan: Plan, *, resume_only: bool = False) -> None:
        self.folder, self.plan = folder, plan
        self._columns = columns(plan)
        self._journals: dict[int, Any] = {}
        ensure_folder(folder, MANIFEST, "campaign")
        check_same(folder, plan)
        if resume_only and not (folder / MANIFEST).is_file():
            raise RunError(f"{folder}: no campaign there to resume ({MANIFEST} is missing)")
        try:
            for path in (folder / RUNS, folder / JOURNAL):
                path.mkdir(parents=True, exist_ok=True)
            self._lock = (folder / JOURNAL / ".lock").open("w")
        except OSError as error:
            raise RunError(f"{folder}: cannot be written: {error.strerror}") from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._lock.close()
            raise RunError(f"{folder}: another driver is at work there") from None
        if not (folder / MANIFEST).is_file():
            text = json.dumps({"digest": plan.digest, "spec": plan.spec}, indent=1) + "\n"
            write_text(folder / MANIFEST, text)
        self._left = {shard: len(self.runs_of(shard)) for shard in range(self.shards)}
        self._known: dict[int, set[int]] = {}
        self._failed: dict[int, int] = {}
        self._recover()

    # --- parts and what is in them -----------------------------------------------------------------

    @property
    def shards(self) -> int:
        """Parts of the whole campaign."""
        return -(-self.plan.runs // self.plan.shard)

    def runs_of(self, shard: int) -> range:
        """The runs of a part."""
        size = self.plan.shard
        return range(shard * size, min(self.plan.runs, (shard + 1) * size))

    def is_done(self, shard: int) -> bool:
        """Whether a part is written."""
        return self._left[shard] == 0

    @property
    def finished(self) -> int:
        """Runs whose rows are on disk."""
        return self.plan.runs - sum(self._left.values())

    @property
    def failed(self) -> int:
        """Of those, the ones that failed."""
        return sum(self._failed.values())

    def missing(self, shards: Iterable[int] | None = None) -> Iterator[int]:
        """Runs that have no row yet, in order."""
        for shard in range(self.shards) if shards is None else shards:
            if not self.is_done(shard):
                known = self._known.get(shard, set())
                yield from (run for run in self.runs_of(shard) if run not in known)

    def add(self, results: Sequence[Result]) -> list[int]:
        """Put rows on disk; returns the parts that became complete by them.

        Raises:
            RunError: the disk refuses; what was added before stays.
        """
        by_shard: dict[int, list[Result]] = {}
        for result in results:
            shard = result.run // self.plan.shard
            known = self._known.setdefault(shard, set())
            if not self.is_done(shard) and result.run not in known:  # a worker thought dead may answer after all
                known.add(result.run)
                by_shard.setdefault(shard, []).append(result)
        complete = []
        try:
            for shard, rows in by_shard.items():
                self._append(shard, rows)
                self._left[shard] -= len(rows)
                self._failed[shard] = self._failed.get(shard, 0) + sum(row.status == "failed" for row in rows)
                if self.is_done(shard):
                    self._write_part(shard)
                    complete.append(shard)
        except OSError as error:
            raise RunError(
                f"{self.folder}: cannot be written: {error.strerror or error}; what is finished is kept, "
                "the same command goes on once there is room"
            ) from error
        return complete

    def rows(self, shard: int) -> pa.Table:
        """A finished part."""
        return pq.read_table(self.part(shard))

    def part(self, shard: int) -> Path:
        """A part's file."""
        return self.folder / RUNS / f"part-{shard:05d}.parquet"

    def drop_after(self, shard: int) -> None:
        """Forget what was flown beyond a part: the campaign has stopped there."""
        for beyond in range(shard + 1, self.shards):
            self._close_journal(beyond)
            self._failed.pop(beyond, None)
            for path in (self._journal(beyond), self.part(beyond)):
                path.unlink(missing_ok=True)

    def close(self) -> None:
        """Let the folder go."""
        for shard in list(self._journals):
            self._close_journal(shard)
        self._lock.close()

    # --- on disk -----------------------------------------------------------------------------------

    def _journal(self, shard: int) -> Path:
        return self.folder / JOURNAL / f"{shard:05d}.jsonl"

    def _append(self, shard: int, rows: Sequence[Result]) -> None:
        if shard not in self._journals:
            self._journals[shard] = self._journal(shard).open("ab", buffering=0)
        file = self._journals[shard]
        file.write(b"".join(_line(row) for row in rows))
        os.fsync(file.fileno())

    def _close_journal(self, shard: int) -> None:
        if shard in self._journals:
            self._journals.pop(shard).close()

    def _write_part(self, shard: int) -> None:
        results = {r.run: r for r in _read_journal(self._journal(shard))[0]}
        rows = [self._row(results[run]) for run in self.runs_of(shard)]
        table = pa.table(
            {name: pa.array([row[name] for row in rows], kind) for name, kind in self._columns.items()}
        ).replace_schema_metadata({"sortie.campaign": self.plan.digest})
        partial = self.folder / RUNS / f".part-{shard:05d}.partial"
        pq.write_table(table, partial, compression="zstd")
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(self.part(shard))
        _sync_folder(self.folder / RUNS)
        self._close_journal(shard)
        self._journal(shard).unlink(missing_ok=True)
        self._known.pop(shard, None)

    def _row(self, result: Result) -> dict[str, Any]:
        at = self.plan.at(result.run)
        varied = {
            name: json.dumps(value) if self._columns[name] == pa.string() and not isinstance(value, str) else value
            for name, value in self.plan.varied(at.cell).items()
        }
        return {
            **at._asdict(),
            "policy": self.plan.policies[at.policy],
            "seed": self.plan.seed(at.cell),
            "status": result.status,
            "error": result.error,
            "fingerprint": result.fingerprint,
            "key": result.key,
            **varied,
            **dict(zip(self.plan.campaign.metrics, result.values, strict=True)),
        }

    def _recover(self) -> None:
        """Take up what an earlier driver left; a torn line, or a row of another key, counts as not flown."""
        for path in (self.folder / RUNS).glob(".part-*.partial"):
            path.unlink()
        for shard in range(self.shards):
            statuses = self._statuses(shard) if self.part(shard).is_file() else None
            if statuses is not None:
                self._left[shard] = 0
                self._failed[shard] = statuses.count("failed")
                self._journal(shard).unlink(missing_ok=True)
        for path in sorted((self.folder / JOURNAL).glob("*.jsonl")):
            shard = int(path.stem)
            results, good = _read_journal(path)
            os.truncate(path, good)
            right = {r.run: r for r in results if r.run in self.runs_of(shard) and r.key == self.plan.key(r.run)}
            if len(right) < len(results):  # anew, without the others
                path.write_bytes(b"".join(map(_line, right.values())))
            self._known[shard] = set(right)
            self._left[shard] -= len(right)
            self._failed[shard] = sum(r.status == "failed" for r in right.values())
            if self._left[shard] == 0:
                self._write_part(shard)

    def _statuses(self, shard: int) -> list[str] | None:
        """How the runs of a part ended; None where it is no part of this campaign, or broken."""
        try:
            table = pq.read_table(self.part(shard), columns=["status"])
        except (OSError, pa.ArrowInvalid):
            return None
        if (table.schema.metadata or {}).get(b"sortie.campaign") != self.plan.digest.encode():
            return None
        return [str(status) for status in table["status"].to_pylist()]


def check_same(folder: Path, plan: Plan) -> None:
    """Refuse a folder that holds results of another campaign, or of other code; an empty one will do.

    Raises:
        RunError: what differs first.
    """
    if not (folder / MANIFEST).is_file():
        return
    old = read_plan(folder)
    if old.digest == plan.digest:
        return
    if {**old.spec, "code": 0} == {**json.loads(json.dumps(plan.spec)), "code": 0}:
        raise RunError(f"{folder}: holds results of Sortie {old.code}, this is {plan.code}; name another folder")
    differs = next(k for k in plan.spec if old.spec.get(k) != json.loads(json.dumps(plan.spec[k])))
    raise RunError(
        f"{folder}: holds results of another campaign, its {_what(old.spec, plan.spec, differs)} differs; name another folder"
    )


def _what(old: Mapping[str, Any], new: Mapping[str, Any], key: str) -> str:
    a, b = old.get(key), json.loads(json.dumps(new[key]))
    if isinstance(a, dict) and isinstance(b, dict):
        return f"{key}.{next(k for k in {**b, **a} if a.get(k) != b.get(k))}"
    return key


def _line(result: Result) -> bytes:
    text = json.dumps(result, separators=(",", ":")).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _read_journal(path: Path) -> tuple[list[Result], int]:
    """The rows up to the first line that is not whole, and how many bytes they take."""
    results: list[Result] = []
    good = 0
    with path.open("rb") as file:
        for line in file:
            checksum, _, text = line.rstrip(b"\n").partition(b" ")
            if not line.endswith(b"\n") or checksum != b"%08x" % zlib.crc32(text):
                break
            run, key, status, error, fingerprint, values = json.loads(text)
            results.append(Result(run, key, status, error, fingerprint, tuple(values)))
            good += len(line)
    return results, good


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
