"""A campaign's folder: what is finished stays, whatever happens to the driver.

    campaign.json            the specification; with the code version in it, its digest says whose results these are
    runs/part-00000.parquet  one row a run, in the order of runs; a part is written whole, renamed, and never touched again
    journal/00000.jsonl      rows of a part that is not finished: each line with its checksum, on disk before it counts

A part is a function of its rows, so the table does not tell how often, or where, a campaign was interrupted.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from scenarios.campaign import Choice, Column, Grid
from sim.campaign.plan import FORMAT, Plan
from sim.campaign.work import Result
from sim.folders import RunError, ensure_folder

MANIFEST, RUNS, JOURNAL, LOCK = "campaign.json", "runs", "journal", ".lock"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FIXED: dict[str, pa.DataType] = {
    "run": pa.int64(), "unit": pa.int64(), "cell": pa.int64(), "replication": pa.int64(), "policy": pa.string(),
    "seed": pa.int64(), "status": pa.string(), "error": pa.string(), "fingerprint": pa.string(), "key": pa.string(),
}  # fmt: skip
"""Columns that every table has; then one a varied field (its value) and one a metric (float, null without one)."""


class BrokenPartError(RunError):
    """A file of the table that is damaged, or not the part that its name says."""


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


def shards(plan: Plan) -> int:
    """Parts of the whole campaign."""
    return -(-plan.runs // plan.shard)


def runs_of(plan: Plan, shard: int) -> range:
    """The runs of a part."""
    return range(shard * plan.shard, min(plan.runs, (shard + 1) * plan.shard))


def part_file(folder: Path, shard: int) -> Path:
    """A part's file."""
    return folder / RUNS / f"part-{shard:05d}.parquet"


def journal_file(folder: Path, shard: int) -> Path:
    """The file of a part's rows until all of them are there."""
    return folder / JOURNAL / f"{shard:05d}.jsonl"


def read_part(folder: Path, plan: Plan, shard: int) -> pa.Table | None:
    """A finished part, read in full and held against the plan; None where there is no such file.

    Keys are held against the plan at the part's ends: each costs a millisecond or more, an hour for a million runs.

    Raises:
        BrokenPartError: it is damaged, or holds other runs.
        RunError: the disk does not give it.
    """
    path = part_file(folder, shard)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror}") from None
    try:  # on one thread: pyarrow's others may outlive what a damaged file raises, and abort the process
        table = pq.read_table(pa.BufferReader(data), page_checksum_verification=True, use_threads=False)
        table.validate(full=True)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _broken(path, f"cannot be read: {' '.join(str(error).split())[:120]}") from None
    runs = runs_of(plan, shard)
    if not table.schema.equals(_schema(plan), check_metadata=True):
        raise _broken(path, "its columns are not this campaign's")
    if table["run"].to_pylist() != list(runs):
        raise _broken(path, f"it must hold the runs {runs[0]} … {runs[-1]}")
    if any(table["key"][run - runs[0]].as_py() != plan.key(run) for run in (runs[0], runs[-1])):
        raise _broken(path, "its keys are not this campaign's")
    return table


def _broken(path: Path, why: str) -> BrokenPartError:
    return BrokenPartError(f"{path}: is broken ({why}); the campaign's command flies it again")


def _schema(plan: Plan) -> pa.Schema:
    return pa.schema(list(columns(plan).items()), {"sortie.campaign": plan.digest})


