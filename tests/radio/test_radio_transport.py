"""Samples and pieces on a lossy link: the published table, repair, what arrives in part."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from radio_flights import Hover, trace
from scipy import stats

from sortie.radio import Status
from sortie.radio.mac.airtime import sample_wire
from sortie.radio.settings import AirSettings


def lossy(folder: Path, loss: float, goodput_mbps: float | None = 400.0, **knobs) -> AirSettings:
    """A link from drone 0 to 1 of that goodput which loses every `loss`-th frame, and no retries."""
    name = trace(folder, f"0,0,1,,{loss},{'' if goodput_mbps is None else goodput_mbps}")
    return AirSettings(trace=name, **{"retry_limit": 0, **knobs})


TABLE = [(488, 0.614), (122, 0.885), (10, 0.990), (1, 0.999)]
"""Fragments, and the share of samples that arrive at q = 0.001 (FACTS)."""


@pytest.mark.parametrize(("k", "published"), TABLE)
def test_one_lost_fragment_loses_a_best_effort_sample(k: int, published: float, tmp_path: Path) -> None:
    flight = Hover(lossy(tmp_path, 1e-3, fragment_bytes=1344))
    flight.fly(400.0, lambda frame: flight.send(0, 1, k * 1344))
    arrived, sent = sum(r.status is Status.DELIVERED for r in flight.rows), len(flight.rows)
    assert sent >= 3999
    assert (1 - 1e-3) ** k == pytest.approx(published, abs=5e-4)
    assert stats.binomtest(arrived, sent, (1 - 1e-3) ** k).pvalue > 1e-3
    assert {r.reason for r in flight.rows} <= {"", "fragment_lost"}


def test_repair_brings_back_what_a_heartbeat_finds_missing(tmp_path: Path) -> None:
    config = lossy(tmp_path, 0.05, heartbeat_s=0.01, nack_delay_s=0.003)
    flight = Hover(config)
    flight.fly(100.0, lambda frame: flight.send(0, 1, 40 * 1344, reliable=True))
    rounds = Counter(r.repairs for r in flight.rows)
    whole = [r for r in flight.rows if r.status is Status.DELIVERED]
    assert len(whole) == len(flight.rows) == 1000
    assert stats.binomtest(rounds[0], 1000, 0.95**40).pvalue > 1e-3
    through_1 = (1 - 0.05**2) ** 40 - 0.95**40  # what two tries bring and one does not
    assert stats.binomtest(rounds[1], 1000, through_1).pvalue > 1e-3
    once = sample_wire(40 * 1344, 1344)[1]
    for r in whole:
        assert r.t_done_s - r.t_sent_s >= r.repairs * 0.013
        lost = r.fragments_lost
        assert r.repairs == 0 or once + lost * 1344 < r.wire_bytes <= once + lost * 1494 + (r.repairs + 1) * 300
    short = Hover(config)
    short.fly(20.0, lambda frame: short.send(0, 1, 40 * 1344, reliable=True, deadline_s=0.012))
    assert {(r.status, r.reason) for r in short.rows if r.fragments_lost} == {(Status.EXPIRED, "deadline_in_service")}


@pytest.mark.parametrize(("heartbeat_s", "nack_delay_s"), [(0.02, 0.005), (0.05, 0.03), (0.0, 0.04)])
def test_a_repair_waits_for_the_heartbeat_and_the_answer(
    heartbeat_s: float, nack_delay_s: float, tmp_path: Path
) -> None:
    """Both, in every round."""
    file = trace(tmp_path, "0,0,1,,0.5,", "0,1,0,,0.5,")
    config = AirSettings(trace=file, retry_limit=0, heartbeat_s=heartbeat_s, nack_delay_s=nack_delay_s)
    flight = Hover(config)
    flight.fly(6.0, lambda k: flight.send(0, 1, 6000, reliable=True, deadline_s=0.95) if k % 10 == 0 else None)
    repaired = [r for r in flight.rows if r.repairs and r.status == "delivered"]
    assert len(repaired) >= 3
    for r in repaired:
        took_s = r.t_done_s - r.t_start_s
        waits_s = r.repairs * (heartbeat_s + nack_delay_s)
        assert waits_s <= took_s < waits_s + 0.01 * (r.repairs + 1)


def test_keep_last_1_replaces_what_is_not_through(tmp_path: Path) -> None:
    flight = Hover(lossy(tmp_path, 1.0, goodput_mbps=None, heartbeat_s=0.02))
    flight.fly(3.0, lambda frame: flight.send(0, 1, 1000, reliable=True, deadline_s=5.0))
    assert {(r.status, r.reason) for r in flight.rows} == {(Status.EXPIRED, "replaced")}
    assert all(r.t_done_s - r.t_sent_s == pytest.approx(0.1) for r in flight.rows)


@pytest.mark.parametrize("loss", [0.01, 0.1, 0.5])
def test_pieces_arrive_one_by_one(loss: float, tmp_path: Path) -> None:
    flight = Hover(lossy(tmp_path, loss))
    flight.fly(50.0, lambda frame: flight.send(0, 1, 128 * 1336, piece_bytes=1336))
    arrived = np.array([r.arrived_bytes for r in flight.rows]) / 1336
    assert arrived.sum() == pytest.approx(500 * 128 * (1 - loss), abs=4 * np.sqrt(500 * 128 * loss * (1 - loss)))
    assert stats.chisquare(_places(flight), np.full(8, np.mean(_places(flight)))).pvalue > 1e-3
    whole = sum(r.status is Status.DELIVERED for r in flight.rows)
    assert stats.binomtest(whole, 500, (1 - loss) ** 128).pvalue > 1e-3
    assert {r.status for r in flight.rows} <= {Status.DELIVERED, Status.PARTIAL}


def _places(flight: Hover) -> np.ndarray:
    """How often a piece was missing, by eighths of the sample."""
    missing = np.concatenate([r.missing for r in flight.rows])
    return np.bincount((missing // 16).astype(int), minlength=8)


def test_a_deadline_cuts_pieces_short_and_the_first_are_there(tmp_path: Path) -> None:
    flight = Hover(lossy(tmp_path, 0.0, goodput_mbps=20.0))
    flight.fly(3.0, lambda frame: flight.send(0, 1, 400 * 1336, piece_bytes=1336, deadline_s=0.065))
    rows = flight.rows
    assert {(r.status, r.reason) for r in rows} == {(Status.PARTIAL, "deadline_in_service")}
    for r in rows:
        came = 400 - len(r.missing)
        assert r.missing == tuple(range(came, 400))
        assert r.arrived_bytes == came * 1336
        assert came == pytest.approx(20e6 * 0.065 / 8 / 1344, rel=0.05)  # as many as go in that time


def test_pieces_sent_before_the_link_went_are_there(tmp_path: Path) -> None:
    links = trace(tmp_path, "0,0,1,,,20", "0.19,0,1,,,20", "0.2,0,1,,,0")
    flight = Hover(AirSettings(trace=links))
    flight.fly(1.0, lambda frame: flight.send(0, 1, 400 * 1336, piece_bytes=1336, deadline_s=1.0) if frame == 1 else 0)
    (row,) = flight.rows
    assert (row.status, row.reason) == (Status.PARTIAL, "no_link")
    came = 400 - len(row.missing)
    assert row.missing == tuple(range(came, 400))
    assert came == pytest.approx(20e6 * 0.1 / 8 / 1344, rel=0.05)


def test_samples_that_are_cut_short_bring_nothing(tmp_path: Path) -> None:
    flight = Hover(lossy(tmp_path, 0.0, goodput_mbps=20.0))
    flight.fly(3.0, lambda frame: flight.send(0, 1, 400 * 1336, deadline_s=0.065))
    assert {(r.status, r.arrived_bytes) for r in flight.rows} == {(Status.EXPIRED, 0)}


def test_reliable_pieces_come_back_and_the_sample_is_whole(tmp_path: Path) -> None:
    flight = Hover(lossy(tmp_path, 0.2))
    flight.fly(10.0, lambda frame: flight.send(0, 1, 100 * 1336 + 10, piece_bytes=1336, reliable=True, deadline_s=0.5))
    done = [r for r in flight.rows if r.reason != "replaced"]
    assert {r.status for r in done} == {Status.DELIVERED}
    assert all(r.arrived_bytes == 133_610 and r.missing == () and r.repairs > 0 for r in done)
