"""Calls in a process of Sortie's own, which ends at `limits.decision_s`, at `limits.run_s`, or when whoever waits wants it to.

The process is started by `-P`, so that no module of the working folder takes the place of an installed one.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sortie.scenarios.errors import SortieError
from sortie.scenarios.exit_codes import FAILED
from sortie.scenarios.plugins.user_calls import limit_calls
from sortie.scenarios.schema.limits import Limits
from sortie.sim.folders import RunError
from sortie.sim.process import own_process
from sortie.sim.user_errors import user_errors

_BEGIN = "from sortie.sim.apart import serve; serve({}, {})"
_NOT_USERS = (str(Path(__file__).parents[1]), sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"))


class LimitError(SortieError):
    """A flight, or a call of a user's code in it, that takes longer than it may."""


class DiedError(SortieError):
    """The process has ended in the middle of a call."""


class Apart:
    """A process that makes one call after the other."""

    def __init__(self) -> None:
        self._pipe, theirs = multiprocessing.Pipe()
        self._place = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        files = [theirs.fileno(), self._place.fileno()]
        self._process = subprocess.Popen(  # noqa: S603 - our own code
            [sys.executable, "-P", "-c", _BEGIN.format(*files)], pass_fds=files
        )
        theirs.close()

    def call(
        self, work: Callable[[], Any], limits: Limits, hear: Mapping[str, Callable[..., object]] | None = None
    ) -> Any:
        """What `work` returns there.

        Args:
            work: picklable. Its arguments may be `Said`.
            limits: `run_s` is counted from when the process has received the call.
            hear: called here with what a `Said` of that name is called with there.

        Raises:
            RunError: the call cannot be sent.
            LimitError: it took longer than a limit, and the process has ended.
            DiedError: the process has ended for another reason.
            Exception: what `work` raises.
        """
        try:
            self._pipe.send((sys.path, limits.decision_s or 0.0))
            self._pipe.send(work)
        except ConnectionError:  # it has ended since the last call; `_received` says why
            pass
        except Exception as error:  # pickle's and those of the objects that it pickles
            raise RunError(_unsent(error)) from error
        end_s: float | None = None
        while True:
            kind, content = self._received(limits, end_s)
            if kind == "done":
                return content
            if kind == "failed":
                raise content
            if kind == "said":
                (hear or {})[content[0]](*content[1])
            elif limits.run_s is not None:
                end_s = time.monotonic() + limits.run_s

    def end(self) -> None:
        """End the process, also in the middle of a call; whoever waits for that gets a DiedError."""
        self._process.kill()

    def close(self) -> None:
        """End the process; nobody calls it any more."""
        self.end()
        self._process.wait()
        self._pipe.close()
        self._place.close()

    def _received(self, limits: Limits, end_s: float | None) -> tuple[str, Any]:
        """The next message."""
        try:
            if self._pipe.poll(None if end_s is None else max(0.0, end_s - time.monotonic())):
                message: tuple[str, Any] = self._pipe.recv()
                return message
        except (EOFError, ConnectionError):
            raise self._why_ended(self._process.wait(), limits) from None
        self.end()
        raise LimitError(f"the flight takes longer than {limits.run_s:g} s (limits.run_s)")

    def _why_ended(self, code: int, limits: Limits) -> SortieError:
        if code == -signal.SIGALRM and limits.decision_s is not None:
            self._place.seek(0)
            where = _users_line(self._place.read().decode(errors="replace"))
            return LimitError(f"no answer within {limits.decision_s:g} s (limits.decision_s){where}")
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return DiedError(f"the flight's process {how}")


def call_within(
    limits: Limits, what: str, work: Callable[[], Any], hear: Mapping[str, Callable[..., object]] | None = None
) -> Any:
    """Make one call in a process that ends at the limits. Arguments and errors as for `Apart.call`; `what` names it."""
    process = Apart()
    try:
        return process.call(work, limits, hear)
    except (LimitError, DiedError) as error:
        raise type(error)(f"{what}: {error}") from None
    finally:
        process.close()


class Said:
    """Called in the process, it calls the function of that name of whoever waits."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, *args: object) -> None:
        assert _pipe is not None  # noqa: S101 - only in the process
        _pipe.send(("said", (self._name, args)))


_pipe: Connection | None = None
"""Of this process to whoever waits, where it is an `Apart`."""


def serve(pipe: int, place: int) -> None:
    """Make the calls that come in until whoever waits is gone."""
    global _pipe
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to both; whoever waits ends this process
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    own_process()
    _pipe = Connection(pipe)
    traceback_of_late = open(place, "wb", buffering=0)  # noqa: SIM115 - until the end of the process
    with suppress(EOFError, OSError):  # whoever waits was killed
        while True:
            sys.path[:], decision_s = _pipe.recv()
            try:
                work = _pipe.recv()
            except (EOFError, OSError):
                raise
            except Exception as error:  # its modules are not to be had here
                _pipe.send(("failed", RunError(_unsent(error))))
                continue
            _pipe.send(("begun", None))
            limit_calls(decision_s, traceback_of_late)
            _pipe.send(_answer(work))


def _answer(work: Callable[[], Any]) -> tuple[str, Any]:
    try:
        with user_errors():
            return "done", work()
    except Exception as error:
        if not isinstance(error, SortieError):
            error.add_note("".join(traceback.format_exception(error)))  # a traceback does not go through a pipe
        return "failed", error


def _end_with(waits: int) -> None:
    """End this process when whoever waits is gone, also in the middle of a call."""
    while os.getppid() == waits:
        time.sleep(0.5)
    os._exit(FAILED)


def _unsent(error: Exception) -> str:
    return (
        f"limits are set, so the flight has a process of its own, which cannot get what it flies ({error}); "
        "name a policy by its file, as mine.py:decide, or leave out limits"
    )


def _users_line(trace: str) -> str:
    """The innermost place in the user's code, from a traceback of `faulthandler`."""
    for file, line in re.findall(r'File "(.*)", line (\d+)', trace):
        if not file.startswith(_NOT_USERS) and not file.startswith("<"):
            return f" ({Path(file).name}, line {line})"
    return ""
