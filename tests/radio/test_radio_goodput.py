"""What a sender knows of its links: measurements, their age, bounds by what waits, and what it reads in flight."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from radio_flights import Hover, trace

from sortie.radio.goodput import RISE, Goodput
from sortie.radio.settings import AirSettings
from sortie.scenarios.link_state import MEASURED_FOR_S, SILENT_MBPS, WAITING_MBPS, LinkState, state_of

CALM = AirSettings(shadowing_sigma_db=0.0)


def test_goodput_falls_at_once_and_rises_by_a_share_of_the_gap() -> None:
    goodput = Goodput(2)
    seen = []
    for k, mbps in enumerate((100.0, 40.0, 80.0, 80.0, 10.0)):
        goodput.measured(0, 1, mbps, 0.1 * k)
        seen.append(goodput.read(0, 0.1 * k)[1])
    first = 40 + RISE * 40
    assert seen == pytest.approx([100.0, 40.0, first, first + RISE * (80 - first), 10.0])
    assert goodput.read(1, 0.4) == {}  # the other direction is another link


def test_a_measurement_counts_for_as_long_as_it_says_and_bounds_no_later_one() -> None:
    """Whether anybody asked in between or not."""
    for asked in (True, False):
        known = Goodput(3)
        known.measured(0, 1, 40.0, 1.0)
        known.measured(0, 2, 10.0, 1.0 + MEASURED_FOR_S)
        if asked:
            assert known.read(0, 1.0 + MEASURED_FOR_S) == {1: 40.0, 2: 10.0}
            assert known.read(0, 1.0 + MEASURED_FOR_S + 1e-6) == {2: 10.0}
        known.measured(0, 2, 60.0, 2.0 + 2 * MEASURED_FOR_S)
        assert known.read(0, 2.0 + 2 * MEASURED_FOR_S) == {2: 60.0}
    late = Goodput(2)
    late.measured(0, 1, 70.0, 1.0)
    late.measured(0, 1, 90.0, 1.0 + MEASURED_FOR_S)
    assert 70.0 < late.read(0, 1.0 + MEASURED_FOR_S)[1] < 90.0


def test_a_wait_bounds_what_is_known_and_says_nothing_of_what_is_not() -> None:
    """Silent means that something was tried and nothing got through; a queue behind another link says less."""
    known, read = Goodput(2), []
    known.bounded(0, 1, 5.0)
    assert known.read(0, 0.0) == {}
    known.measured(0, 1, 20.0, 0.0)
    for bound in (50.0, 4.0, 0.0):
        known.bounded(0, 1, bound)
        read.append(known.read(0, 0.0)[1])
    assert read == [20.0, 4.0, WAITING_MBPS]
    assert state_of(read[-1]) is LinkState.MEASURED
    known.measured(0, 1, 0.0, 0.1)
    known.bounded(0, 1, 3.0)
    assert known.read(0, 0.1)[1] == SILENT_MBPS
    assert state_of(SILENT_MBPS) is LinkState.SILENT


# --- in flight ---------------------------------------------------------------------------------------


def test_goodput_of_a_large_sample_is_its_bits_over_its_time() -> None:
    f = Hover(CALM)
    f.fly(0.1, lambda _: f.send(0, 1, 64 * 1344 * 5))
    (row,) = f.rows
    mbps = row.payload_bytes * 8e-6 / (row.t_done_s - row.t_start_s)
    assert 0.95 * mbps < f.air.goodput_mbps(0)[0] <= mbps  # less backoffs, of which its first exchange had none
    assert f.air.goodput_mbps(1) == (0.0,)  # nothing sent, nothing known


@pytest.mark.parametrize("payload", [50_000, 163_840, 655_360])
def test_a_drop_of_30_db_shows_within_one_frame(payload: int) -> None:
    f, read = Hover(AirSettings(), n=5), {}
    weak = np.zeros((5, 5))
    weak[2, :] = weak[:, 2] = 30.0

    def tick(frame: int) -> None:
        read[frame] = f.air.goodput_mbps(2)
        f.extra = weak if frame >= 19 else None  # in force from frame 20
        send = [(i, (i + j) % 5) for i in range(5) for j in range(1, 5)]
        later = f.env.timeout(0.03)
        later.callbacks.append(lambda _: [f.send(i, j, payload, deadline_s=0.065) for i, j in send])

    f.fly(3.0, tick)
    assert max(read[20]) > 20
    assert max(read[21]) < 5


def test_small_samples_show_that_a_link_has_recovered() -> None:
    f, read = Hover(CALM, n=3), []
    weak = np.array([[0.0, 60.0, 0.0], [0.0] * 3, [0.0] * 3])

    def tick(frame: int) -> None:
        read.append(f.air.goodput_mbps(0)[0])
        f.extra = weak if 9 <= frame < 19 else None  # in force from frame 10 to 20
        if frame % 5 == 0:
            f.send(0, 1, 150, kind="detections")

    f.fly(4.0, tick)
    assert read[9] > 100
    assert read[19] == SILENT_MBPS
    assert read[26] > 5


def test_a_sample_held_up_by_its_own_queue_lowers_the_reading() -> None:
    f, read = Hover(CALM, n=3), []

    def tick(frame: int) -> None:
        read.append(f.air.goodput_mbps(0))
        f.extra = np.array([[0.0, 33.0, 0.0], [0.0] * 3, [0.0] * 3]) if frame == 1 else f.extra
        if frame in (0, 2):
            f.send(0, 1, (100_000, 3_000_000)[frame // 2])
            f.send(0, 2, 100_000)

    f.fly(0.4, tick)
    assert min(read[1]) > 100
    assert max(read[3]) < 5


@pytest.mark.parametrize("payload", [40, 150, 1300, 60_000])
def test_no_goodput_is_above_what_the_link_carries_alone(payload: int) -> None:
    """A lone small frame is acknowledged before a full one would be."""
    flight = Hover(CALM, n=3)
    flight.fly(2.0, lambda k: [flight.send(0, j, payload) for j in (1, 2)])
    flight.air.advance()
    known, carried = flight.air.goodput_mbps(0), flight.air.link_mbps()[0, 1:]
    assert (np.array(known) <= carried * 1.006).all()  # what is carried has paid for a fade in two hundred
    assert min(known) > 0.02 * carried.min()


def test_goodput_over_hops_is_that_of_the_hops_in_sequence(tmp_path: Path) -> None:
    """1 / (1 / 80 + 1 / 20), not the weaker of the two."""
    rows = ["0,0,1,,,80", "0,1,0,,,80", "0,1,2,,,20", "0,2,1,,,20", "0,0,2,,,1", "0,2,0,,,1"]
    flight = Hover(AirSettings(trace=trace(tmp_path, *rows), relay_max_hops=2), n=3)

    def tick(k: int) -> None:
        flight.send(0, 1, 20_000, kind="a")
        flight.send(1, 2, 20_000, kind="b")

    flight.fly(1.0, tick)
    known, onward = flight.air.goodput_mbps(0), flight.air.goodput_mbps(1)[1]
    assert known[1] == pytest.approx(1 / (1 / known[0] + 1 / onward))
    assert 1.0 < known[1] < 0.7 * min(known[0], onward)
