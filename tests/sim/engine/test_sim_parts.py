"""How the parts of a sortie are wired: each is complete when it is made, and none holds a part that is made after it."""

from __future__ import annotations

import gc
import weakref
from types import FunctionType, ModuleType
from typing import Any

import pytest
import simpy

from sortie.scenarios.reading.load import load
from sortie.sim.engine import sortie as engine
from sortie.sim.engine.pilot import plan_of
from sortie.sim.engine.sortie import Parts, build, run_sortie

SETS = [
    "perception.detector=surrogate",
    "duration_s=3",
    "mission.phases=[{at_s: 0, phase: search}]",
    "policy.name=worked",
    "policy.changes=[{at_s: 1, name: all-4}]",
    "events=[{kind: drone_lost, at_s: 1.5, drone: 2}]",
]


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
    run_sortie(load("track_target", SETS))
    [(parts, before)] = built
    assert _attributes(parts) == before
    assert [d.airborne for d in parts.world.drones] == [i != 2 for i in range(len(parts.agents))]


@pytest.mark.parametrize("new", [0, 700, 90_000])
def test_a_flight_gives_the_garbage_collector_back_as_it_was(new: int) -> None:
    """It belongs to the process, which may be somebody else's. In flight it searches more rarely, and stays off if it was."""
    at_first, seen = gc.get_threshold(), set()
    gc.set_threshold(new, *at_first[1:])
    try:
        run_sortie(load("track_target", SETS), progress=lambda _: seen.add((gc.isenabled(), gc.get_threshold()[0])))
        assert gc.get_threshold()[0] == new
    finally:
        gc.set_threshold(*at_first)
    assert seen == {(True, {0: 0, 700: 10_000, 90_000: 90_000}[new])}


@pytest.mark.parametrize("name", ["world", "transport"])
def test_neither_world_nor_transport_leads_to_an_agent(name: str) -> None:
    """Followed through everything that they hold, but for the clock, where every process waits."""
    scenario = load("track_target", [*SETS, "events=[]"])
    parts = build(scenario, plan_of(scenario.policy), 1)
    agents = {id(agent) for agent in parts.agents}  # others, of other tests, may be reached through a library's caches
    assert not any(id(held) in agents for held in _reachable(getattr(parts, name)))


def _reachable(start: object) -> list[object]:
    seen, waiting = {id(start): start}, [start]
    while waiting:
        for held in gc.get_referents(waiting.pop()):
            # a weak proxy holds nothing, and asked for its class after its object has gone it raises
            if isinstance(held, weakref.ProxyTypes):
                continue
            if isinstance(held, type | ModuleType | FunctionType | simpy.Environment | simpy.Event):
                continue
            if id(held) not in seen:
                seen[id(held)] = held
                waiting.append(held)
    return list(seen.values())
