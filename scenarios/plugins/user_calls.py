"""Calls of a user's own code: an error of such a call is told with its place, and a call can have a limit of time.

`Guarded` is the user's function as everything else calls it. Within `watched`, each call in the main thread has a limit of
wall-clock time, by the alarm of the operating system. A call in Python that is late raises `TookTooLongError`. Compiled
code cannot be interrupted: a process of Sortie's own (`limit_calls`) is killed there, after its place was printed.
"""

from __future__ import annotations

import faulthandler
import functools
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

DECISION_S = 10.0
"""The longest time for a decision where no scenario says otherwise."""
LOAD_S = 60.0
"""The longest time for a user's file to load."""
GRACE_S = 5.0
"""Compiled code is killed when it has used so much processor time, on each core, beyond its limit."""


class ProgramExitError(Exception):
    """A user's code tried to end the program."""


class TookTooLongError(Exception):
    """A call of a user's code that did not return within its limit."""


class _Late(BaseException):
    """Raised in a call that is late. An ordinary `except` in the user's code does not catch it."""


class Source(NamedTuple):
    """Where a user's function comes from."""

    file: Path
    name: str
    names: Mapping[str, object]
    """All names of the file that it was loaded from."""


class _Limit(NamedTuple):
    """Of every call within `watched`."""

    seconds: float
    words: str


class Guarded:
    """A user's function. It raises ProgramExitError in place of SystemExit, and TookTooLongError where it is late."""

    __wrapped__: Callable[..., Any]

    def __init__(self, function: Callable[..., Any], source: Source | None = None) -> None:
        functools.update_wrapper(self, function)
        self.source = source
        self._late = ""  # what it exceeded: it is not called again

    def __deepcopy__(self, memo: object) -> Guarded:
        """Itself, as Python has it for functions."""
        return self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The function's answer."""
        global _limit
        if self._late:
            raise TookTooLongError(self._late)
        limit = _limit if threading.current_thread() is threading.main_thread() else None
        try:
            if limit is None:
                return self.__wrapped__(*args, **kwargs)
            _limit = None  # a call within this one counts with it
            try:
                _set_alarms(limit.seconds)
                return self.__wrapped__(*args, **kwargs)
            finally:
                _set_alarms(0.0)
                _limit = limit
        except SystemExit as stop:
            raise ProgramExitError(f"exit code {stop.code}, must return").with_traceback(stop.__traceback__) from None
        except _Late as stop:
            self._late = f"no answer within {limit.words}" if limit else "no answer in time"
            raise TookTooLongError(self._late).with_traceback(stop.__traceback__) from None


def guarded(function: Callable[..., Any]) -> Callable[..., Any]:
    """A user's function, guarded; parameters that a `partial` binds stay where they are."""
    if isinstance(function, functools.partial):
        return functools.partial(guarded(function.func), *function.args, **function.keywords)
    return function if isinstance(function, Guarded) else Guarded(function)


def text_of(value: object, form: Callable[[Any], str] = repr) -> str:
    """A user's object as text. Its own code makes it; where that fails or is late, the text is the name of its type."""
    try:
        return str.__str__(guarded(form)(value))  # not a text of the user's own type
    except Exception:
        return f"a {type(value).__name__}"


def is_guarded(function: Callable[..., Any]) -> bool:
    """Whether a function is a user's, with its parameters bound or not."""
    return isinstance(function.func if isinstance(function, functools.partial) else function, Guarded)


def limit_calls() -> None:
    """Give calls the limits that they have by default, and let compiled code that does not return end this process.

    Libraries must not call this: a debugger holds a call for longer than any limit.
    """
    global _own_process
    _own_process = True


@contextmanager
def watched(limit_s: float, limit: str = "", *, always: bool = False) -> Iterator[None]:
    """Limit every guarded call of the main thread within the block; an outer block gives way to it.

    Nothing is limited in other threads, where the alarm is somebody else's, or where the process is not Sortie's own. A call
    may move to another working folder: the block's end moves back, so that paths of the command still mean the same.

    Args:
        limit_s: wall-clock time for one call.
        limit: the limit in words for errors, as "10 s (limits.decision_s)".
        always: limit calls of any process, as the user asked for it.
    """
    global _limit
    is_free = signal.getsignal(signal.SIGALRM) in (signal.SIG_DFL, _interrupt)
    if threading.current_thread() is not threading.main_thread() or not (_own_process or always) or not is_free:
        yield
        return
    outer, here = _limit, os.getcwd()
    before = signal.signal(signal.SIGALRM, _interrupt)
    _limit = _Limit(limit_s, limit or f"{limit_s:g} s")
    if _own_process:
        faulthandler.register(signal.SIGVTALRM, file=sys.__stderr__ or 2, chain=True)
    try:
        yield
    finally:
        _limit = outer
        signal.signal(signal.SIGALRM, before)
        os.chdir(here)


def _set_alarms(limit_s: float) -> None:
    """Ask for a signal when a call is late, and for the process's end when it cannot be interrupted; 0 asks for none."""
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    if _own_process:
        killed_s = (limit_s + GRACE_S) * (os.cpu_count() or 1) if limit_s else 0.0
        signal.setitimer(signal.ITIMER_VIRTUAL, killed_s)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise _Late


_own_process = False
_limit: _Limit | None = None
"""Of the next call in the main thread."""
