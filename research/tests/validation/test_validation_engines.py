"""What is kept of an engine: forty drawn scenarios that can be flown, and what counts as a difference."""

from __future__ import annotations

from typing import Any

from research.validation import engines
from research.validation.engines import DRAWN, FIGURES, LIBRARY, SEEDS, SHARING, differences, drawn, flown


def rows(*, off: float = 0.0, print_: str = "a") -> list[dict[str, Any]]:
    library = [
        {"name": f"{name} {seed}", "fingerprint": "", **dict.fromkeys(FIGURES, seed / 8 + 10.0)}
        for name in LIBRARY
        for seed in SEEDS
    ]
    for row in library:
        if row["name"].startswith("two_makes"):
            row["switches"] += off
    return [*({"name": f"drawn_{k}", "fingerprint": print_ if k == 7 else "a"} for k in range(DRAWN)), *library]


def test_a_record_that_differs_and_a_mean_that_moved_are_told_and_nothing_else() -> None:
    assert differences(rows(), rows()) == []
    assert differences(rows(), rows(off=0.04)) == [], "less than half a per cent"
    assert differences(rows(), rows(print_="b")) == ["drawn_7: another record"]
    (line,) = differences(rows(), rows(off=3.0))
    assert line.startswith("two_makes: switches 10.56 → 13.56, p = ")


def test_the_drawn_scenarios_are_the_same_each_time_and_most_have_payloads() -> None:
    first = dict(drawn())
    assert first == dict(drawn())
    silent = [name for name, sets in first.items() if "policy={name: silence}" in sets]
    assert (len(first), len(silent)) == (DRAWN, DRAWN - SHARING)
    set_anywhere = {one.partition("=")[0] for sets in first.values() for one in sets}
    assert set(engines.FIELDS) <= set_anywhere


def test_a_flight_says_its_fingerprint_and_its_figures() -> None:
    name, sets = next(iter(drawn()))
    row = flown((name, "track_target", (*sets, "duration_s=3"), None))
    assert set(row) == {"name", "fingerprint", *FIGURES}
    assert row["bytes.context_sent"] > 0
