"""What a user can put right, as one line."""

from __future__ import annotations

import sys

import pytest

from sortie.sim.user_errors import missing


@pytest.mark.parametrize(
    ("python", "told"),
    [
        ((3, 13, 5), "cyclonedds is missing: pip install 'sortie-sim[dds]'"),
        ((3, 14, 0), "cyclonedds is missing: it has no wheels for Python 3.14; use Python 3.11 to 3.13"),
    ],
)
def test_an_extra_without_wheels_is_not_recommended(
    python: tuple[int, int, int], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "version_info", python)
    assert str(missing(ModuleNotFoundError(name="cyclonedds.domain"))) == told
