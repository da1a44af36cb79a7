"""A benchmark runs once as a test, in the whole suite alone: together they take a minute."""

from __future__ import annotations

from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.parent == Path(__file__).parent and "benchmark" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
