"""Options of the suite."""

from __future__ import annotations

import pytest
from hypothesis import settings

settings.register_profile("sortie", deadline=None)  # a deadline is a timed assertion: it fails on a busy machine alone
settings.load_profile("sortie")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update-golden", action="store_true", help="Write golden outcomes anew instead of comparing.")
