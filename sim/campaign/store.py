"""A campaign's folder while it runs: what is finished stays, whatever happens to the driver. `parts.py` has the files."""

from __future__ import annotations

import errno
import fcntl
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sortie.sim.campaign.parts import (
    JOURNAL,
    MANIFEST,
    RUNS,
    BrokenPartError,
    check_same,
    columns,
    journal_file,
    line_of,
    part_file,
    read_lines,
    read_part,
    row_of,
    runs_of,
    schema_of,
    shards,
)
from sortie.sim.campaign.plan import CampaignPlan
from sortie.sim.campaign.work import RunResult
from sortie.sim.folders import RunError, ensure_folder, partial_file, sync_folder, write_durably

LOCK = ".lock"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class CampaignStore:
    """The folder while a campaign runs: rows go in, finished parts come out.

    Raises:
        RunError: a folder that cannot be used, that another driver uses, or that holds another campaign's results.
    """

    def __init__(
        self, folder: Path, plan: CampaignPlan, *, resume_only: bool = False, retry_failed: bool = False
    ) -> None:
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
                write_durably(self.folder / MANIFEST, text.encode())
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

    def add(self, results: Sequence[RunResult]) -> list[int]:
        """Put rows on disk; returns the parts that became complete by them.

        Raises:
            RunError: the disk refuses; what was added before stays.
        """
        by_shard: dict[int, list[RunResult]] = {}
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

    def _append(self, shard: int, rows: Sequence[RunResult]) -> None:
        """Rows into a journal, on disk at the return; where the disk refuses, none of them."""
        if shard not in self._journals:
            self._journals[shard] = journal_file(self.folder, shard).open("ab", buffering=0)
            sync_folder(self.folder / JOURNAL)
        file = self._journals[shard]
        begin = os.fstat(file.fileno()).st_size
        try:
            left = memoryview(b"".join(map(line_of, rows)))
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
        results = {r.run: r for r in read_lines(journal_file(self.folder, shard))[0]}
        rows = [row_of(self.plan, self._columns, results[run]) for run in self.runs_of(shard)]
        table = pa.Table.from_pylist(rows, schema=schema_of(self.plan))
        file = pa.BufferOutputStream()
        pq.write_table(table, file, compression="zstd", write_page_checksum=True)
        write_durably(part_file(self.folder, shard), file.getvalue().to_pybytes())
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
        results, good = read_lines(path)
        os.truncate(path, good)
        kept = {r.run: r for r in results if r.run in self.runs_of(shard) and r.key == self.plan.key(r.run)}
        if retry_failed:
            kept = {run: r for run, r in kept.items() if r.status != "failed"}
        if len(kept) < len(results):  # anew, without the others
            write_durably(path, b"".join(map(line_of, kept.values())))
        self._known[shard] = set(kept)
        self._left[shard] -= len(kept)
        self._failed[shard] = sum(r.status == "failed" for r in kept.values())
        if self._left[shard] == 0:
            self._write_part(shard)

    def _open_again(self, shard: int) -> None:
        """A part back to a journal, without the rows that failed; at the first new row, so that until then it stands."""
        metrics = self.plan.campaign.metrics
        kept = [
            RunResult(
                row["run"], row["key"], row["status"], row["error"], row["fingerprint"], tuple(row[m] for m in metrics)
            )
            for row in self.rows(shard).to_pylist()
            if row["status"] != "failed"
        ]
        # a driver killed between these two finds the part whole, and the journal goes
        write_durably(journal_file(self.folder, shard), b"".join(map(line_of, kept)))
        part_file(self.folder, shard).unlink()
        sync_folder(self.folder / RUNS)  # before a new row: a part that came back would take its place
        self._known[shard] = {result.run for result in kept}
        del self._again[shard]


def ensure_usable(folder: Path, plan: CampaignPlan) -> None:
    """Refuse a folder that a campaign cannot use, before a cluster is started for nothing.

    Raises:
        RunError: it cannot be written, or holds something else than this campaign.
    """
    if not _is_begun(folder):
        ensure_folder(folder, MANIFEST, "campaign")
    check_same(folder, plan)


def _is_begun(folder: Path) -> bool:
    """Whether a driver broke off there before it wrote the manifest: nothing but its own folders, and no rows."""
    own = {RUNS, JOURNAL, partial_file(Path(MANIFEST)).name, f"{JOURNAL}/{LOCK}"}
    return folder.is_dir() and all(p.relative_to(folder).as_posix() in own for p in folder.rglob("*"))
