"""A table of cases in one test: every row is checked, and every wrong one is named."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def wrong_rows(rows: Iterable[Any], check: Callable[..., None]) -> dict[str, str]:
    """What `check` finds wrong, by row. It is called with the parts of a row that is a tuple, else with the row."""
    found = {}
    for row in rows:
        try:
            check(*row if type(row) is tuple else (row,))
        except (Exception, pytest.fail.Exception) as fault:
            found[repr(row)] = f"{type(fault).__name__}: {fault}"
    return found
