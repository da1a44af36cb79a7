"""Ctrl-C and SIGTERM while processes are started and ended."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class EndedError(KeyboardInterrupt):
    """SIGTERM came: the campaign ends as with Ctrl-C."""


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """SIGTERM raises `EndedError` within the block, so that workers are ended and one line says what is kept."""

    def end(*_: object) -> None:
        raise EndedError

    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ctrl-C, and SIGTERM where it is handled, wait until the end of the block.

    A terminal sends Ctrl-C to the whole process group, and the driver alone is to answer: threads that begin in here have it
    blocked, and what they begin inherits that, workers that take the place of dead ones too.
    """
    if threading.current_thread() is not threading.main_thread():  # handlers are the main thread's
        yield
        return
    came: list[int] = []
    before: dict[int, Any] = {signal.SIGINT: signal.getsignal(signal.SIGINT)}
    if callable(signal.getsignal(signal.SIGTERM)):
        before[signal.SIGTERM] = signal.getsignal(signal.SIGTERM)
    for number in before:
        signal.signal(number, lambda number, frame: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in before.items():
            signal.signal(number, handler)
    if came and callable(handler := before[came[0]]):
        handler(came[0], None)
