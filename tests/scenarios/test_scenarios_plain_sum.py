"""The sum that every Python adds up alike."""

from __future__ import annotations

import builtins
import math
from collections.abc import Iterable
from typing import Any

import pytest

import sortie
from sortie.scenarios.plain_sum import plain_sum


def test_it_rounds_after_each_addition_from_the_left() -> None:
    assert plain_sum([1e16, 1.0, -1e16, 0.5]) == 0.5
    assert plain_sum(iter([0.1] * 10)) == 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 != 1.0
    assert plain_sum([]) == 0


def test_the_record_does_not_depend_on_how_the_built_in_sum_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which it does in one way up to Python 3.11, and in another from 3.12 on."""
    settings = {"duration_s": 1, "perception.detector": "none"}
    plain = builtins.sum

    def exact(values: Iterable[Any], /, start: Any = 0) -> Any:
        listed = list(values)
        if not listed or any(type(x) is not float for x in listed):
            return plain(listed, start)
        return math.fsum([start, *listed])

    before = sortie.fly("track_target", settings).fingerprint
    monkeypatch.setattr(builtins, "sum", exact)
    assert sortie.fly("track_target", settings).fingerprint == before
