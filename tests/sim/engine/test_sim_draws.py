"""What is drawn before take-off, and by attackers: anew for every seed, replication, drone and event."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from sim_examples import example

from sortie.sim.engine import sortie as engine
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import Parts, build, fly, phase_of

DRIFTING = "fleet.clock={gnss: false, offset_s: 0.1, drift_ppm: 50}"
WALKING = "events=[{kind: gnss_loss, at_s: 0.5, position_walk_m: 1}]"


def parts(seed: int, replication: int, *sets: str) -> Parts:
    scenario = example(*sets, "mission.phases=[{at_s: 0, phase: search}]")
    return build(scenario, plan_for(scenario), seed, replication)


def drawn(seed: int, replication: int) -> dict[str, np.ndarray]:
    """By what is drawn, one row a drone, or a row for all pairs."""
    built = parts(seed, replication, "duration_s=2", DRIFTING, WALKING)
    world, n = built.world, len(built.world.drones)
    offset_s = [d.clock_skew_s for d in world.drones]
    for clock in world._clocks:
        clock.read(1000.0)
    drift_s = [d.clock_skew_s - at_first_s for d, at_first_s in zip(world.drones, offset_s, strict=True)]
    built.air.advance()
    motion, believed_m = world.motion[:], world.believed()[1]
    return {
        "moment of acting": np.array([[phase_of(built.scenario, seed, replication, d)] for d in range(n)]),
        "offset of the clock": np.array(offset_s)[:, None],
        "drift of the clock": np.array(drift_s)[:, None],
        "place": motion.position_m[3],
        "error of the estimated place": (motion.est_position_m - motion.position_m)[3, :, :2],
        "error of the estimated heading": (motion.est_yaw_rad - motion.yaw_rad)[3, :, None],
        "wind": motion.wind_mps[3],
        "walk without GNSS": (believed_m - motion.est_position_m)[8, :, :2],
        "shadowing": built.air.channel.shadow_db[np.triu_indices(n, 1)][None],
    }


def test_every_seed_and_replication_draws_all_anew_for_each_drone() -> None:
    each = {key: drawn(*key) for key in ((1, 0), (2, 0), (1, 1))}
    again = drawn(1, 0)
    for name, values in each[1, 0].items():
        np.testing.assert_array_equal(values, again[name], err_msg=name)
        numbers = np.concatenate([each[key][name].ravel() for key in each])
        assert np.isfinite(numbers).all(), name
        assert len(np.unique(np.round(numbers, 12))) == len(numbers), name
    moments_s = np.concatenate([found["moment of acting"] for found in each.values()])
    assert 0.0 <= moments_s.min() < moments_s.max() < 0.01


def test_attackers_draw_each_for_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two that imitate one drone, or two drones, put other noise on the air; so does one in another replication."""
    for drones in ((1, 1), (1, 2)):
        spoofs = ", ".join(f"{{kind: spoof, at_s: 0.2, drone: {d}, attack: malformed, rate_hz: 10}}" for d in drones)
        injected: list[bytes] = []
        for replication in (0, 1):
            built = parts(1, replication, "duration_s=0.8", "fleet.drones=3", f"events=[{spoofs}]")
            monkeypatch.setattr(built.transport, "inject", lambda data, to, put=injected: put.append(data[:32]))
            fly(built)
        assert len(injected) >= 2 * 2 * 5
        assert all(a != b for a, b in combinations(injected, 2))


def test_every_part_draws_by_the_seed_and_the_replication_that_fly_and_not_by_the_scenario_s(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    got: dict[str, tuple[Any, Any]] = {}

    def noted(name: str, place: Callable[[Any, Any], tuple[Any, Any]]) -> None:
        made = getattr(engine, name)
        monkeypatch.setattr(engine, name, lambda *a, **k: (got.__setitem__(name, place(a, k)), made(*a, **k))[1])

    noted("People", lambda a, k: a[-1])
    noted("Air", lambda a, k: (k["seed"], k["replication"]))
    for name in ("Acted", "Planners", "oscillators", "sensor_errors", "flown_motion", "mixed"):
        noted(name, lambda a, k: a[-2:])
    parts(9, 4, "seed=1", "duration_s=0.2", "fleet.drones=2")
    assert got == dict.fromkeys(got, (9, 4))
    assert len(got) == 8
