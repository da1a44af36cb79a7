"""Calls of a user's own code: one that ends the program, or that takes too long, is an error of that call alone.

`Guarded` is the user's function as everything else calls it. Within `watched`, each of its calls has a limit of
wall-clock time. A thread counts the time, and interrupts a call that is late. Python code cannot be interrupted while it
is inside compiled code. Where the process is Sortie's own (`end_when_stuck`), a call that cannot be interrupted ends the
process: by this thread, or by a second process (`stuck.py`) where compiled code lets no thread run.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import mmap
import os
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from sortie.scenarios.exit_codes import FAILED, STUCK

DECISION_S = 10.0
"""The longest time for a decision where no scenario says otherwise."""
LOAD_S = 60.0
"""The longest time for a user's file to load."""
GRACE_S = 5.0
"""A call that is interrupted must end within this time. It is interrupted again when half of it is over."""
TICK_S = 0.1
BEAT = "=Qd480s"
"""What `stuck.py` reads: a counter of ticks, how long it may stand still (0: for ever), and the error to print."""


class ProgramExitError(Exception):
    """A user's code tried to end the program."""


class TookTooLongError(Exception):
    """A call of a user's code that did not return within its limit."""


class _Interrupt(BaseException):
    """Sent into a call that is late. An ordinary `except` in the user's code does not catch it."""


class Source(NamedTuple):
    """Where a user's function comes from."""

    file: Path
    name: str
    names: Mapping[str, object]
    """All names of the file that it was loaded from."""


class Guarded:
    """A user's function. It raises ProgramExitError in place of SystemExit, and TookTooLongError where it is late."""

    __wrapped__: Callable[..., Any]

    def __init__(
        self, function: Callable[..., Any], source: Source | None = None, *, shares_lateness: bool = True
    ) -> None:
        """Args: `shares_lateness`: once it is late, other functions of the same source count as late too."""
        functools.update_wrapper(self, function)
        self.source = source
        self._origin = (source.file, source.name) if source is not None and shares_lateness else None
        self._late = ""  # what it exceeded: it is not called again

    def __deepcopy__(self, memo: object) -> Guarded:
        """Itself, as Python has it for functions."""
        return self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The function's answer."""
        watch = _WATCHES.get(threading.get_ident())
        known = self._late or (watch.late.get(self._origin, "") if watch is not None and self._origin else "")
        if known:
            raise TookTooLongError(known)
        try:
            if watch is None or watch.calling:
                return self.__wrapped__(*args, **kwargs)
            try:
                watch.begin()
                return self.__wrapped__(*args, **kwargs)
            finally:
                late = False
                while watch.calling:
                    try:
                        late = watch.end() or late
                    except _Interrupt:  # it arrived as the call ended, and the call must still end
                        late = True
                watch.go_back()
                # the interrupt was lost in the call, or arrived here
                if late and not isinstance(sys.exc_info()[1], _Interrupt):
                    raise _Interrupt
        except SystemExit as stop:
            raise ProgramExitError(f"exit code {stop.code}, must return").with_traceback(stop.__traceback__) from None
        except _Interrupt as stop:
            self._late = "no answer" if watch is None else f"no answer within {watch.limit}"
            if watch is not None and self._origin is not None:
                watch.late[self._origin] = self._late
            raise TookTooLongError(self._late).with_traceback(stop.__traceback__) from None
        except BaseException as stop:
            if isinstance(stop, Exception | KeyboardInterrupt) or _is_sorties(type(stop)):
                raise
            raise ProgramExitError(f"raises {type(stop).__name__}, must return").with_traceback(
                stop.__traceback__
            ) from None


def _is_sorties(kind: type) -> bool:
    """Whether a class is at home in Sortie. A user's class may only claim to be."""
    module = str(kind.__module__)
    return module.startswith("sortie.") and getattr(sys.modules.get(module), kind.__name__, None) is kind


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


@contextmanager
def watched(limit_s: float, limit: str = "") -> Iterator[None]:
    """Limit every guarded call of this thread within the block; an outer block of the same thread gives way to it.

    In the main thread, a call leaves the working folder as it was, so that paths of the command still mean the same.

    Args:
        limit_s: wall-clock time for one call.
        limit: the limit in words for errors, as "10 s (limits.decision_s)".
    """
    thread = threading.get_ident()
    outer = _WATCHES.get(thread)
    _WATCHES[thread] = watch = _Watch(thread, limit_s, limit or f"{limit_s:g} s")
    if outer is not None:
        watch.late = outer.late
    watch.start()
    try:
        yield
    finally:
        watch.stop()
        if outer is None:
            del _WATCHES[thread]
        else:
            _WATCHES[thread] = outer


def end_when_stuck() -> None:
    """Let a call that cannot be interrupted end the process. Libraries must not call this."""
    global _ends_process
    _ends_process = True


