"""What the air costs: 120 s of five drones at 10 Hz, descriptors alone and with two samples per drone and frame; and
descriptors of 5 to 400 drones, all within earshot or with some fifty neighbours each."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import simpy

from sortie.radio import Air
from sortie.radio.settings import AirSettings

pytestmark = pytest.mark.slow

CROSS_M = np.array([[0, 0, 60], [20, 0, 60], [-20, 0, 60], [0, 20, 60], [0, -20, 60]], float)
FRAMES = 1200


def _sortie(samples: int) -> int:
    env = simpy.Environment()
    air = Air(env, AirSettings(), np.broadcast_to(CROSS_M, (FRAMES, 5, 3)), seed=1, frame_s=0.1)
    done: list[Any] = []

    def frames() -> simpy.events.ProcessGenerator:
        for _ in range(FRAMES):
            air.advance()
            for i in range(5):
                air.broadcast(i, 208, done.append)
            yield env.timeout(0.03)
            for i in range(5):
                for hop in range(1, samples + 1):
                    air.send(i, (i + hop) % 5, 13_120, kind="f", reliable=False, deadline_s=0.065, on_done=done.append)
            yield env.timeout(0.07)

    env.process(frames())
    env.run(until=120.0)
    return len(done)


@pytest.mark.parametrize("samples", [0, 2])
def test_120_s_of_five_drones(benchmark: Any, samples: int) -> None:
    ends = benchmark.pedantic(_sortie, args=(samples,), rounds=3, iterations=1)
    assert ends >= 5 * FRAMES * (1 + samples) - 5  # the last broadcasts may be on the air


def _square(n: int, frames: int) -> np.ndarray:
    """[frames, n, 3]: drones at 20 m that fly east at 5 m/s."""
    side = int(np.ceil(np.sqrt(n)))
    slot = np.array([[20.0 * (i % side), 20.0 * (i // side), 60.0] for i in range(n)])
    return slot[None] + np.arange(frames)[:, None, None] * np.array([0.5, 0.0, 0.0])


def _descriptors(n: int, frames: int, config: AirSettings) -> int:
    env = simpy.Environment()
    air = Air(env, config, _square(n, frames), seed=1, frame_s=0.1)

    def heard(_: Any) -> None:
        return None

    def fly() -> simpy.events.ProcessGenerator:
        for _ in range(frames):
            air.advance()
            for i in range(n):
                air.broadcast(i, 208, heard)
            yield env.timeout(0.1)

    env.process(fly())
    env.run(until=frames * 0.1)
    return air.counters.broadcasts


@pytest.mark.parametrize(
    "radio", [AirSettings(), AirSettings(tx_power_dbm=-12.0, path_loss_exponent=3.0)], ids=["all", "near"]
)
@pytest.mark.parametrize(("n", "frames"), [(5, 1200), (25, 1200), (100, 1200), (400, 120)])
def test_descriptors_of_many_drones(benchmark: Any, n: int, frames: int, radio: AirSettings) -> None:
    assert benchmark.pedantic(_descriptors, args=(n, frames, radio), rounds=3, iterations=1) == n * frames
