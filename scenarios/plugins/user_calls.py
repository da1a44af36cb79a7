"""Calls of a user's own code. Sortie calls it as it is; in a process of Sortie's own, each call may have a limit of time."""

from __future__ import annotations

import faulthandler
import functools
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple


class Source(NamedTuple):
    """Where a user's function comes from."""

    file: Path
    name: str
    names: Mapping[str, object]
    """All names of the file that it was loaded from."""


class ProgramExitError(Exception):
    """A user's code tried to end the program, which would look like a command that has done its work."""


class Guarded:
    """A user's function. It marks errors of the call as the user's, and is the place where a limit applies."""

    __wrapped__: Callable[..., Any]

    def __init__(self, function: Callable[..., Any], source: Source | None = None) -> None:
        functools.update_wrapper(self, function)
        self.source = source

    def __deepcopy__(self, memo: object) -> Guarded:
        """Itself, as Python has it for functions."""
        return self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The function's answer."""
        try:
            return self.__wrapped__(*args, **kwargs) if not _limit_s else self._within_limit(args, kwargs)
        except SystemExit as stop:
            raise ProgramExitError(f"exit code {stop.code}, must return").with_traceback(stop.__traceback__) from None

    def _within_limit(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        global _limit_s
        limit_s, _limit_s = _limit_s, 0.0  # a call within this one counts with it
        signal.setitimer(signal.ITIMER_REAL, limit_s)
        try:
            return self.__wrapped__(*args, **kwargs)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            _limit_s = limit_s


def guarded(function: Callable[..., Any]) -> Callable[..., Any]:
    """A user's function, guarded; parameters that a `partial` binds stay where they are."""
    if isinstance(function, functools.partial):
        return functools.partial(guarded(function.func), *function.args, **function.keywords)
    return function if isinstance(function, Guarded) else Guarded(function)


def is_guarded(function: Callable[..., Any]) -> bool:
    """Whether a function is a user's, with its parameters bound or not."""
    return isinstance(function.func if isinstance(function, functools.partial) else function, Guarded)


_limit_s = 0.0
"""Of each call of a user's code in this process; 0: none."""


def limit_calls(limit_s: float, place: BinaryIO) -> None:
    """From now on a call of a user's code that takes longer ends this process by SIGALRM, also within compiled code.

    Only for a process of Sortie's own (`sortie.sim.apart`): a debugger holds a call for longer than any limit.

    Args:
        limit_s: wall-clock time for one call; 0 is no limit.
        place: a file that gets the traceback of the call that was late.
    """
    global _limit_s
    _limit_s = limit_s
    faulthandler.register(signal.SIGALRM, file=place, all_threads=False, chain=True)
