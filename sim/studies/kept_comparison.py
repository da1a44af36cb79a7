"""What a comparison to a given half-width has flown so far, in a SQLite file; a row is on disk before the next one is flown."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import NamedTuple

from sortie.policies.registry import resolve
from sortie.sim.folders import RunError, ensure_files
from sortie.sim.identity import codes_here, name_of, own_files
from sortie.sim.studies.compare import Compared, Contender, Gain
from sortie.sim.studies.multifidelity import (
    Batch,
    Flown,
    Precision,
    Report,
    Row,
    Settings,
    precision_of,
    results,
    run,
    with_detector,
)
from sortie.sim.user_errors import user_errors

FORMAT = 1


def identity(contenders: Sequence[Contender], pilot: int) -> str:
    """What is compared, as 16 hex digits: the version, the scenarios, the policies, the files of one's own and the pilot.

    The half-width is no part of it. A comparison can go on to a narrower one.

    Raises:
        RunError: a callable that cannot be told from another one by its name and its file.
    """
    parts = [FORMAT, *codes_here(), pilot]
    for label, scenario, function in contenders:
        if function is not None and not _is_known_by_name(function):
            raise RunError(
                f"policy {label}, in a comparison that is kept: must be a function at the top of a file, or a "
                "functools.partial of one with numbers and texts; name the file (mine.py:mine), or leave out kept"
            )
        name = None if function is None else name_of(function)
        parts += [label, name, scenario.model_dump_json(), sorted(own_files(scenario, function).items())]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def _is_known_by_name(policy: Callable[..., object]) -> bool:
    """Whether a callable's name and its file decide what it does."""
    values: list[object] = []
    while isinstance(policy, functools.partial):
        values += [*policy.args, *policy.keywords.values()]
        policy = policy.func
    if not inspect.isfunction(policy) or not all(v is None or isinstance(v, str | int | float) for v in values):
        return False
    return "<" not in policy.__code__.co_qualname and Path(policy.__code__.co_filename).is_file()


@contextmanager
def kept(path: Path, of: str) -> Iterator[tuple[Flown, sqlite3.Connection]]:
    """Everything that a file holds, and its connection for `keep`; the file is made where it is missing.

    Args:
        path: the file.
        of: the comparison's `identity`.

    Raises:
        RunError: it is no such file, or holds another comparison.
    """
    ensure_files(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with closing(sqlite3.connect(path, isolation_level=None)) as db:
            db.execute("PRAGMA synchronous = EXTRA")  # a committed row survives a power cut
            db.execute("BEGIN EXCLUSIVE")
            if {name for (name,) in db.execute("SELECT name FROM sqlite_master")} - {"comparison", "flown"}:
                raise RunError(f"{path}: no comparison there (it has other tables); name another file")
            db.execute("CREATE TABLE IF NOT EXISTS comparison (identity TEXT)")
            db.execute("CREATE TABLE IF NOT EXISTS flown (kind TEXT, content TEXT)")
            known = db.execute("SELECT identity FROM comparison").fetchone()
            if known is None:
                db.execute("INSERT INTO comparison VALUES (?)", (of,))
            elif known[0] != of:
                raise RunError(
                    f"{path}: holds a comparison of other policies, another scenario, seed or version; name another file"
                )
            db.execute("COMMIT")
            try:
                flown = _read(db)
            except (TypeError, ValueError) as error:
                raise RunError(f"{path}: a row is damaged ({error}); name another file") from error
            yield flown, db
    except sqlite3.OperationalError as error:
        raise RunError(f"{path}: {error}") from error
    except sqlite3.DatabaseError as error:
        raise RunError(f"{path}: no comparison there ({error}); name another file") from error


def _read(db: sqlite3.Connection) -> Flown:
    flown = Flown()
    for kind, content in db.execute("SELECT kind, content FROM flown ORDER BY rowid"):
        if kind == "plan":
            flown.plans.append(Batch(**json.loads(content)))
        else:
            flown.add(Row(**json.loads(content)))
    return flown


def keep(db: sqlite3.Connection, item: Row | Batch) -> None:
    """Write a row or a plan; on disk at the return."""
    kind = "plan" if isinstance(item, Batch) else "row"
    db.execute("INSERT INTO flown VALUES (?, ?)", (kind, json.dumps(item._asdict())))


class Answered(NamedTuple):
    """A comparison that reached its half-width, or used up its seeds."""

    sorties: tuple[Compared, ...]
    gains: tuple[Gain, ...]
    precision: Precision


def compare_to(
    contenders: Sequence[Contender], settings: Settings, path: Path | None, report: Report | None = None
) -> Answered:
    """Compare policies until the intervals of a metric are narrow enough.

    Args:
        contenders: two or more. Their scenario's detector answers; where it is the surrogate, the torch detector.
        path: keeps what is flown, so that the same call goes on after an interruption; None keeps nothing.
        report: called with a stage, the seeds flown in it and all its seeds.

    Raises:
        RunError: a detector that cannot answer, or a file that cannot be used.
        PolicyError: an unknown policy or parameter, before anything is flown.
    """
    named = contenders[0].scenario.perception.detector
    if named in ("none", "recorded"):
        raise RunError(f"perception.detector is {named}, must be torch or one of your own to compare to a half-width")
    if len(contenders) < 2:
        raise RunError("policies: one, must be two or more to compare to a half-width")
    for contender in contenders:
        if contender.function is None:
            resolve(contender.scenario.policy.name, contender.scenario.policy.params)
    detector = "torch" if named == "surrogate" else named
    answering = [with_detector(c, detector) for c in contenders]
    with user_errors(), ExitStack() as stack:
        flown = Flown()
        write: Callable[[Row | Batch], None] = _forget
        if path is not None:
            flown, db = stack.enter_context(kept(path, identity(answering, settings.pilot)))
            write = functools.partial(keep, db)
        run(answering, settings, flown, write, report or _silent)
    precision = precision_of(flown, [c.label for c in contenders[1:]], settings, detector)
    return Answered(*results(flown, answering), precision)


def _forget(item: Row | Batch) -> None:
    """Keeps nothing."""


def _silent(stage: str, done: int, of: float) -> None:
    """Reports nothing."""


def default_path(contenders: Sequence[Contender], pilot: int) -> Path:
    """Where the command keeps a comparison: another one has another file."""
    return Path("runs") / f"compare-{contenders[0].scenario.name}-{identity(contenders, pilot)[:8]}.sqlite"
