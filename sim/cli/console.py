"""What the commands share: where they print, progress bars, and errors that are one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sortie.sim.folders import RunError

out = Console()
err = Console(stderr=True, highlight=False)
EXTRAS = {"matplotlib": "report", "SALib": "campaign", "threadpoolctl": "campaign", "cyclonedds": "dds"}
"""Which extra brings a library that not everybody needs."""


@contextmanager
def bars() -> Iterator[Callable[[str, float], Callable[[float], None]]]:
    """A progress display; gives a function that adds a bar and returns its updater. Silent without a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:

        def add(label: str, total: float) -> Callable[[float], None]:
            task = progress.add_task(label, total=round(total))
            return lambda done: progress.update(task, completed=round(done))

        yield add


@contextmanager
def stages(prefix: str = "") -> Iterator[Callable[[str, int, int], None]]:
    """A bar for every stage that reports (stage, done, of)."""
    with bars() as add:
        known: dict[str, Callable[[float], None]] = {}

        def report(stage: str, done: int, of: int) -> None:
            if stage not in known:
                known[stage] = add(prefix + stage, of)
            known[stage](done)

        yield report


@contextmanager
def user_errors() -> Iterator[None]:
    """A file, field or missing extra is the user's to mend: one line, no traceback."""
    try:
        yield
    except ImportError as error:
        name = (error.name or "").partition(".")[0]
        if name not in EXTRAS:
            raise
        raise RunError(f"{name} is missing: pip install 'sortie-sim[{EXTRAS[name]}]'") from error
    except OSError as error:
        where = "" if error.filename is None else f"{error.filename}: "
        raise RunError(f"{where}{error.strerror or error}") from error
    except ValueError as error:
        raise RunError(str(error)) from error
