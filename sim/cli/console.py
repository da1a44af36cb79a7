"""Consoles and progress bars that the commands share."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from time import perf_counter
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from sortie.sim.folders import RunError
from sortie.sim.terminal import Terminal

EVERY_S = 60.0
"""Between two lines about one thing, where there is no terminal."""

out = Terminal()
err = Terminal(stderr=True, highlight=False)


def print_written(before: str, path: object, after: str = "") -> None:
    """Print where something was written, or what was made: the path or name in bold, between two texts."""
    out.print(Text.assemble(f"{before} ", (str(path), "bold"), after), soft_wrap=True)


def print_failure(text: str) -> None:
    """Print a line that says what did not hold or was not found."""
    err.print(text, style="red", soft_wrap=True)


def print_error(error: object) -> None:
    """Print an error that ends a command."""
    err.print(Text.assemble(("error:", "red"), f" {error}"), soft_wrap=True)


class _Stream(io.RawIOBase):
    """A standard stream of this process. What cannot be written is an error of the user, once."""

    def __init__(self, stream: io.TextIOWrapper | None, name: str) -> None:
        self._stream, self._name, self._works = stream, name, True

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return self._stream is not None and self._stream.isatty()

    def fileno(self) -> int:
        if self._stream is None:
            raise OSError("it was closed")
        return self._stream.fileno()

    def write(self, data: Any) -> int:
        """Raises RunError at the first failure; after it, and on the error output, nothing can be told any more."""
        try:
            if self._works:
                return os.write(self.fileno(), data)
        except OSError as error:
            self._works = False
            if self._name:
                raise RunError(f"{self._name}: {error.strerror or error}; not everything was printed") from None
        return len(data)


def own_streams() -> None:
    """Have output that is full or closed end the command with one line. Only for a process of Sortie's own."""
    for name, words in (("stdout", "standard output"), ("stderr", "")):
        stream = getattr(sys, name)
        if stream is None or type(stream) is io.TextIOWrapper:  # not what a test puts there
            encoding, by_line = (None, False) if stream is None else (stream.encoding, stream.line_buffering)
            text = io.BufferedWriter(_Stream(stream, words))
            # what a terminal cannot show stops no command
            setattr(sys, name, io.TextIOWrapper(text, encoding, "backslashreplace", line_buffering=by_line))


def line_printer(name: str) -> Callable[[str], None]:
    """Prints lines about a scenario as errors are printed, above a bar if one is shown."""
    return lambda words: err.print(f"{name}: {words}", soft_wrap=True)


def line_a_minute(
    label: str, total: float, *, say: Callable[[str], None], clock: Callable[[], float] = perf_counter
) -> Callable[[float], None]:
    """An updater that says how far something is, once a minute of wall-clock time."""
    said_s = clock()

    def update(done: float) -> None:
        nonlocal said_s
        if clock() - said_s >= EVERY_S:
            said_s = clock()
            say(_how_far(label, done, total))

    return update


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


def line_in_notebook(label: str, total: float) -> Callable[[float], None]:
    """An updater that renews one line below the cell."""
    from IPython.display import display

    def text(done: float) -> dict[str, str]:
        return {"text/plain": _how_far(label, done, total)}

    line = display(text(0.0), raw=True, display_id=True)  # type: ignore[no-untyped-call]
    return lambda done: line.update(text(done), raw=True)


def _how_far(label: str, done: float, total: float) -> str:
    return f"{label}: {done:,.0f} of {total:,.0f}"


@contextmanager
def bars() -> Iterator[Callable[[str, float], Callable[[float], None]]]:
    """A progress display; gives a function that adds a bar and returns its updater.

    Without a terminal, a line on the error output once a minute says how far each is; in a notebook, a line that is renewed.
    """
    if not err.is_terminal:
        yield line_in_notebook if in_notebook() else partial(line_a_minute, say=partial(err.print, soft_wrap=True))
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True) as progress:

        def add(label: str, total: float) -> Callable[[float], None]:
            task = progress.add_task(label, total=round(total))
            return lambda done: progress.update(task, completed=round(done))

        from sortie.scenarios.compiled import when_compiling  # numba takes a second to import

        note = "compiling loops, which later runs reuse: a minute or so"
        with when_compiling(lambda: progress.console.print(note)):
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
