"""How a sample becomes frames of a rate, what a sender knows of its links, and accounts that no look changes."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from radio_flights import Hover, trace
from wrong_rows import wrong_rows

from sortie.radio.channel.snr import noise_dbm
from sortie.radio.goodput import RISE, Goodput
from sortie.radio.mac.airtime import MPDU_DELIMITER, frame_bytes
from sortie.radio.mac.contention import SIFS_S, SLOT_S
from sortie.radio.overrides import LinkNow
from sortie.radio.rates import STANDARDS
from sortie.radio.sample import UNUSED, Sample, Service
from sortie.radio.settings import AccessName, AirSettings
from sortie.radio.transmission import Status
from sortie.scenarios.link_state import MEASURED_FOR_S, SILENT_MBPS, WAITING_MBPS, LinkState, state_of

CALM = AirSettings(shadowing_sigma_db=0.0)


def service(**settings: object) -> Service:
    made = AirSettings(**settings)
    return Service(made, noise_dbm(made.bandwidth_mhz, made.noise_figure_db))


def test_full_frames_alone_on_a_traced_link_carry_its_goodput_to_the_microsecond() -> None:
    """A wait (half of the smallest window on average), preamble, frames, answer: payload over that time."""

    ways = [
        ({}, 32e-6),
        # a block ack of more than 64 frames is 24 B longer: two symbols
        ({"block_ack_window": 256}, 40e-6),
        ({"block_ack_window": 256, "max_ampdu_frames": 256}, 40e-6),
        # request and answer of 28 µs each, a SIFS behind each
        ({"rts": True}, 32e-6 + 2 * 28e-6 + 2 * 16e-6),
    ]

    def check(access: AccessName, goodput_mbps: float, way: tuple[dict[str, Any], float]) -> None:
        more, around_s = way
        c = AirSettings(payload_class=access, **more)
        rate_mbps, frames = service(payload_class=access, **more)._rate_of(goodput_mbps)
        edca = getattr(c.edca, access)
        wait_s = SIFS_S + (edca.aifsn + edca.cw_min / 2) * SLOT_S
        bits = frames * 8 * (frame_bytes(c.fragment_bytes, fragmented=True) + MPDU_DELIMITER)
        took_s = wait_s + STANDARDS["ax"].preamble_s + bits / (rate_mbps * 1e6) + SIFS_S + around_s
        assert frames * c.fragment_bytes * 8e-6 / took_s == pytest.approx(goodput_mbps, rel=1e-6)
        assert 1 <= frames <= c.max_ampdu_frames

    rows = product(("voice", "best_effort", "background"), (0.5, 3.0, 24.0, 180.0), ways)
    assert wrong_rows(rows, check) == {}


def sample(payload: int, fragments: int, piece_bytes: int = 0, *, reliable: bool = False) -> Sample:
    return Sample(
        0, 0, 1, "k", payload, reliable, 0.0, 1.0, lambda row: None, fragments, (0, UNUSED, 20.0, 0), 0.0, piece_bytes
    )


@pytest.mark.parametrize(
    ("payload", "fragments", "piece", "reliable", "left", "frames"),
    [
        # fragments have 150 B around them; in a repair any of three is a fragment still, and may be a long one
        (3000, 3, 0, False, 3, (1494, 462, 3450)),
        (3000, 3, 0, False, 2, (1494, 1494, 2988)),
        (3000, 3, 0, False, 1, (1494, 1494, 1494)),
        # a sample of one frame has 142 B, and so has each piece that is of use alone
        (1000, 1, 0, False, 1, (1142, 1142, 1142)),
        (2500, 3, 1000, False, 3, (1142, 642, 2926)),
        (2500, 3, 1000, False, 2, (1142, 1142, 2284)),
        (700, 1, 1000, False, 1, (842, 842, 842)),
        # a heartbeat and its answer of 268 B take time behind the last frame, and are counted elsewhere
        (1000, 1, 0, True, 1, (1142, 1142 + 268, 1142)),
        (3000, 3, 0, True, 3, (1494, 462 + 268, 3450)),
        (2500, 3, 1000, True, 2, (1142, 1142 + 268, 2284)),
    ],
)
def test_frames_are_as_long_as_what_they_carry(
    payload: int, fragments: int, piece: int, reliable: bool, left: int, frames: tuple[int, int, int]
) -> None:
    """Each frame but the last, the last one, and all of them on the wire, by hand."""
    s = sample(payload, fragments, piece, reliable=reliable)
    s.left = left
    Service(CALM, -88.0).prepare(s)
    assert (s.frames, s.full_bytes, s.last_bytes, s.pass_wire * left) == (left, *frames[:2], pytest.approx(frames[2]))


def test_tries_of_a_dead_link_put_no_bytes_on_the_wire() -> None:
    """Of ten frames four were sent before the link died. Passes that are over count likewise."""

    for (unreachable, frames), passes in product((("", 10), ("no_link", 4), ("receiver_gone", 4)), (0, 2)):
        s = sample(3000, 3)
        Service(CALM, -88.0).prepare(s)
        for k in range(passes + 1):
            s.sent_frames, s.sent_before, s.unreachable = 10, 4, unreachable
            if k < passes:
                s.end_pass()
        assert s.row_of(Status.LOST, "", 1.0).wire_bytes == (passes + 1) * frames * 1150, (unreachable, passes)


def test_pieces_and_fragments_of_one_length_count_for_the_time_that_each_takes() -> None:
    """A piece has a header of its own, and a fragment another: asked for in turn, each gets its own figure."""
    found = []
    for first in (True, False):
        service = Service(CALM, -88.0)
        pieces, fragments = sample(1344 * 60, 60, 1344), sample(1344 * 60, 60)
        for s in (pieces, fragments):
            service.prepare(s)
            s.mcs, s.full_mbps = 3, 50.0
        order = (pieces, fragments) if first else (fragments, pieces)
        figures = {id(s): service.bits_of_a_frame(s) for s in order}
        found.append((figures[id(pieces)], figures[id(fragments)]))
    assert found[0] == found[1]
    assert found[0][0] != found[0][1]


def test_what_a_link_is_used_at_follows_what_stands_beside_the_models() -> None:
    """A loss alone has some rate however weak the signal; a goodput of nothing is no link."""
    service = Service(CALM, -88.0)
    nan = math.nan

    def use(snr_db: float, given: LinkNow | None, gone: bool = False) -> Any:
        return service.use(0, 1, 0.0, snr_db, gone, given)

    assert use(-50.0, None).unreachable == "no_link"
    assert use(-50.0, LinkNow(0.0, 0.3, nan)).link[:2] == (0, False)
    assert use(-50.0, LinkNow(0.3, nan, nan)).unreachable == "no_link"
    assert use(50.0, LinkNow(0.0, nan, 0.0)).unreachable == "no_link"
    assert use(50.0, None, gone=True).unreachable == "receiver_gone"
    assert use(50.0, LinkNow(0.1, nan, nan)).link.burst_loss == 0.1
    assert math.isnan(use(50.0, None).link.loss)
    lossless = service.link_mbps(np.array([[-50.0]]), np.array([[0.0]]))
    assert 25.0 < float(lossless[0, 0]) < STANDARDS["ax"].rates_mbps[80][0], "payload at the lowest rate"


def test_a_measurement_begins_anew_with_another_rate_alone() -> None:
    service = Service(CALM, -88.0)
    s = sample(3000, 3)
    good, weak = (service.use(0, 1, 0.0, db, False) for db in (40.0, 12.0))
    s.use = 0, good, 40.0, 0
    service.begin(s, 1.0)
    s.mark_bits = 500.0
    s.use = 0, good, 39.0, 1
    service.begin(s, 2.0, fresh=False)
    assert (s.mark_s, s.mark_bits, s.snr_db, s.t_first_s) == (1.0, 500.0, 39.0, 1.0)
    s.use = 0, weak, 12.0, 2
    service.begin(s, 3.0, fresh=False)
    assert (s.mark_s, s.mark_bits, s.t_first_s, s.begun_s) == (3.0, 0.0, 1.0, 1.0)
    s.forward(1, 2, 4.0, 77.0)
    assert (s.t_queued_s, s.drained_bits, s.hops, s.t_sent_s) == (4.0, 77.0, 2, 0.0)
    assert s.row_of(Status.LOST, "no_link", 5.0).sender == 0


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


CLEAR = AirSettings(shadowing_sigma_db=0.0, rician_k_db=40.0)


LONG = replace(CLEAR, tx_power_dbm=36.0, retry_limit=0, max_ampdu_frames=256, block_ack_window=256, fragment_bytes=64)
"""Many small fragments in each transmission, tried once."""


BYTES = 64 * 20_000


def lossy(folder: Path, loss: float) -> str:
    return trace(folder, f"0,0,1,,{loss},", "0,1,0,,0,")


def test_more_fragments_may_be_given_up_than_a_run_keeps(tmp_path: Path) -> None:
    """Ten to eighteen thousand between two looks: each is counted once, and none of them has arrived."""

    def check(loss: float, looks: int) -> None:
        fleet = Hover(replace(LONG, trace=lossy(tmp_path, loss)))

        def tick(frame: int) -> None:
            if frame == 0:
                fleet.send(0, 1, BYTES, deadline_s=0.95, piece_bytes=64)
                for k in range(looks):
                    fleet.env.timeout(0.01 * (k + 1)).callbacks.append(lambda _: fleet.air.goodput_mbps(0))

        (row,) = fleet.fly(1.0, tick).rows
        assert row.status is Status.PARTIAL
        assert row.fragments_lost + row.arrived_bytes // 64 == row.fragments == 20_000
        assert row.fragments_lost == pytest.approx(loss * 20_000, abs=4 * np.sqrt(loss * (1 - loss) * 20_000))

    assert wrong_rows(product([0.5, 0.9], [0, 3]), check) == {}


@pytest.mark.parametrize("piece_bytes", [1344, None])
def test_fragments_lost_do_not_depend_on_who_looks(piece_bytes: int | None, tmp_path: Path) -> None:
    settings = replace(CLEAR, trace=lossy(tmp_path, 0.8))
    found = set()
    for looks in (0, 10, 100):
        fleet = Hover(settings)

        def tick(frame: int, fleet: Hover = fleet, looks: int = looks) -> None:
            if frame == 0:
                fleet.send(0, 1, 1344 * 300, deadline_s=0.95, piece_bytes=piece_bytes)
            for k in range(looks):
                fleet.env.timeout(0.1 * k / looks).callbacks.append(lambda _: fleet.air.goodput_mbps(0))

        (row,) = fleet.fly(1.0, tick).rows
        found.add((row.fragments_lost, row.arrived_bytes, row.t_done_s))
    ((lost, arrived, _),) = found
    assert lost > 10
    assert arrived == ((300 - lost) * 1344 if piece_bytes else 0)


def test_what_was_sent_before_a_link_dies_or_its_receiver_goes_stays_counted() -> None:
    for reason, piece_bytes in (("no_link", 1344), ("no_link", None), ("receiver_gone", 1344)):
        fleet = Hover(replace(CLEAR, bandwidth_mhz=20)).fly(0.1)
        fleet.send(0, 1, 1344 * 2000, deadline_s=0.9, piece_bytes=piece_bytes)
        fleet.env.run(until=0.15)
        if reason == "receiver_gone":
            fleet.air.silence(1)
        for until_s in (0.2, 0.3):
            fleet.air.advance(np.full((2, 2), 200.0))
            fleet.env.run(until=until_s)
        (row,) = fleet.rows
        assert (row.status, row.reason) == (Status.PARTIAL if piece_bytes else Status.LOST, reason)
        assert row.wire_bytes >= max(row.arrived_bytes, 300_000), reason
        assert (row.arrived_bytes > 300_000) == bool(piece_bytes)
        assert fleet.air.counters.data_wire_bytes == row.wire_bytes