def find_in_journal(folder: Path, plan: Plan, run: int) -> Result | None:
    """A run's result, where its part is not finished; None where it has none."""
    try:
        results, _ = _read_lines(journal_file(folder, run // plan.shard))
    except FileNotFoundError:
        return None
    return next((r for r in results if r.run == run and r.key == plan.key(run)), None)


def row_of(plan: Plan, kinds: Mapping[str, pa.DataType], result: Result) -> dict[str, Any]:
    """A result's row of the table, whose columns are `kinds`."""
    at = plan.at(result.run)
    varied = {
        name: json.dumps(value) if kinds[name] == pa.string() and not isinstance(value, str) else value
        for name, value in plan.varied(at.cell).items()
    }
    return {
        **at._asdict(),
        "policy": plan.policies[at.policy],
        "seed": plan.seed(at.cell),
        "status": result.status,
        "error": result.error,
        "fingerprint": result.fingerprint,
        "key": result.key,
        **varied,
        **dict(zip(plan.campaign.metrics, result.values, strict=True)),
    }


class Store:
    """The folder while a campaign runs: rows go in, finished parts come out.

    Raises:
        RunError: a folder that cannot be used, that another driver uses, or that holds another campaign's results.
    """

    def __init__(self, folder: Path, plan: Plan, *, resume_only: bool = False, retry_failed: bool = False) -> None:
        self.folder, self.plan = folder, plan
        self._columns = columns(plan)
        self._journals: dict[int, Any] = {}
        ensure_usable(folder, plan)
        if resume_only and not (folder / MANIFEST).is_file():
            raise RunError(f"{folder}: no campaign there to resume ({MANIFEST} is missing)")
        with self._disk():
            for path in (folder / RUNS, folder / JOURNAL):
                path.mkdir(parents=True, exist_ok=True)
            self._lock = (folder / JOURNAL / LOCK).open("w")
        try:
            self._take(retry_failed)
        except BaseException:
            self._lock.close()
            raise

    def _take(self, retry_failed: bool) -> None:
        """Lock the folder and take up what is in it."""
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise RunError(f"{self.folder}: another driver is at work there") from None
        check_same(self.folder, self.plan)  # once more: another driver may have begun before the lock
        self._left = {shard: len(self.runs_of(shard)) for shard in range(self.shards)}
        self._known: dict[int, set[int]] = {}
        self._failed: dict[int, int] = {}
        self._again: dict[int, list[int]] = {}
        with self._disk():
            if not (self.folder / MANIFEST).is_file():
                text = json.dumps({"digest": self.plan.digest, "spec": self.plan.spec}, indent=1) + "\n"
                _write_durably(self.folder / MANIFEST, text.encode())
            self._recover(retry_failed)

    @contextmanager
    def _disk(self) -> Iterator[None]:
        """A disk that refuses is told in one line."""
        try:
            yield
        except OSError as error:
            when = " once there is room" if error.errno in FULL else ""
            raise RunError(
                f"{self.folder}: cannot be written: {error.strerror or error}; what is finished is kept, "
                f"the same command goes on{when}"
            ) from error

    # --- parts and what is in them -----------------------------------------------------------------

    @property
    def shards(self) -> int:
        """Parts of the whole campaign."""
        return shards(self.plan)

    def runs_of(self, shard: int) -> range:
        """The runs of a part."""
        return runs_of(self.plan, shard)

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
            if shard in self._again:
                yield from self._again[shard]
            elif not self.is_done(shard):
                known = self._known.get(shard, set())
                yield from (run for run in self.runs_of(shard) if run not in known)

    def add(self, results: Sequence[Result]) -> list[int]:
        """Put rows on disk; returns the parts that became complete by them.

        Raises:
            RunError: the disk refuses; what was added before stays.
        """
        by_shard: dict[int, list[Result]] = {}
        for result in results:
            by_shard.setdefault(result.run // self.plan.shard, []).append(result)
        complete = []
        with self._disk():
            for shard, found in by_shard.items():
                if self.is_done(shard):
                    continue  # a worker thought dead may answer after all
                if shard in self._again:
                    self._open_again(shard)
                known = self._known.setdefault(shard, set())
                rows = list({r.run: r for r in found if r.run not in known}.values())
                if not rows:
                    continue
                self._append(shard, rows)
                known.update(row.run for row in rows)
                self._left[shard] -= len(rows)
                self._failed[shard] = self._failed.get(shard, 0) + sum(row.status == "failed" for row in rows)
                if self.is_done(shard):
                    self._write_part(shard)
                    complete.append(shard)
        return complete

    def rows(self, shard: int) -> pa.Table:
        """A finished part."""
        table = read_part(self.folder, self.plan, shard)
        if table is None:
            raise RunError(f"{part_file(self.folder, shard)}: is gone; the same command flies it again")
        return table

    def drop_after(self, shard: int) -> None:
        """Forget what was flown beyond a part: the campaign has stopped there."""
        for beyond in range(shard + 1, self.shards):
            self._close_journal(beyond)
            self._failed.pop(beyond, None)
            for path in (journal_file(self.folder, beyond), part_file(self.folder, beyond)):
                path.unlink(missing_ok=True)

    def close(self) -> None:
        """Let the folder go."""
        for shard in list(self._journals):
            self._close_journal(shard)
        self._lock.close()

    # --- on disk -----------------------------------------------------------------------------------

    def _append(self, shard: int, rows: Sequence[Result]) -> None:
        """Rows into a journal, on disk at the return; where the disk refuses, none of them."""
        if shard not in self._journals:
            self._journals[shard] = journal_file(self.folder, shard).open("ab", buffering=0)
            _sync_folder(self.folder / JOURNAL)
        file = self._journals[shard]
        begin = os.fstat(file.fileno()).st_size
        try:
            left = memoryview(b"".join(map(_line, rows)))
            while left:  # a disk or quota that is nearly full takes a part of them, and that is no exception
                taken = file.write(left)
                if not taken:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                left = left[taken:]
            os.fsync(file.fileno())
        except OSError:
            os.truncate(file.fileno(), begin)  # a line after a torn one would not be read
            raise

    def _close_journal(self, shard: int) -> None:
        if shard in self._journals:
            self._journals.pop(shard).close()

    def _write_part(self, shard: int) -> None:
        results = {r.run: r for r in _read_lines(journal_file(self.folder, shard))[0]}
        rows = [row_of(self.plan, self._columns, results[run]) for run in self.runs_of(shard)]
        table = pa.table(
            {name: pa.array([row[name] for row in rows], kind) for name, kind in self._columns.items()}
        ).replace_schema_metadata({"sortie.campaign": self.plan.digest})
        partial = self.folder / RUNS / f".part-{shard:05d}.partial"
        pq.write_table(table, partial, compression="zstd", write_page_checksum=True)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(part_file(self.folder, shard))
        _sync_folder(self.folder / RUNS)
        self._close_journal(shard)
        journal_file(self.folder, shard).unlink(missing_ok=True)
        self._known.pop(shard, None)

    def _recover(self, retry_failed: bool) -> None:
        """Take up what an earlier driver left; a broken part, a torn line, or a row of another key counts as not flown.
        Files that are not named as the plan's own are left alone."""
        for path in (self.folder / RUNS).glob(".part-*.partial"):
            path.unlink()
        for shard in range(self.shards):
            if not self._recover_part(shard, retry_failed):
                self._recover_journal(shard, retry_failed)

    def _recover_part(self, shard: int, retry_failed: bool) -> bool:
        """Whether a part is whole; its failed runs are to be flown again where that is asked."""
        try:
            table = read_part(self.folder, self.plan, shard)
        except BrokenPartError:
            return False  # it stays until its runs are flown and take its place
        if table is None:
            return False
        failed = [
            run
            for run, ended in zip(self.runs_of(shard), table["status"].to_pylist(), strict=True)
            if ended == "failed"
        ]
        journal_file(self.folder, shard).unlink(missing_ok=True)
        if retry_failed and failed:
            self._again[shard], self._left[shard] = failed, len(failed)
        else:
            self._failed[shard], self._left[shard] = len(failed), 0
        return True

    def _recover_journal(self, shard: int, retry_failed: bool) -> None:
        path = journal_file(self.folder, shard)
        if not path.is_file():
            return
        results, good = _read_lines(path)
        os.truncate(path, good)
        kept = {r.run: r for r in results if r.run in self.runs_of(shard) and r.key == self.plan.key(r.run)}
        if retry_failed:
            kept = {run: r for run, r in kept.items() if r.status != "failed"}
        if len(kept) < len(results):  # anew, without the others
            _write_durably(path, b"".join(map(_line, kept.values())))
        self._known[shard] = set(kept)
        self._left[shard] -= len(kept)
        self._failed[shard] = sum(r.status == "failed" for r in kept.values())
        if self._left[shard] == 0:
            self._write_part(shard)

    def _open_again(self, shard: int) -> None:
        """A part back to a journal, without the rows that failed; at the first new row, so that until then it stands."""
        metrics = self.plan.campaign.metrics
        kept = [
            Result(
                row["run"], row["key"], row["status"], row["error"], row["fingerprint"], tuple(row[m] for m in metrics)
            )
            for row in self.rows(shard).to_pylist()
            if row["status"] != "failed"
        ]
        # a driver killed between these two finds the part whole, and the journal goes
        _write_durably(journal_file(self.folder, shard), b"".join(map(_line, kept)))
        part_file(self.folder, shard).unlink()
        _sync_folder(self.folder / RUNS)  # before a new row: a part that came back would take its place
        self._known[shard] = {result.run for result in kept}
        del self._again[shard]


def ensure_usable(folder: Path, plan: Plan) -> None:
    """Refuse a folder that a campaign cannot use, before a cluster is started for nothing.

    Raises:
        RunError: it cannot be written, or holds something else than this campaign.
    """
    if not _is_begun(folder):
        ensure_folder(folder, MANIFEST, "campaign")
    check_same(folder, plan)


def _is_begun(folder: Path) -> bool:
    """Whether a driver broke off there before it wrote the manifest: nothing but its own folders, and no rows."""
    own = {RUNS, JOURNAL, _partial(Path(MANIFEST)).name, f"{JOURNAL}/{LOCK}"}
    return folder.is_dir() and all(p.relative_to(folder).as_posix() in own for p in folder.rglob("*"))


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


def _read_lines(path: Path) -> tuple[list[Result], int]:
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


def _write_durably(path: Path, data: bytes) -> None:
    """A file whole or not at all, on disk at the return."""
    partial = _partial(path)
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    _sync_folder(path.parent)


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.partial")


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
