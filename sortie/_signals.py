"""Ctrl-C and SIGTERM before a command runs: they end the process at once, with one line.

This module imports nothing that takes time, so that `sortie` answers from its first moment on.
"""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found]  # built in; `signal` itself takes milliseconds to import
import os

_USUAL = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


def end_at_once() -> None:
    """Answer both signals by the end of the process. Where they are ignored, they stay so."""
    for number, usual in _USUAL.items():
        if signal.getsignal(number) == usual:
            signal.signal(number, _end)


def as_usual() -> None:
    """Answer both signals as Python does: Ctrl-C is a `KeyboardInterrupt`, and SIGTERM ends the process."""
    for number, usual in _USUAL.items():
        if signal.getsignal(number) is _end:
            signal.signal(number, usual)


def _end(number: int, *_: object) -> None:
    """End without an exception: a library that is being imported takes one for a missing optional part, and goes on."""
    what = b"interrupted" if number == signal.SIGINT else b"ended by SIGTERM"
    try:
        os.write(2, what + b"; nothing was written\n")
    finally:
        os._exit(128 + number)
