"""What a flight leaves behind: its parts are freed when others follow, and the search for them takes a small share of the time."""

from __future__ import annotations

import gc
import weakref
from itertools import pairwise
from typing import Any

import pytest

from sortie.perception.detectors import make_detector
from sortie.scenarios.reading.load import load
from sortie.sim.engine import garbage
from sortie.sim.engine.garbage import Leftovers
from sortie.sim.engine.sortie import run_sortie


def test_the_parts_of_a_flight_are_freed_when_others_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(garbage.LEFTOVERS, "_took_s", 0.0)
    scenario = load("track_target", ["perception.detector=surrogate", "duration_s=1", "fleet.drones=2"])
    scenes: list[weakref.ref[Any]] = []

    def made(scene: Any, *rest: Any) -> Any:
        scenes.append(weakref.ref(scene))
        return make_detector(scene, *rest)

    gc.disable()  # Python's own search comes when it likes
    try:
        for seed in range(3):
            run_sortie(scenario, seed=seed, detector_of=made)
            garbage.LEFTOVERS._took_s = 0.0
    finally:
        gc.enable()
    assert [scene() is None for scene in scenes] == [True, True, False]


def test_of_flights_side_by_side_the_last_puts_the_search_back() -> None:
    at_first = gc.get_threshold()
    gc.set_threshold(700, *at_first[1:])
    first, second = garbage.cycles_searched_rarely(), garbage.cycles_searched_rarely()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert (gc.get_threshold()[0], gc.get_freeze_count()) == (garbage.NEW_OBJECTS, 0)
    second.__exit__(None, None, None)
    after = gc.get_threshold()[0], gc.get_freeze_count()
    gc.set_threshold(*at_first)
    assert after == (700, 0)


def test_the_search_waits_until_it_is_a_small_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, searched = [0.0], []

    def collect() -> None:
        searched.append(clock[0])
        clock[0] += 0.125

    monkeypatch.setattr(garbage, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(garbage.gc, "collect", collect)
    leftovers = Leftovers()
    for _ in range(50):
        leftovers.free()
        clock[0] += 0.5
    gaps = [b - a for a, b in pairwise(searched)]
    assert gaps == pytest.approx([2.625] * len(gaps))
    assert len(gaps) >= 9
