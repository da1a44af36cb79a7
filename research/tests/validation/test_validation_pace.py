"""How fast sorties fly: rows, exponents and the picture from made costs; a small fleet is flown."""

from __future__ import annotations

from pathlib import Path

import pytest

from research.validation import pace
from research.validation.pace import WIDE_KM, Pace

MADE = [
    Pace(n, side_km, policy, 0.001 * n**power, n / 2, 2e8)
    for side_km, power in ((0.1, 1.0), (WIDE_KM, 1.5))
    for policy in pace.POLICIES
    for n in (5, 25, 100, 1000)
]
REST = {"flight": 40.0, "outcome": 3.0, "peak_b": 3e8}, {pace.SCORED: 1.5, "outcome": 0.5}, 61.4


def test_the_exponent_is_that_of_the_larger_fleets() -> None:
    small = [Pace(5, 0.1, "worked", 9.0, 4.0, 1e8)]
    assert pace.exponent(small + MADE[:4]) == pytest.approx(1.0)
    table = pace.fleet_table(MADE)
    assert "20 m apart, `worked`: 1.00; 20 m apart, `silence`: 1.00; 5 by 5 km, `worked`: 1.50;" in table.about
    assert list(table.rows[2]) == ["20 m apart", "worked", 100, 50.0, pytest.approx(0.1), pytest.approx(10.0), 2e8]


def test_the_readme_shows_the_large_fleets_and_what_a_full_sortie_takes() -> None:
    rows = [list(row) for row in pace.short_table(MADE, *REST).rows]
    assert [row[1] for row in rows] == [
        *["10 times real time, 200 MB"] * 2, *["0.032 times real time, 200 MB"] * 2, "60 times real time", "61 a minute",
        "40 s, 300 MB",
    ]  # fmt: skip
    assert [list(row)[1] for row in pace.sortie_table(*REST).rows][-1] == "61 sorties a minute"


def test_a_fleet_is_flown_and_drawn(tmp_path: Path) -> None:
    flown = pace.measure(2, 0.04, "silence")
    assert flown.heard == 1.0
    assert 0.0 < flown.cost_s < 60.0
    assert flown.peak_b > 1e7
    pace.draw(MADE, tmp_path / "pace.png")
    assert (tmp_path / "pace.png").stat().st_size > 10_000
