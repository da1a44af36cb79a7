"""How long work tells how far it is: a bar in a terminal, else a line a minute."""

from __future__ import annotations

import pytest

import sortie
from sortie.sim.cli.console import line_a_minute


def test_without_a_terminal_a_line_a_minute_says_how_far_it_is() -> None:
    said: list[str] = []
    times_s = iter((0.0, 10.0, 61.0, 61.0, 100.0, 125.0, 125.0))  # asked at the start, at each call, and when it speaks
    update = line_a_minute("a", 120.0, say=said.append, clock=lambda: next(times_s))
    for done in (1.0, 30.0, 60.0, 90.0):
        update(done)
    assert said == ["a: 30 of 120", "a: 90 of 120"]


def test_progress_true_shows_how_far_flights_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one flight in simulated seconds, of a comparison in those of all its flights."""
    shown: list[tuple[str, float, list[float]]] = []

    def add(label: str, total: float, **_: object) -> object:
        shown.append((label, total, []))
        return shown[-1][2].append

    monkeypatch.setattr("sortie.sim.cli.console.line_a_minute", add)
    short = {"duration_s": 2, "perception.detector": "none"}
    sortie.fly("track_target", short, progress=True)
    sortie.compare("track_target", ["worked", "silence"], short, seeds=[1, 2], progress=True)
    (flight, compared) = shown
    assert flight[:2] == ("track_target", 2.0)
    assert flight[2][-1] == 2.0
    assert compared[:2] == ("track_target", 8.0)
    assert compared[2] == sorted(compared[2])
    assert compared[2][-1] == 8.0
