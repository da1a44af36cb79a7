"""What is drawn before take-off, and by attackers: each part draws anew for every seed, replication, drone and event."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pytest
from sim_examples import example

from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import Parts, build, fly


def parts(seed: int, replication: int, *sets: str) -> Parts:
    scenario = example(*sets)
    return build(scenario, plan_for(scenario), seed, replication)


def drawn(seed: int, replication: int) -> dict[str, np.ndarray]:
    """By what is drawn, one row a drone, or a row for all pairs."""
    built = parts(
        seed, replication, "duration_s=2", "fleet.clock={gnss: false, offset_s: 0.1, drift_ppm: 50}",
        "events=[{kind: gnss_loss, at_s: 0.5, position_walk_m: 1}]",
    )  # fmt: skip
    world, n = built.world, len(built.world.drones)
    offset_s = [d.clock_skew_s for d in world.drones]
    for own in world.own:
        own.read(1000.0)
    drift_s = [d.clock_skew_s - at_first_s for d, at_first_s in zip(world.drones, offset_s, strict=True)]
    built.air.advance()
    motion, believed_m = world.motion, world.believed()[1]
    return {
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


@pytest.mark.parametrize("drones", [(1, 1), (1, 2)])
def test_attackers_draw_each_for_themselves(drones: Sequence[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Two that imitate one drone, or two drones, put other noise on the air; so does one in another replication."""
    spoofs = ", ".join(f"{{kind: spoof, at_s: 1, drone: {d}, attack: malformed, rate_hz: 5}}" for d in drones)
    injected: list[bytes] = []
    for replication in (0, 1):
        built = parts(1, replication, "duration_s=2", f"events=[{spoofs}]")
        monkeypatch.setattr(built.transport, "inject", lambda datagram, listeners: injected.append(datagram[:32]))
        fly(built)
    assert len(injected) >= 2 * 2 * 5
    assert all(a != b for a, b in combinations(injected, 2))
