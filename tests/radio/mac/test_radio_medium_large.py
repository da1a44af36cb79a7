"""Large fleets on the medium: only what differs is copied, and faint frames are energy and interference alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import simpy

from sortie.radio import Air, AirSettings
from sortie.radio.channel.draws import fade_table
from sortie.radio.channel.pathloss import range_m
from sortie.radio.mac import edca
from sortie.radio.mac.jobs import AirJob, GroupFrame
from sortie.radio.mac.medium import FAINT_DB, Medium

DRONES, SECONDS = 40, 1.2
NOISE_DBM = -87.0
GROUP_S = 500e-6


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
                air.send(i, peer, int(rng.integers(200, 90_000)), kind="features", reliable=bool(i % 2), deadline_s=0.09,
                         on_done=lambda row: log.append((env.now, *row)))  # fmt: skip
            for part_s in (0.013, 0.021, 0.066):
                yield env.timeout(part_s)
                who = int(rng.integers(DRONES if part_s > 0.02 else 4))
                air.silence(who)
                air.wake(who)

    env.process(fly())
    env.run(until=SECONDS)
    return [*log, tuple(air.airtime_s), str(air.counters), *map(str, air.finish())]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_copying_what_differs_is_copying_all(seed: int) -> None:
    some, everything = flown(copies_all=False, seed=seed), flown(copies_all=True, seed=seed)
    assert len(some) > 400
    assert list(map(repr, some)) == list(map(repr, everything))


def first_frame_s(strangers: int, power_dbm: float) -> float:
    """When a group frame of station 0 is over that comes while others send that cannot hear one another."""
    n, env, over_s = strangers + 1, simpy.Environment(), {}
    medium = Medium[AirJob, GroupFrame](
        env, AirSettings(rician_k_db=40.0), n, 1, 0, NOISE_DBM, lambda job, now: None, lambda *job: None,
        lambda frame, receivers, fates: over_s.setdefault(frame.sender, env.now),
    )  # fmt: skip
    power = np.full((n, n), -200.0)
    power[1:, 0] = power_dbm
    gain = 10.0 ** ((power - NOISE_DBM) / 10.0)
    medium.set_links(np.arange(n + 1) * n, np.tile(np.arange(n), n), gain.ravel(), frame=0)
    for i in range(1, n):
        medium.announce(GroupFrame(i, GROUP_S, 334))
    medium.announce(GroupFrame(0, GROUP_S, 334), 1e-4)
    env.run(until=0.1)
    return float(over_s[0])


def test_faint_frames_are_heard_as_energy_where_they_are_many() -> None:
    """Each is 10 dB below the weakest preamble: five leave the medium idle, twenty make it busy until they are over."""
    weakest_dbm = AirSettings().preamble_detection_dbm
    alone_s = first_frame_s(0, -200.0)
    assert first_frame_s(5, weakest_dbm - 10.0) == alone_s
    assert first_frame_s(20, weakest_dbm - 10.0) > alone_s + 0.9 * (GROUP_S - 1e-4)


def test_links_of_the_default_radio_are_faint_beyond_a_kilometre() -> None:
    """As the room's README has it."""
    config = AirSettings()
    fade_db = 10.0 * np.log10(fade_table(config.rician_k_db).max())
    faint_at_m = range_m(config, config.tx_power_dbm - config.preamble_detection_dbm + FAINT_DB + fade_db)
    assert faint_at_m == pytest.approx(1000.0, rel=0.05)


def test_a_faint_frame_is_lost_to_a_weak_signal_whatever_else_is_on_the_air() -> None:
    n, env, found = 3, simpy.Environment(), {}
    medium = Medium[AirJob, GroupFrame](
        env, AirSettings(rician_k_db=40.0), n, 1, 0, NOISE_DBM, lambda job, now: None, lambda *job: None,
        lambda frame, receivers, fates: found.setdefault(frame.sender, fates),
    )  # fmt: skip
    power = np.full((n, n), -60.0)
    power[2, 1] = AirSettings().preamble_detection_dbm - FAINT_DB - 0.5
    power[0, 2] = power[2, 0] = -200.0
    gain = 10.0 ** ((power - NOISE_DBM) / 10.0)
    medium.set_links(np.arange(n + 1) * n, np.tile(np.arange(n), n), gain.ravel(), frame=0)
    medium.announce(GroupFrame(0, GROUP_S, 334))
    medium.announce(GroupFrame(2, GROUP_S, 334), 1e-4)
    env.run(until=0.1)
    assert found[0][1] == edca.HEARD
    assert found[2][1] == edca.FAINT
