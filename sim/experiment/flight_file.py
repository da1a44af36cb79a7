"""Flights kept in a SQLite file by their keys, for everybody who may need them again.

A row is valid while the files that the flight read hold what they held. Whoever plans writes; several who use one file wait for
each other by SQLite's own locks.
"""

from __future__ import annotations

import io
import json
import logging
import math
import os
import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from sortie.perception.metrics.ap import Matched
from sortie.sim.experiment.flight import MATCHED, Flight, Task
from sortie.sim.experiment.pools import Here, Pool
from sortie.sim.folders import RunError, ensure_files
from sortie.sim.identity import codes_here, content_digest
from sortie.sim.results.accuracy import FULL_SCENE, MISSION, Both
from sortie.sim.results.record import SortieRecord

Result = TypeVar("Result")
_LOG = logging.getLogger("sortie")
PLACE = "SORTIE_FLIGHTS"
"""The environment's variable that names another file than the one in the user's cache folder; empty keeps nothing."""
TIMEOUT_S = 60
"""How long one who reads or writes waits for another."""
_DISK = {
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_BUSY,
}
COLUMNS = "flights.error, flights.fingerprint, flights.figures, flights.matched, flights.key, flights.files"


def users_file() -> Path | None:
    """Where flights of `compare`, `rank` and `check` are kept; None where nothing is to be kept, or nothing can be."""
    named = os.environ.get(PLACE)
    if named is not None:
        return Path(named) if named else None
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sortie"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: nobody knows a home folder
        return None
    return folder / "flights.sqlite" if os.access(folder, os.W_OK) else None


class FlightFile:
    """A file of flights, for reading and writing; it is made with its first row.

    Raises:
        RunError: it cannot be used, or holds something else.
    """

    def __init__(self, path: Path, own: Collection[str] = ()) -> None:
        """Args: `own` are tables that may stand beside that of the flights."""
        self.path, self._own = path, own
        self._db: sqlite3.Connection | None = None
        ensure_files(path)
        if path.exists():
            self.db  # noqa: B018 - opens it, so that what is wrong comes before the flights

    @property
    def db(self) -> sqlite3.Connection:
        """The database, which has a table of flights."""
        if self._db is None:
            with self.errors():
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._db = sqlite3.connect(self.path, timeout=TIMEOUT_S)
                self._db.execute("PRAGMA synchronous = EXTRA")  # a committed row survives a power cut
                tables = {name for (name,) in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
                if others := sorted(tables - {"flights", *self._own}):
                    raise RunError(f"{self.path}: holds the table {others[0]} of somebody else; name another file")
                ensure_table(self._db)
        return self._db

    def close(self) -> None:
        """Close the file."""
        if self._db is not None:
            self._db.close()

    def find(self, task: Task) -> Flight | None:
        """A task's row, if it flew to the end, has all that is asked, and its files hold what they held."""
        if self._db is None:
            return None
        with self.errors():
            row = self._db.execute(f"SELECT {COLUMNS} FROM flights WHERE key = ?", (task.key,)).fetchone()  # noqa: S608
            flight = None if row is None else flight_of(row)
            if flight is None or flight.error or not set(task.figures) <= set(flight.values):
                return None
            return None if changed(flight.files) else flight

    def add(self, tasks_and_rows: Iterable[tuple[Task, Flight]]) -> None:
        """Put rows on disk; a failed flight does not take the place of another.

        Raises:
            RunError: the disk refuses; none of these rows is kept, those added before are.
        """
        with self.errors(), self.db:
            put(self.db, tasks_and_rows)

    def forget_other_code(self) -> None:
        """Remove what no flight of this version can use."""
        if self._db is None:
            return
        with self.errors(), self.db:
            self.db.execute("DELETE FROM flights WHERE code NOT IN (?, ?)", codes_here())

    @contextmanager
    def errors(self) -> Iterator[None]:
        """What a disk or a broken file does, as one line."""
        with errors(self.path):
            yield


def ensure_table(db: sqlite3.Connection, temp: str = "") -> None:
    """The table of flights is there."""
    db.execute(
        f"CREATE {temp}TABLE IF NOT EXISTS flights (key TEXT PRIMARY KEY, code TEXT, error TEXT, fingerprint TEXT, figures TEXT, "
        "matched BLOB, files TEXT)"
    )


def put(db: sqlite3.Connection, tasks_and_rows: Iterable[tuple[Task, Flight]]) -> None:
    """Write rows. A failed flight never takes the place of another, and what was known of a flight stays known."""
    for task, row in tasks_and_rows:
        values, files = dict(row.values), json.dumps(row.files)
        matched = values.pop(MATCHED, None)
        blob = None if matched is None else _packed(matched)
        old = db.execute("SELECT error, figures, matched, files FROM flights WHERE key = ?", (row.key,)).fetchone()
        if old is not None and not old[0]:
            if row.error:
                continue
            if old[3] == files:
                values, blob = {**json.loads(old[1]), **values}, blob or old[2]
        content = (row.key, task.code, row.error, row.fingerprint, json.dumps(values), blob, files)
        db.execute("REPLACE INTO flights VALUES (?, ?, ?, ?, ?, ?, ?)", content)


def flight_of(row: Sequence[Any]) -> Flight:
    """A row of the table, read as `COLUMNS`."""
    error, fingerprint, figures, blob, key, files = row
    values = json.loads(figures)
    if blob is not None:
        values[MATCHED] = _unpacked(blob)
    return Flight(error, fingerprint, values, key, json.loads(files))


def changed(files: Mapping[str, str]) -> list[str]:
    """The files that no longer hold what they held."""
    return [path for path, digest in files.items() if content_digest(path) != digest]


@contextmanager
def errors(path: Path) -> Iterator[None]:
    """What a disk or a broken file does, as one line that names it."""
    try:
        yield
    except sqlite3.Error as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF not in _DISK:
            raise broken(path, error) from error
        raise _refused(path, str(error)) from error
    except OSError as error:
        raise _refused(path, error.strerror or str(error)) from error
    except RunError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, EOFError, BadZipFile) as error:
        raise broken(path, f"{type(error).__name__}: {error}") from error


