"""The clock that may skip an event: when it may, and that flights on it equal flights on SimPy's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import simpy
from radio_examples import CROSS_M, still

from sortie.radio import Air, AirSettings, Transmission
from sortie.radio.event_loop import EventLoop

Told = tuple[float, Transmission | tuple[int, ...]]


def flight(env: simpy.Environment) -> list[Told]:
    """Five drones that send at random moments, some in answer to what ended, with deadlines that some miss."""
    rng, told = np.random.default_rng(3), []
    air = Air(env, AirSettings(bandwidth_mhz=20), still(CROSS_M, 40), seed=2, frame_s=0.1)

    def send(answers: int) -> None:
        s, r = (int(x) for x in rng.permutation(5)[:2])
        size, deadline_s = int(rng.integers(500, 60_000)), float(rng.choice([0.004, 0.1]))
        kind = "f" if rng.random() < 0.5 else "g"
        air.send(s, r, size, kind=kind, reliable=False, deadline_s=deadline_s, on_done=lambda row: done(row, answers))

    def done(row: Transmission, answers: int) -> None:
        told.append((env.now, row))
        if answers:
            later = env.timeout(float(rng.choice([0.0, 1e-3])))
            later.callbacks.append(lambda _: send(answers - 1))

    def frames() -> Iterator[simpy.Event]:
        for _ in range(20):
            air.advance()
            for i in range(5):
                air.broadcast(i, 208, lambda ids: told.append((env.now, tuple(ids))))
            for _ in range(int(rng.integers(1, 12))):
                yield env.timeout(float(rng.random()) * 5e-3)
                send(2)
            yield env.timeout(0.1)

    env.process(frames())
    env.run(until=2.0)
    return told


def test_a_flight_is_the_same_on_both_clocks_and_takes_fewer_events() -> None:
    plain, skipping = simpy.Environment(), EventLoop()
    told = flight(plain)
    assert {row.status.value for _, row in told if isinstance(row, Transmission)} >= {"delivered", "expired"}
    assert repr(flight(skipping)) == repr(told)  # a NaN equals no other
    assert next(skipping._eid) < 0.9 * next(plain._eid)


def test_it_skips_to_a_time_before_which_nothing_is_due() -> None:
    loop, found = EventLoop(), []

    def look(_: simpy.Event) -> None:
        found.extend([loop.skip_to(4.0), loop.skip_to(3.0), loop.skip_to(2.5), loop.now])

    loop.timeout(2.0).callbacks.append(look)
    loop.timeout(3.0)
    loop.run()
    assert found == [False, False, True, 2.5]  # what is due at the very time comes first
    assert loop.now == 3.0


@pytest.mark.parametrize("until", [3.0, 3])
def test_it_does_not_skip_past_the_end_of_a_run(until: float) -> None:
    loop, found = EventLoop(), []
    loop.timeout(2.0).callbacks.append(lambda _: found.extend([loop.skip_to(3.5), loop.skip_to(2.5)]))
    loop.run(until=until)
    assert found == [False, True]
    assert loop.now == 3.0


def test_who_steps_by_hand_sees_every_event() -> None:
    loop, found = EventLoop(), []
    loop.timeout(2.0).callbacks.append(lambda _: found.append(loop.skip_to(2.5)))
    loop.step()
    assert found == [False]
    assert loop.now == 2.0


def test_a_run_that_fails_is_over() -> None:
    loop = EventLoop()
    loop.timeout(1.0).callbacks.append(lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        loop.run()
    assert not loop.skip_to(2.0)
