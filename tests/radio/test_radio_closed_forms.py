"""Closed forms of what the radio's wrappers make: bytes of repairs, rates of traced goodputs, grids, earshot, expiry."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import simpy

from sortie.radio import Air, Transmission
from sortie.radio.channel.draws import fade_table_db
from sortie.radio.channel.pathloss import path_loss_db
from sortie.radio.channel.snr import earshot_m, noise_dbm
from sortie.radio.goodput import Goodput
from sortie.radio.mac.airtime import MPDU_DELIMITER, frame_bytes, repair_wire_bytes, sample_wire
from sortie.radio.mac.contention import SIFS_S, SLOT_S
from sortie.radio.rates import CURVES, STANDARDS, group_curve, rate_table, snr_index
from sortie.radio.sample import Service
from sortie.radio.settings import AccessName, AirSettings
from sortie.radio.transmission import Status
from sortie.scenarios.link_state import MEASURED_FOR_S


def service(**settings: object) -> Service:
    made = AirSettings(**settings)  # type: ignore[arg-type]
    return Service(made, noise_dbm(made.bandwidth_mhz, made.noise_figure_db))


@pytest.mark.parametrize("access", ["voice", "best_effort", "background"])
@pytest.mark.parametrize("goodput_mbps", [0.5, 3.0, 24.0, 180.0])
@pytest.mark.parametrize(
    ("more", "around_s"),
    [
        ({}, 32e-6),
        # a block ack of more than 64 frames is 24 B longer: two symbols
        ({"block_ack_window": 256}, 40e-6),
        ({"block_ack_window": 256, "max_ampdu_frames": 256}, 40e-6),
        # request and answer of 28 µs each, a SIFS behind each
        ({"rts": True}, 32e-6 + 2 * 28e-6 + 2 * 16e-6),
    ],
)
def test_full_frames_alone_on_a_traced_link_carry_its_goodput_to_the_microsecond(
    goodput_mbps: float, access: AccessName, more: dict[str, Any], around_s: float
) -> None:
    """A wait for the medium (half of the smallest window on average), preamble, frames, answer: payload over that time."""
    c = AirSettings(payload_class=access, **more)
    rate_mbps, frames = service(payload_class=access, **more)._rate_of(goodput_mbps)
    edca = getattr(c.edca, access)
    wait_s = SIFS_S + (edca.aifsn + edca.cw_min / 2) * SLOT_S
    bits = frames * 8 * (frame_bytes(c.fragment_bytes, fragmented=True) + MPDU_DELIMITER)
    took_s = wait_s + STANDARDS["ax"].preamble_s + bits / (rate_mbps * 1e6) + SIFS_S + around_s
    assert frames * c.fragment_bytes * 8e-6 / took_s == pytest.approx(goodput_mbps, rel=1e-6)
    assert 1 <= frames <= c.max_ampdu_frames


@pytest.mark.parametrize("payload", [100, 1344, 5000, 60_000])
@pytest.mark.parametrize("piece", [0, 500])
def test_a_reliable_sample_s_last_frame_asks_whether_all_came(payload: int, piece: int) -> None:
    """It carries a heartbeat; all else is as without. Wire bytes of the samples' own frames are the same."""
    fragments = math.ceil(payload / (piece or 1344))
    for left in {fragments, max(1, fragments - 2), 1}:
        plain, reliable = (service()._pass(payload, fragments, left, piece, kind) for kind in (False, True))
        assert reliable[1] - plain[1] == repair_wire_bytes(1)
        assert (reliable[0], reliable[2]) == (plain[0], plain[2])


def test_a_repair_names_each_fragment_that_it_may_ask_for() -> None:
    """A bit of a word of 32 for each, up to 256."""
    sizes = [repair_wire_bytes(lost) - repair_wire_bytes(1) for lost in (1, 32, 33, 64, 65, 256, 257, 4000)]
    assert sizes == [0, 0, 4, 4, 8, 28, 28, 28]


@pytest.mark.parametrize("snr_db", [-7.013, 0.026, 3.0, 11.349, 29.874])
def test_a_rate_table_is_read_at_the_nearest_of_its_points(snr_db: float) -> None:
    at_db = -20.0 + 0.05 * snr_index(snr_db)
    assert abs(at_db - snr_db) <= 0.025 + 1e-9
    table = rate_table(80, 12.0)
    assert table.at(snr_db) == table.at(at_db)
    assert snr_index(-500.0) == 0
    assert snr_index(500.0) == len(table.mcs) - 1


@pytest.mark.parametrize("sigma_db", [0.0, 3.5])
@pytest.mark.parametrize("group_mbps", [6.0, 24.0])
@pytest.mark.parametrize("bandwidth_mhz", [20, 40, 80])
def test_out_of_earshot_the_luckiest_frame_of_either_kind_fails(
    bandwidth_mhz: int, group_mbps: float, sigma_db: float
) -> None:
    """A group frame fills 20 MHz with all of its power, a unicast one the channel: each is 2 dB short of half of its frames."""
    c = AirSettings(bandwidth_mhz=bandwidth_mhz, group_rate_mbps=group_mbps, shadowing_sigma_db=sigma_db)
    lucky_dbm = c.tx_power_dbm + 5 * sigma_db + float(fade_table_db(c.rician_k_db)[-1])
    received_dbm = lucky_dbm - float(path_loss_db(c, earshot_m(c), 60.0, 60.0))
    short_db = (
        group_curve(group_mbps).snr_db(0.5) - (received_dbm - noise_dbm(20, c.noise_figure_db)),
        CURVES[0].snr_db(0.5) - (received_dbm - noise_dbm(bandwidth_mhz, c.noise_figure_db)),
    )
    assert min(short_db) == pytest.approx(2.0)


def test_a_measurement_that_is_too_old_bounds_no_new_one() -> None:
    """Whether anybody asked in between or not."""
    asked, unasked = Goodput(2), Goodput(2)
    for links in (asked, unasked):
        links.measured(0, 1, 70.0, 1.0)
    asked.read(0, 2.0 + MEASURED_FOR_S)
    for links in (asked, unasked):
        links.measured(0, 1, 90.0, 10.0)
        assert links.read(0, 10.0)[1] == 90.0
    late = Goodput(2)
    late.measured(0, 1, 70.0, 1.0)
    late.measured(0, 1, 90.0, 1.0 + MEASURED_FOR_S)
    assert 70.0 < late.read(0, 1.0 + MEASURED_FOR_S)[1] < 90.0
    assert np.isfinite(list(late.read(0, 4.0).values())).all()


@pytest.mark.parametrize("payload", [100, 2000, 40 * 1344, 100 * 1344 + 5])
def test_a_sample_s_wire_bytes_are_its_frames_and_where_reliable_one_question(payload: int) -> None:
    """Over a link that loses nothing: every fragment once, and a heartbeat whose answer could name each of them."""
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
        (Status.DELIVERED, once), (Status.DELIVERED, once + repair_wire_bytes(fragments)),
    ]  # fmt: skip
