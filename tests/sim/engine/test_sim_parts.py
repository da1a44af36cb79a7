"""How the parts of a sortie are wired, and what a flight leaves behind: nothing that outlives the next flights."""

from __future__ import annotations

import gc
import weakref
from itertools import pairwise
from typing import Any

import pytest

from sortie.perception.detectors import make_detector
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine import garbage
from sortie.sim.engine import sortie as engine
from sortie.sim.engine.garbage import Leftovers
from sortie.sim.engine.sortie import Parts, build, run_sortie


def scenario(*sets: str) -> Scenario:
    short = ["perception.detector=surrogate", "duration_s=0.5", "fleet.drones=2", "mission.phases=[{at_s: 0}]"]
    return load("track_target", [*short, *sets])


# --- wiring --------------------------------------------------------------------------------------


def _attributes(parts: Parts) -> dict[str, list[str]]:
    several = [*parts.agents, *parts.pilots, *(a.memory for a in parts.agents)]
    single = [parts.world, parts.transport, parts.scorer, parts.audit, parts.notes, parts.recorder]
    return {f"{type(p).__name__} {i}": sorted(vars(p)) for i, p in enumerate([*single, *several])}


def test_no_part_gains_an_attribute_in_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[tuple[Parts, dict[str, list[str]]]] = []

    def kept(*arguments: Any) -> Parts:
        parts = build(*arguments)
        built.append((parts, _attributes(parts)))
        return parts

    monkeypatch.setattr(engine, "build", kept)
    changes = "policy={name: worked, changes: [{at_s: 1, name: all-4}]}"
    run_sortie(scenario("duration_s=2", changes, "events=[{kind: drone_lost, at_s: 1.5, drone: 1}]"))
    [(parts, before)] = built
    assert _attributes(parts) == before
    assert [d.airborne for d in parts.world.drones] == [True, False]


# --- garbage -------------------------------------------------------------------------------------


def test_the_parts_of_a_flight_are_freed_when_others_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(garbage.LEFTOVERS, "_took_s", 0.0)
    scenes: list[weakref.ref[Any]] = []

    def made(scene: Any, *rest: Any) -> Any:
        scenes.append(weakref.ref(scene))
        return make_detector(scene, *rest)

    gc.disable()  # Python's own search comes when it likes
    try:
        for seed in range(3):
            run_sortie(scenario(), seed=seed, detector_of=made)
            garbage.LEFTOVERS._took_s = 0.0
    finally:
        gc.enable()
    assert [scene() is None for scene in scenes] == [True, True, False]


def test_a_flight_gives_the_garbage_collector_back_as_it_was() -> None:
    """It belongs to the process, which may be another's. In flight it searches more rarely, and spares the old."""
    at_first = gc.get_threshold()
    for new, in_flight in ((0, 0), (700, 10_000), (90_000, 90_000)):
        seen: set[tuple[bool, int, bool]] = set()
        gc.set_threshold(new, *at_first[1:])
        try:

            def see(_: float, seen: set[tuple[bool, int, bool]] = seen) -> None:
                seen.add((gc.isenabled(), gc.get_threshold()[0], gc.get_freeze_count() > 0))

            run_sortie(scenario(), progress=see)
            assert (gc.get_threshold()[0], gc.get_freeze_count()) == (new, 0)
        finally:
            gc.set_threshold(*at_first)
        assert {(enabled, threshold) for enabled, threshold, _ in seen} == {(True, in_flight)}
        assert new != 700 or all(spared for *_, spared in seen)


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
