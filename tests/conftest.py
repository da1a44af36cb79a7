"""Options of the suite."""

from __future__ import annotations

import signal

import pytest
from hypothesis import settings

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # begun in the background: children would ignore Ctrl-C as well
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("sortie", deadline=None)  # a deadline is a timed assertion: it fails on a busy machine alone
settings.load_profile("sortie")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update-golden", action="store_true", help="Write golden outcomes anew instead of comparing.")
