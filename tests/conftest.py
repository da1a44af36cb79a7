"""Options of the suite."""

from __future__ import annotations

import pytest
import suite_settings  # noqa: F401 (it sets what it names)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update-golden", action="store_true", help="Write golden outcomes anew instead of comparing.")