def broken(path: Path, what: object) -> RunError:
    """The error of a file that holds something else than it should."""
    return RunError(
        f"{path}: is broken ({' '.join(str(what).split())[:200]}); remove it to fly again, if it is Sortie's"
    )


def _refused(path: Path, reason: str) -> RunError:
    return RunError(
        f"{path}: cannot be written: {reason}; what is finished is kept, the same command goes on once this is put right"
    )


def _packed(draws: Sequence[Both]) -> bytes:
    """The matched fusions of each draw of the boxes, as arrays."""
    arrays: dict[str, Any] = {}
    for k, draw in enumerate(draws):
        for scope in (FULL_SCENE, MISSION):
            fusions = draw[scope]
            each = list(fusions.values())
            arrays[f"{k}.{scope}.fusion"] = np.array(
                [(t_s, drone, m.truths, len(m.score)) for (t_s, drone), m in zip(fusions, each, strict=True)]
            ).reshape(-1, 4)
            arrays[f"{k}.{scope}.score"] = np.concatenate([np.zeros(0), *(m.score for m in each)])
            arrays[f"{k}.{scope}.hit"] = np.concatenate([np.zeros(0, bool), *(m.hit for m in each)])
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _unpacked(blob: bytes) -> list[Both]:
    with np.load(io.BytesIO(blob), allow_pickle=False) as arrays:
        kept = dict(arrays)
    draws: list[Both] = []
    for k in range(len(kept) // 6):
        draw: Both = {}
        for scope in (FULL_SCENE, MISSION):
            fusion, score, hit = (kept[f"{k}.{scope}.{name}"] for name in ("fusion", "score", "hit"))
            ends = np.cumsum(fusion[:, 3]).astype(int).tolist()
            spans = zip(fusion.tolist(), [0, *ends], ends, strict=False)
            draw[scope] = {
                (t_s, int(drone)): Matched(score[a:b], hit[a:b], int(truths)) for (t_s, drone, truths, _), a, b in spans
            }
        draws.append(draw)
    return draws


def fly_all(
    tasks: Sequence[Task],
    pool: Pool | None = None,
    kept: Path | None = None,
    watch: Callable[[Task, float], None] = lambda task, t_s: None,
    keep: Callable[[Task, SortieRecord], None] = lambda task, record: None,
    *,
    failing: bool = False,
) -> list[Flight]:
    """The rows of tasks, in their order: those that a file has, and the others flown.

    Args:
        pool: flies them; None is this process, in which a flight's error is raised. Flights under a function fly here anyway.
        kept: the file of flights; None keeps nothing.
        watch: called with a task and the seconds of it that are flown, infinity where its row is there.
        keep: called with a task that has flown in this process, and its record.
        failing: what a flight in this process raises is its row, as in others.

    Raises:
        RunError: the file cannot be used.
    """
    numbered = [replace(task, number=k) for k, task in enumerate(tasks)]
    found: dict[int, Flight] = {}
    with _opened(kept) as file:
        if file is not None:
            for task in numbered:
                if task.is_kept and (row := file.find(task)) is not None:
                    found[task.number] = row
        groups = {task.group for task in numbered if task.group and task.number not in found}
        for number in [n for n in found if numbered[n].group in groups]:
            del found[number]  # the boxes of a group's flights depend on one another
        if found:
            _LOG.info("flights that were flown before are taken from %s", kept)
        for number in found:
            watch(numbered[number], math.inf)
        todo = [task for task in numbered if task.number not in found]
        own = [task for task in todo if pool is None or task.function is not None]
        others = [task for task in todo if pool is not None and task.function is None]
        for flies, its in ((Here(watch, keep, failing=failing), own), (pool, others)):
            for task, row in () if flies is None else _landing(flies, its, file):
                found[task.number] = row
                watch(task, math.inf)
    return [found[k] for k in range(len(tasks))]


class Forgiving:
    """A file of flights that nobody asked for: what is wrong with it is said once, and all flies without it."""

    def __init__(self, path: Path) -> None:
        self._file: FlightFile | None = None
        self._try(lambda: self._open(path))

    def _open(self, path: Path) -> None:
        self._file = FlightFile(path)
        self._file.forget_other_code()

    def find(self, task: Task) -> Flight | None:
        """As `FlightFile`."""
        return None if self._file is None else self._try(partial(self._file.find, task))

    def add(self, tasks_and_rows: Iterable[tuple[Task, Flight]]) -> None:
        """As `FlightFile`."""
        if self._file is not None:
            self._try(partial(self._file.add, tasks_and_rows))

    def close(self) -> None:
        """As `FlightFile`."""
        if self._file is not None:
            self._file.close()

    def _try(self, use: Callable[[], Result]) -> Result | None:
        try:
            return use()
        except RunError as error:
            _LOG.warning("%s; flights are not kept", error)
            self.close()
            self._file = None
            return None


@contextmanager
def _opened(kept: Path | None) -> Iterator[FlightFile | Forgiving | None]:
    """A file of flights; none where nothing is kept."""
    if kept is None:
        yield None
        return
    with closing(Forgiving(kept) if kept == users_file() else FlightFile(kept)) as file:
        yield file


def _landing(pool: Pool, tasks: Sequence[Task], file: FlightFile | Forgiving | None) -> Iterator[tuple[Task, Flight]]:
    """Tasks and their rows as they come; each is on disk before."""
    for landed in pool.rows(iter(tasks)):
        if file is not None:
            file.add((task, row) for task, row in landed if task.is_kept)
        yield from landed
