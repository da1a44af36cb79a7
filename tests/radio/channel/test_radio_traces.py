"""Link traces: read with care, and flown in place of the models."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from radio_flights import Hover, trace

from sortie.radio import Status
from sortie.radio.channel.traces import read_links
from sortie.radio.settings import AirSettings, BurstSettings
from sortie.scenarios.traces import TraceError


def test_csv_and_parquet_say_the_same(tmp_path: Path) -> None:
    csv = trace(tmp_path, "0,0,1,10,0.1,", "10,0,1,20,,", "0,1,0,,,50")
    parquet = tmp_path / "links.parquet"
    nan = float("nan")
    columns = {"t_s": [0, 10, 0], "sender": [0, 0, 1], "receiver": [1, 1, 0], "snr_db": [10, 20, nan]}
    columns |= {"loss": [0.1, nan, nan], "goodput_mbps": [nan, nan, 50.0]}
    pq.write_table(pa.table(columns), parquet)
    for t_s in (-1.0, 0.0, 2.5, 10.0, 99.0):
        for a, b in zip(read_links(csv, 2).at(t_s, 3), read_links(parquet, 2).at(t_s, 3), strict=True):
            np.testing.assert_array_equal(a, b)


def test_values_run_linearly_and_hold_at_the_ends(tmp_path: Path) -> None:
    links = read_links(trace(tmp_path, "5,0,1,10,,", "15,0,1,30,0.5,"), 2)
    assert [links.at(t_s, 2).snr_db[0, 1] for t_s in (0, 5, 10, 15, 99)] == [10, 10, 20, 30, 30]
    assert links.at(0, 2).loss[0, 1] == 0.5  # its one value holds
    assert np.isnan(links.at(0, 2).snr_db[1, 0])
    assert np.isnan(links.at(0, 2).goodput_mbps).all()


def test_a_goodput_without_a_loss_loses_nothing_or_all(tmp_path: Path) -> None:
    links = read_links(trace(tmp_path, "0,0,1,,,20", "0,1,0,,,0", "0,0,2,,0.3,20"), 3)
    assert [links.at(0, 3).loss[e] for e in ((0, 1), (1, 0), (0, 2))] == [0.0, 1.0, 0.3]


BROKEN = [
    (("0,0,0,1,,",), "sender and receiver in row 1 are both drone 0"),
    (("0,0,7,1,,",), "receiver in row 1 is 7, must be below fleet.drones = 5"),
    (("0,0.5,1,1,,",), "sender in row 1 is 0.5, must be a whole number"),
    (("1,0,1,1,,", "1,0,1,2,,"), "t_s in row 2 of link 0 to 1 is 1, must increase"),
    (("0,0,1,,1.2,",), "loss in row 1 is 1.2, must be within 0 … 1"),
    (("0,0,1,,,-3",), "goodput_mbps in row 1 is -3, must be within 0 … 10000"),
    ((",0,1,,,3",), "t_s in row 1 is nan, must be within 0 … 86400"),
]


@pytest.mark.parametrize(("rows", "message"), BROKEN)
def test_what_is_wrong_is_named(rows: tuple[str, ...], message: str, tmp_path: Path) -> None:
    path = trace(tmp_path, *rows)
    with pytest.raises(TraceError) as caught:
        read_links(path, 5)
    assert str(caught.value) == f"{path}: {message}"


def test_a_trace_has_ends_and_a_quality(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="no column receiver, a trace needs t_s, sender, receiver"):
        read_links(trace(tmp_path, "0,0,1", columns="t_s,sender,snr_db"), 5)
    with pytest.raises(TraceError, match="no row has a value of snr_db, loss or goodput_mbps"):
        read_links(trace(tmp_path, "0,0,1", columns="t_s,sender,receiver"), 5)
    with pytest.raises(TraceError, match="no row has a value of snr_db, loss or goodput_mbps"):
        read_links(trace(tmp_path, "0,0,1,,,"), 5)


# --- flown ---------------------------------------------------------------------------------------------


def test_a_traced_snr_replaces_the_models_and_events_act_on_it(tmp_path: Path) -> None:
    flight = Hover(AirSettings(trace=trace(tmp_path, "0,0,1,12,,", "10,0,1,22,,")), n=3)
    seen = []

    def tick(frame: int) -> None:
        flight.extra = np.full((3, 3), 5.0) if frame == 49 else None  # felt in frame 50
        seen.append(flight.air.snr_db.copy())

    flight.fly(10.0, tick)
    assert [s[0, 1] for s in seen[::25]] == pytest.approx([12.0, 14.5, 17.0 - 5.0, 19.5])
    plain = Hover(AirSettings(), n=3)
    plain.fly(10.0, lambda frame: None)
    assert seen[-1][1, 0] == plain.air.snr_db[1, 0]  # nobody traced the way back


def test_a_traced_goodput_is_what_a_link_carries(tmp_path: Path) -> None:
    flight = Hover(AirSettings(trace=trace(tmp_path, "0,0,1,,,24")))
    flight.fly(10.0, lambda frame: flight.send(0, 1, 150_000, kind=f"{frame}"))
    took_s = [r.t_done_s - r.t_start_s for r in flight.rows if r.status is Status.DELIVERED]
    assert np.mean(took_s) == pytest.approx(150_000 * 8 / 24e6, rel=0.03)
    assert flight.air.goodput_mbps(0)[0] == pytest.approx(24.0, rel=0.03)


@pytest.mark.parametrize("frames", [16, 64])
def test_a_traced_goodput_holds_with_rts(frames: int, tmp_path: Path) -> None:
    """RTS and CTS are within it, also where A-MPDUs take some two milliseconds."""
    settings = AirSettings(trace=trace(tmp_path, "0,0,1,,,80"), rts=True, max_ampdu_frames=frames)
    flight = Hover(settings)
    flight.fly(4.0, lambda frame: flight.send(0, 1, 640 * 1344, kind=f"{frame}"))
    took_s = [r.t_done_s - r.t_start_s for r in flight.rows if r.status is Status.DELIVERED]
    assert np.mean(took_s) == pytest.approx(640 * 1344 * 8 / 80e6, rel=0.008)


def test_no_goodput_is_no_link(tmp_path: Path) -> None:
    flight = Hover(AirSettings(trace=trace(tmp_path, "0,0,1,,,0")))

    def tick(frame: int) -> None:
        flight.send(0, 1, 1000)
        flight.publish(0)

    flight.fly(2.0, tick)
    assert {(r.status, r.reason) for r in flight.rows} == {(Status.LOST, "no_link")}
    assert {ids for _, _, ids in flight.heard} == {()}


def test_a_traced_loss_replaces_fading_and_bursts(tmp_path: Path) -> None:
    config = AirSettings(
        trace=trace(tmp_path, "0,0,1,,0.25,"), bursts=BurstSettings(good_to_bad=1.0, bad_to_good=0.01), tx_power_dbm=-20
    )
    flight = Hover(config, n=3)
    flight.fly(400.0, lambda frame: flight.publish(0))
    share = np.mean([1 in ids for _, _, ids in flight.heard])
    assert share == pytest.approx(0.75, abs=0.03)
    assert not any(2 in ids for _, _, ids in flight.heard)  # an untraced link has its bursts


def test_descriptors_on_a_traced_snr_fade_as_the_models_do(tmp_path: Path) -> None:
    config = AirSettings(
        tx_power_dbm=-10.5, noise_figure_db=12.0, shadowing_sigma_db=0.0, preamble_detection_dbm=-120.0
    )
    model = Hover(config)
    model.fly(300.0, lambda frame: model.publish(0))
    snr_db = float(model.air.snr_db[0, 1])
    traced = Hover(replace(config, trace=trace(tmp_path, f"0,0,1,{snr_db},,")))
    traced.fly(300.0, lambda frame: traced.publish(0))
    shares = [np.mean([bool(ids) for _, _, ids in f.heard]) for f in (model, traced)]
    assert 0.2 < shares[0] < 0.95
    assert shares[1] == pytest.approx(shares[0], abs=4 * np.sqrt(2 * 0.25 / 3000))