class _Watch:
    """Counts the time of the present call of one thread.

    It counts its own ticks, so that a process that was stopped for a while is not late.
    """

    def __init__(self, thread: int, limit_s: float, limit: str) -> None:
        self.calling = False
        self.limit = limit
        self.late: dict[tuple[Path, str], str] = {}
        """What functions from files exceeded: they are not called again, however often they are loaded."""
        self._limit_s, self._thread = limit_s, thread
        self._longest_s = limit_s + GRACE_S
        self._error = f"a call of the policy does not return within {limit}, and cannot be interrupted"
        self._ticks = self._first = 0
        """Of the present call, and when it was late."""
        self._again_ticks = max(1, round(GRACE_S / 2 / TICK_S))
        self._lock, self._over = threading.Lock(), threading.Event()
        main = threading.current_thread() is threading.main_thread()
        self._here = os.getcwd() if main else None  # of the whole process: no other thread may move it

    def start(self) -> None:
        self._beat = _beat_of_process() if _ends_process else None
        if self._beat is not None:  # before the first call, in which no thread may run
            self._beat.tick(self._longest_s, self._error)
        self._counter = threading.Thread(target=self._count, name="limit of a call", daemon=True)
        self._counter.start()
        _refuse_exits()

    def stop(self) -> None:
        self._over.set()
        self._counter.join()
        if self._beat is not None:
            self._beat.rest()
        self.go_back()  # from a call that has no limit

    def begin(self) -> None:
        self._process = os.getpid()
        with self._lock:
            self.calling, self._ticks = True, 0

    def end(self) -> bool:
        """Whether the call was late. A process that the call forked ends here: it must not go on with what the first one does."""
        if os.getpid() != self._process:
            _exit(FAILED)
        with self._lock:
            self.calling = False
        return self._ticks * TICK_S > self._limit_s

    def go_back(self) -> None:
        """To the working folder in which the call began."""
        if self._here is not None and _working_folder() != self._here:
            os.chdir(self._here)

    def _count(self) -> None:
        while not self._over.wait(TICK_S):
            if self._beat is not None:
                self._beat.tick(self._longest_s, self._error)
            with self._lock:
                if not self.calling:
                    continue
                before_s, self._ticks = self._ticks * TICK_S, self._ticks + 1
                now_s = self._ticks * TICK_S
                if before_s <= self._limit_s < now_s:
                    self._first = self._ticks
                # and again: Python drops what reaches a `__del__` or a callback of its garbage collector
                if now_s > self._limit_s and (self._ticks - self._first) % self._again_ticks == 0:
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(
                        ctypes.c_ulong(self._thread), ctypes.py_object(_Interrupt)
                    )
            if now_s > self._longest_s and _ends_process:
                os.write(2, f"error: {self._error}\n".encode())
                _exit(STUCK)


class _Beat:
    """Memory shared with the process of `stuck.py`."""

    def __init__(self) -> None:
        with tempfile.TemporaryFile() as file:
            file.truncate(struct.calcsize(BEAT))
            self._memory = mmap.mmap(file.fileno(), struct.calcsize(BEAT))
            script = Path(__file__).with_name("stuck.py")
            command = [sys.executable, "-I", "-S", str(script), str(file.fileno()), BEAT, str(TICK_S)]
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[file.fileno()])  # noqa: S603 - our own script
        self._ticks = 0
        atexit.register(self._close)

    def tick(self, longest_s: float, error: str) -> None:
        self._ticks += 1
        struct.pack_into(BEAT, self._memory, 0, self._ticks, longest_s, error.encode()[:480])

    def rest(self) -> None:
        self.tick(0.0, "")

    def _close(self) -> None:
        self._process.kill()
        self._process.communicate()


def _working_folder() -> str | None:
    try:
        return os.getcwd()
    except FileNotFoundError:  # it was removed
        return None


@functools.cache
def _beat_of_process() -> _Beat | None:
    """None where no process can be started: calls that compiled code holds then have no limit."""
    try:
        return _Beat()
    except OSError:
        return None


@functools.cache
def _refuse_exits() -> None:
    """`os._exit` and `os.execv` within a guarded call raise SystemExit, in this process and not in those that it forks."""
    process = os.getpid()

    def refused(name: str) -> Callable[..., Any]:
        act = getattr(os, name)

        @functools.wraps(act)
        def leave(*args: Any) -> Any:
            watch = _WATCHES.get(threading.get_ident())
            if watch is not None and watch.calling and os.getpid() == process:
                raise SystemExit(args[0] if name == "_exit" else f"of {name}")
            return act(*args)

        return leave

    compiled = sys.modules.get("posix") or sys.modules.get("nt") or os  # `os` takes them from there
    for name in ("_exit", "execv", "execve"):
        leave = refused(name)
        setattr(os, name, leave)
        setattr(compiled, name, leave)


_exit = os._exit
_ends_process = False
_WATCHES: dict[int, _Watch] = {}
"""By thread."""
