"""How a sample becomes frames of a rate: lengths, bytes on the wire, traced goodputs, measurements that begin anew."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import simpy
from wrong_rows import wrong_rows

from sortie.radio import Air, Transmission
from sortie.radio.channel.snr import noise_dbm
from sortie.radio.mac.airtime import MPDU_DELIMITER, frame_bytes, repair_wire_bytes, sample_wire
from sortie.radio.mac.contention import SIFS_S, SLOT_S
from sortie.radio.overrides import LinkNow
from sortie.radio.rates import STANDARDS
from sortie.radio.sample import UNUSED, Sample, Service
from sortie.radio.settings import AccessName, AccessSettings, AirSettings, EdcaSettings
from sortie.radio.transmission import Status

CALM = AirSettings(shadowing_sigma_db=0.0)


def service(**settings: object) -> Service:
    made = AirSettings(**settings)
    return Service(made, noise_dbm(made.bandwidth_mhz, made.noise_figure_db))


def test_full_frames_alone_on_a_traced_link_carry_its_goodput_to_the_microsecond() -> None:
    """A wait for the medium (half of the smallest window on average), preamble, frames, answer: payload over that time."""

    def check(access: AccessName, goodput_mbps: float, more: dict[str, Any], around_s: float) -> None:
        c = AirSettings(payload_class=access, **more)
        rate_mbps, frames = service(payload_class=access, **more)._rate_of(goodput_mbps)
        edca = getattr(c.edca, access)
        wait_s = SIFS_S + (edca.aifsn + edca.cw_min / 2) * SLOT_S
        bits = frames * 8 * (frame_bytes(c.fragment_bytes, fragmented=True) + MPDU_DELIMITER)
        took_s = wait_s + STANDARDS["ax"].preamble_s + bits / (rate_mbps * 1e6) + SIFS_S + around_s
        assert frames * c.fragment_bytes * 8e-6 / took_s == pytest.approx(goodput_mbps, rel=1e-6)
        assert 1 <= frames <= c.max_ampdu_frames

    assert (
        wrong_rows(
            [
                (r0, r1, *r2)
                for r0 in ["voice", "best_effort", "background"]
                for r1 in [0.5, 3.0, 24.0, 180.0]
                for r2 in [
                    ({}, 32e-6),
                    # a block ack of more than 64 frames is 24 B longer: two symbols
                    ({"block_ack_window": 256}, 40e-6),
                    ({"block_ack_window": 256, "max_ampdu_frames": 256}, 40e-6),
                    # request and answer of 28 µs each, a SIFS behind each
                    ({"rts": True}, 32e-6 + 2 * 28e-6 + 2 * 16e-6),
                ]
            ],
            check,
        )
        == {}
    )


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

    def check(unreachable: str, frames: int, passes: int) -> None:
        s = sample(3000, 3)
        Service(CALM, -88.0).prepare(s)
        for k in range(passes + 1):
            s.sent_frames, s.sent_before, s.unreachable = 10, 4, unreachable
            if k < passes:
                s.end_pass()
        assert s.row_of(Status.LOST, "", 1.0).wire_bytes == (passes + 1) * frames * 1150

    assert (
        wrong_rows([(*r0, r1) for r0 in [("", 10), ("no_link", 4), ("receiver_gone", 4)] for r1 in [0, 2]], check) == {}
    )


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
    """A loss alone has some rate however weak the signal; a goodput of nothing is no link; nobody there is not no link."""
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


@pytest.mark.parametrize("name", ["voice", "background"])
def test_a_traced_goodput_is_that_of_its_own_class_of_traffic(name: str) -> None:
    """Whose frames wait longer for the medium need a higher data rate for the same goodput."""
    rates = {}
    for payload_class in ("best_effort", name):
        settings = AirSettings(payload_class=payload_class, max_ampdu_frames=4)
        rates[payload_class] = Service(settings, -88.0).use(0, 1, 0.0, 30.0, False, LinkNow(0.0, math.nan, 20.0)).link
    assert (rates[name].rate_mbps < rates["best_effort"].rate_mbps) is (name == "voice")
    assert rates[name].frames == 4
    few = AirSettings(
        standard="n", bandwidth_mhz=20, max_ampdu_frames=256, edca=EdcaSettings(background=AccessSettings(7, 15, 1023))
    )
    assert Service(few, -88.0).use(0, 1, 0.0, 30.0, False, LinkNow(0.0, math.nan, 300.0)).link.frames <= 64


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


def test_a_sample_s_wire_bytes_are_its_frames_and_where_reliable_one_question() -> None:
    """Over a link that loses nothing: every fragment once, and a heartbeat whose answer could name each of them."""

    def check(payload: int) -> None:
        rows: list[Transmission] = []
        env = simpy.Environment()
        still = np.broadcast_to([[0.0, 0.0, 60.0], [10.0, 0.0, 60.0]], (20, 2, 3))
        air = Air(env, AirSettings(shadowing_sigma_db=0.0, tx_power_dbm=30.0), still, seed=1, frame_s=0.1)
        air.advance()
        for reliable in (False, True):
            air.send(0, 1, payload, kind=f"{reliable}", reliable=reliable, deadline_s=1.0, on_done=rows.append)
        env.run(until=0.1)
        fragments, once = sample_wire(payload, 1344)
        assert [(r.status, r.wire_bytes) for r in rows] == [
            (Status.DELIVERED, once),
            (Status.DELIVERED, once + repair_wire_bytes(fragments)),
        ]

    assert wrong_rows([100, 2000, 40 * 1344, 100 * 1344 + 5], check) == {}
