"""Large fleets on the medium: only what differs between two plans is copied, and that changes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import simpy
from wrong_rows import wrong_rows

from sortie.radio import Air, AirSettings
from sortie.radio.mac import edca

DRONES, SECONDS = 40, 1.2


class CopiesAll:
    """The compiled stations; before each plan every station counts as different."""

    def __init__(self, medium: Any) -> None:
        self._medium = medium

    def __getattr__(self, name: str) -> Any:
        return getattr(edca, name)

    def ahead(self, *args: Any) -> Any:
        n = (len(self._medium._differing) - 1) // 2
        self._medium._differing[:] = [n, *range(n), *[edca.SENDS] * n]
        return edca.ahead(*args)


def flown(*, copies_all: bool, seed: int) -> list[tuple[Any, ...]]:
    """All that a fleet of small groups over 1.5 km hears of each other, with payloads, replaced ones, and drones that leave."""
    rng, env, log = np.random.default_rng(seed), simpy.Environment(), []
    at_m = rng.uniform(0.0, 1500.0, (DRONES // 4, 1, 2)) + rng.uniform(0.0, 120.0, (DRONES // 4, 4, 2))
    place_m = np.concatenate([at_m.reshape(-1, 2), np.full((DRONES, 1), 60.0)], axis=1)
    place_m[:4, 0] += 1e5 * np.arange(1, 5)  # four that nobody hears
    drift_m = np.linspace(0.0, 200.0, 40)[:, None, None] * rng.uniform(-1.0, 1.0, (1, DRONES, 3))
    air = Air(env, AirSettings(), place_m + drift_m, seed=seed, frame_s=0.1)
    if copies_all:
        air.medium._e = CopiesAll(air.medium)

    def fly() -> Iterator[simpy.Event]:
        for _ in range(round(SECONDS / 0.1) - 1):
            air.advance()
            for i in range(DRONES):
                air.broadcast(i, 1400, lambda heard, i=i: log.append((env.now, i, tuple(heard))))
            for i in rng.choice(DRONES, 16, replace=False).tolist():
                peer = 4 * (i // 4) + (i + 1) % 4
                air.send(
                    i,
                    peer,
                    int(rng.integers(200, 90_000)),
                    kind="features",
                    reliable=bool(i % 2),
                    deadline_s=0.09,
                    on_done=lambda row: log.append((env.now, *row)),
                )
            for part_s in (0.013, 0.021, 0.066):
                yield env.timeout(part_s)
                who = int(rng.integers(DRONES if part_s > 0.02 else 4))
                air.silence(who)
                air.wake(who)

    env.process(fly())
    env.run(until=SECONDS)
    return [*log, tuple(air.airtime_s), str(air.counters), *map(str, air.finish())]


def test_copying_what_differs_is_copying_all() -> None:
    def check(seed: int) -> None:
        some, everything = flown(copies_all=False, seed=seed), flown(copies_all=True, seed=seed)
        assert len(some) > 400
        assert list(map(repr, some)) == list(map(repr, everything))

    assert wrong_rows([1, 2, 3], check) == {}
