"""Consoles and progress bars that the commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

out = Console(emoji=False)  # `mine.py:link:` is a file's name
err = Console(stderr=True, highlight=False, emoji=False)


def line_printer(name: str) -> Callable[[str], None]:
    """Prints lines about a scenario as errors are printed, above a bar if one is shown."""
    return lambda words: err.print(f"{name}: {words}", soft_wrap=True, markup=False)


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
