"""What stands beside the models: link traces, bursts, and losses and jammers that act on either."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from radio_examples import CROSS_M
from radio_flights import Hover, trace
from wrong_rows import wrong_rows

from sortie.radio import Status
from sortie.radio.channel.bursts import PairStates, bad_share, mean_loss, walk
from sortie.radio.channel.traces import LinkTrace, read_links
from sortie.radio.overrides import Overrides
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


WHOLE = "t_s,sender,receiver,snr_db,loss,goodput_mbps"
BROKEN = [
    (WHOLE, ("0,0,0,1,,",), "sender and receiver in row 1 are both drone 0"),
    (WHOLE, ("0,0,7,1,,",), "receiver in row 1 is 7, must be below fleet.drones = 5"),
    (WHOLE, ("0,0.5,1,1,,",), "sender in row 1 is 0.5, must be a whole number"),
    (WHOLE, ("1,0,1,1,,", "1,0,1,2,,"), "t_s in row 2 of link 0 to 1 is 1, must increase"),
    (WHOLE, ("0,0,1,,1.2,",), "loss in row 1 is 1.2, must be within 0 … 1"),
    (WHOLE, ("0,0,1,,,-3",), "goodput_mbps in row 1 is -3, must be within 0 … 10000"),
    (WHOLE, (",0,1,,,3",), "t_s in row 1 is nan, must be within 0 … 86400"),
    (WHOLE, ("0,0,1,,,",), "no row has a value of snr_db, loss or goodput_mbps"),
    ("t_s,sender,snr_db", ("0,0,1",), "no column receiver, a trace needs t_s, sender, receiver"),
    ("t_s,sender,receiver", ("0,0,1",), "no row has a value of snr_db, loss or goodput_mbps"),
]


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    def check(columns: str, rows: tuple[str, ...], message: str) -> None:
        path = trace(tmp_path, *rows, columns=columns)
        with pytest.raises(TraceError, match=re.escape(f"{path}: {message}")):
            read_links(path, 5)

    assert wrong_rows(BROKEN, check) == {}


CALM = AirSettings(shadowing_sigma_db=0.0, rician_k_db=40.0)

# --- beside the models ---------------------------------------------------------------------------------


def overrides(trace: LinkTrace | None = None, n: int = 3, **bursts: float) -> Overrides:
    settings = AirSettings(bursts=BurstSettings(**bursts))
    return Overrides(settings, trace, n, seed=2, replication=0, frame_s=0.1)


def link_trace(**qualities: tuple[list[float], list[float]]) -> LinkTrace:
    """A trace of the link from 0 to 1."""
    return LinkTrace({(0, 1): {name: (np.array(t), np.array(v)) for name, (t, v) in qualities.items()}})


def traced(tmp_path: Path, *rows: str, n: int = 3) -> Overrides:
    file = trace(tmp_path, *rows, columns="t_s,sender,receiver,snr_db,loss,goodput_mbps")
    settings = AirSettings(trace=file)
    return Overrides(settings, read_links(file, n), n, seed=1, replication=0, frame_s=0.1)


def test_losses_and_jammers_act_on_a_traced_link_as_on_a_modelled_one(tmp_path: Path) -> None:
    """By sender and receiver for a loss, by receiver for a jammer; known one frame later."""
    over = traced(tmp_path, "0,0,1,30,,", "0,1,0,25,,", "0,1,2,20,,")
    extra, rise = np.arange(9.0).reshape(3, 3), np.array([1.0, 5.0, 11.0])
    model = np.full((3, 3), -50.0)
    over.advance(None)
    assert over.snr_of(0, 1, -9.0, -8.0) == (30.0, 30.0)
    over.advance(extra, rise)
    wanted = {(0, 1): 30 - 1 - 5, (1, 0): 25 - 3 - 1, (1, 2): 20 - 5 - 11}
    for (i, j), snr_db in wanted.items():
        assert over.snr_db(model)[i, j] == snr_db
        assert over.snr_of(i, j, -9.0, -8.0) == ({(0, 1): 30.0, (1, 0): 25.0, (1, 2): 20.0}[i, j], snr_db)
        assert over.known_snr_db(model)[i, j] == {(0, 1): 30.0, (1, 0): 25.0, (1, 2): 20.0}[i, j]
    assert over.snr_of(2, 0, -9.0, -8.0) == (-9.0, -8.0)  # not traced
    over.advance(None)
    for (i, j), snr_db in wanted.items():
        assert over.known_snr_db(model)[i, j] == snr_db
        assert over.snr_of(i, j, 0.0, 0.0)[0] == snr_db


def test_losses_and_jammers_that_the_air_is_told_of_reach_traced_links(tmp_path: Path) -> None:
    """The same through the air as for the links alone, beside modelled ones, and only while they last."""
    links = trace(tmp_path, "0,0,1,30,,", "0,1,0,25,,")
    flight = Hover(AirSettings(shadowing_sigma_db=0.0, trace=links), n=3)
    jammers, extra = [((0.0, 30.0, 60.0), 10.0)], np.arange(9.0).reshape(3, 3)
    flight.air.advance()
    plain = flight.air.snr_db
    assert (plain[0, 1], plain[1, 0]) == (30.0, 25.0)
    for loss, by in ((extra, ()), (None, jammers), (extra, jammers), (None, ())):
        flight.air.advance(loss, by)
        rise = flight.air.channel.noise_rise_db(by)
        assert (rise > 1.0).all() == bool(by)
        lost = plain - flight.air.snr_db
        wanted = rise[None] + (0.0 if loss is None else loss)
        off = ~np.eye(3, dtype=bool)
        np.testing.assert_allclose(lost[off], np.broadcast_to(wanted, (3, 3))[off], atol=1e-9)


def test_a_traced_loss_stands_in_place_of_bursts() -> None:
    lossy = overrides(link_trace(loss=([0.0], [0.2])), loss_good=0.5)
    lossy.advance(None)
    assert lossy.group_loss()[0, 1] == 0.2
    assert lossy.group_loss()[1, 0] == 0.5
    assert lossy.link(0, 1) == (0.5, 0.2, pytest.approx(math.nan, nan_ok=True))


@pytest.mark.parametrize(
    ("bursts", "wanted"), [({"loss_good": 0.1}, True), ({"good_to_bad": 0.1}, True), ({"loss_bad": 1.0}, False)]
)
def test_good_pairs_that_lose_are_bursts_too(bursts: dict[str, float], wanted: bool) -> None:
    assert Overrides.wanted(AirSettings(bursts=BurstSettings(**bursts))) is wanted
    both = overrides(**bursts)
    both.advance(None)
    if "good_to_bad" not in bursts:
        assert bool(both.group_loss()[0, 1]) is wanted


# --- flown ---------------------------------------------------------------------------------------------


def test_a_traced_goodput_is_what_a_link_carries(tmp_path: Path) -> None:
    flight = Hover(AirSettings(trace=trace(tmp_path, "0,0,1,,,24")))
    flight.fly(10.0, lambda frame: flight.send(0, 1, 150_000, kind=f"{frame}"))
    took_s = [r.t_done_s - r.t_start_s for r in flight.rows if r.status is Status.DELIVERED]
    assert np.mean(took_s) == pytest.approx(150_000 * 8 / 24e6, rel=0.03)
    assert flight.air.goodput_mbps(0)[0] == pytest.approx(24.0, rel=0.03)


def test_a_traced_loss_replaces_fading_and_bursts(tmp_path: Path) -> None:
    config = AirSettings(
        trace=trace(tmp_path, "0,0,1,,0.25,"), bursts=BurstSettings(good_to_bad=1.0, bad_to_good=0.01), tx_power_dbm=-20
    )
    flight = Hover(config, n=3)
    flight.fly(400.0, lambda frame: flight.publish(0))
    share = np.mean([1 in ids for _, _, ids in flight.heard])
    assert share == pytest.approx(0.75, abs=0.03)
    assert not any(2 in ids for _, _, ids in flight.heard)  # an untraced link has its bursts


def test_descriptors_go_by_the_trace_and_over_the_way_back_of_a_traced_link_by_its_snr(tmp_path: Path) -> None:
    """A trace says nothing of the way back: where the model's signal is too weak to be detected none comes."""
    there, both = ("0,0,1,,0,",), ("0,0,1,,,30", "0,1,0,,,30")
    for rows, power_dbm, back in ((there, 20.0, True), (there, -60.0, False), (both, -60.0, True)):
        links = trace(tmp_path, *rows)
        flight = Hover(AirSettings(shadowing_sigma_db=0.0, tx_power_dbm=power_dbm, trace=links))
        flight.fly(2.0, lambda k, flight=flight: [flight.publish(0), flight.publish(1)])
        heard = {sender: [ids for _, who, ids in flight.heard if who == sender] for sender in (0, 1)}
        assert heard == {0: [(1,)] * 20, 1: [(0,) if back else ()] * 20}, (rows, power_dbm)


@pytest.mark.parametrize("loss", [0.3, 0.9])
def test_a_traced_loss_takes_tries_as_a_burst_of_that_loss_does(loss: float, tmp_path: Path) -> None:
    """Of fragments and of requests for a block ack: on a good link the two are the same, draw by draw."""
    rows = [f"0,{i},{j},,{loss}," for i, j in ((0, 1), (1, 0))]
    flown = []
    for how in (dict(trace=trace(tmp_path, *rows)), dict(bursts=BurstSettings(loss_good=loss))):
        flight = Hover(AirSettings(shadowing_sigma_db=0.0, rician_k_db=30.0, **how))
        flight.fly(6.0, lambda k, flight=flight: flight.send(0, 1, 2_600))
        flown.append(
            [(r.number, r.status, r.t_start_s, r.t_done_s, r.airtime_s, r.fragments_lost) for r in flight.rows]
        )
    assert len(flown[0]) == 60
    assert flown[0] == flown[1]


def test_a_link_is_usable_by_its_snr_or_by_what_its_trace_says(tmp_path: Path) -> None:
    """Of a traced loss or goodput whatever carries anything, though its SNR be low; of a traced SNR that one."""
    rows = ("0,0,1,,,0", "0,1,0,,,3", "0,0,2,,1,", "0,2,0,,0.5,", "0,1,2,4,,")
    flight = Hover(AirSettings(shadowing_sigma_db=0.0, trace=trace(tmp_path, *rows)), CROSS_M[[0, 1, 3]]).fly(0.2)
    mbps = flight.air.link_mbps()
    assert (mbps[0, 1], mbps[1, 0], mbps[0, 2]) == (0.0, 3.0, 0.0)
    for least_db, modelled, low in ((10.0, True, False), (3.0, True, True), (90.0, False, False)):
        usable = flight.air.usable(least_db)
        wanted = [[False, False, False], [True, False, low], [True, modelled, False]]
        assert usable.tolist() == wanted, least_db


def test_a_traced_link_is_there_however_far_apart_its_ends_are(tmp_path: Path) -> None:
    """In fleets of every size: only links within earshot are worked out in large ones, and those of the trace."""

    def check(drones: int) -> None:
        at = np.array([[1000.0 * i, 0.0, 60.0] for i in range(drones)])
        settings = replace(
            CALM,
            tx_power_dbm=-12.0,
            path_loss_exponent=3.0,
            trace=trace(tmp_path, "0,0,1,30,,", "0,1,0,30,,", "0,2,0,,0,50"),
        )
        fleet = Hover(settings, at, spread=0.0)

        def tick(frame: int) -> None:
            if frame == 0:
                for sender, receiver in ((0, 1), (2, 0), (0, 2)):
                    fleet.send(sender, receiver, 10_000, deadline_s=0.05)
                fleet.env.timeout(0.06).callbacks.append(lambda _: fleet.publish(0))

        fleet.fly(0.1, tick)
        fates = {(row.sender, row.receiver): row.status for row in fleet.rows}
        assert fates == {(0, 1): Status.DELIVERED, (2, 0): Status.DELIVERED, (0, 2): Status.LOST}
        assert [ids for _, _, ids in fleet.heard] == [(1,)]

    assert wrong_rows([32, 33], check) == {}


FLOWN = BurstSettings(good_to_bad=0.05, bad_to_good=0.28, step_s=0.1)


def states(config: BurstSettings, frames: int, n: int = 3, *, seed: int = 1, frame_s: float = 0.1) -> np.ndarray:
    """[frames, n, n]: which pairs are bad."""
    pairs = PairStates(config, n, seed, 0, frame_s)
    out = []
    for _ in range(frames):
        pairs.advance()
        out.append(pairs.bad)
    return np.array(out)


def test_share_and_length_of_bursts() -> None:
    bad = states(FLOWN, 60_000)
    series = [bad[:, i, j] for i, j in ((0, 1), (0, 2), (1, 2))]
    lengths = np.array([len(list(run)) for s in series for is_bad, run in groupby(s) if is_bad])
    assert np.mean(series) == pytest.approx(bad_share(0.05, 0.28), abs=0.01)
    assert lengths.mean() == pytest.approx(1 / 0.28, rel=0.03)
    assert np.mean(lengths == 1) == pytest.approx(0.28, abs=0.02)  # geometric
    assert np.mean(lengths > 5) == pytest.approx(0.72**5, abs=0.02)


def test_pairs_are_alike_both_ways_and_unlike_each_other_and_one_more_drone_changes_none() -> None:
    bad = states(FLOWN, 5000)
    assert (bad == bad.transpose(0, 2, 1)).all()
    assert abs(np.corrcoef(bad[:, 0, 1], bad[:, 0, 2])[0, 1]) < 0.05
    assert (bad == states(FLOWN, 5000, 6)[:, :3, :3]).all()
    assert (bad != states(FLOWN, 5000, seed=2)).any()


def test_a_step_may_last_many_frames_or_less_than_one() -> None:
    slow = states(replace(FLOWN, step_s=1.0), 1000)
    assert (slow.reshape(100, 10, 3, 3) == slow[::10, None]).all()
    fast = states(replace(FLOWN, step_s=0.05), 1000)
    every = states(FLOWN, 1999, frame_s=0.1)  # the same chain, seen at every step
    assert (fast[:990] == every[0:1980:2]).all()


def test_a_step_as_long_as_a_frame_is_one_in_every_frame() -> None:
    """However the multiples of a tenth are rounded: pairs that change at each step change a hundred times."""
    pairs = PairStates(BurstSettings(good_to_bad=1.0, bad_to_good=1.0, step_s=0.1), 3, 1, 0, 0.1)
    states = [bool(pairs.advance()[0, 1]) for _ in range(101)]
    assert [a != b for a, b in pairwise(states)] == [True] * 100


def test_pairs_change_once_a_step_and_lose_by_their_state() -> None:
    """Steps of three frames, of which the last begins by rounding a little late."""
    bursts = BurstSettings(good_to_bad=0.3, bad_to_good=0.3, step_s=0.3, loss_good=0.25, loss_bad=0.75)
    pairs = PairStates(bursts, 12, 5, 0, 0.1)
    rows = [pairs.advance() for _ in range(30)]
    for frame in range(1, 30):
        assert np.array_equal(rows[frame], rows[frame - 1]) is (frame % 3 != 0)
    assert set(np.unique(np.array(rows))) == {0.25, 0.75}
    first = [PairStates(bursts, 40, seed, 0, 0.1).advance() for seed in range(3)]
    upper = np.triu_indices(40, 1)
    bad = np.mean([(row[upper] == 0.75).mean() for row in first])
    assert bad == pytest.approx(bad_share(0.3, 0.3), abs=0.04)


@given(p=st.floats(0.0, 1.0), r=st.floats(0.01, 1.0), u=st.lists(st.floats(0.0, 0.999), min_size=1, max_size=30))
def test_a_walk_obeys_its_draws(p: float, r: float, u: list[float]) -> None:
    bad = False
    for step, state in enumerate(walk(np.array(False), np.array(u), p, r)):
        bad = (u[step] >= r) if bad else (u[step] < p)
        assert state == bad


def test_the_mean_of_what_is_lost() -> None:
    assert mean_loss(BurstSettings(good_to_bad=0.05, bad_to_good=0.2, loss_good=0.1, loss_bad=0.6)) == pytest.approx(
        0.2
    )


def test_a_bad_pair_hears_no_descriptor_and_gets_no_sample() -> None:
    often = BurstSettings(good_to_bad=0.1, bad_to_good=0.2, step_s=0.1)
    flight = Hover(AirSettings(bursts=often, shadowing_sigma_db=0.0), spread=0)

    def tick(frame: int) -> None:
        flight.publish(0)
        flight.send(0, 1, 5000, kind=f"{frame}")

    flight.fly(200.0, tick)
    bad = states(often, 2000, 2)[:, 0, 1]
    heard = np.array([bool(ids) for _, _, ids in flight.heard])
    came = np.array([r.status is Status.DELIVERED for r in flight.rows])
    assert (heard == ~bad[: len(heard)]).all()
    assert (came == ~bad[: len(came)]).all()
    missed = {(r.status, r.reason) for r in flight.rows if r.status is not Status.DELIVERED}
    # tried until then, or behind the block-ack requests of the one before
    assert missed == {(Status.EXPIRED, "deadline_in_service"), (Status.EXPIRED, "deadline_queued")}


def faint(loss: float, **more: Any) -> AirSettings:
    """Links at the edge of what can be received, in bursts of so much loss."""
    return AirSettings(
        shadowing_sigma_db=0.0,
        tx_power_dbm=-11.5,
        rician_k_db=30.0,
        preamble_detection_dbm=-120.0,
        bursts=BurstSettings(loss_good=loss),
        **more,
    )


def test_a_burst_takes_its_share_of_the_fragments_that_the_signal_lets_through() -> None:
    """On a link that loses some by itself, a burst of a half takes half of the rest."""

    def lost(loss: float) -> float:
        flight = Hover(faint(loss, retry_limit=0), n=2)
        flight.fly(20.0, lambda k: flight.send(0, 1, 13_000))
        assert {r.mcs for r in flight.rows} == {1}
        return sum(r.fragments_lost for r in flight.rows) / sum(r.fragments for r in flight.rows)

    alone = lost(0.0)
    assert 0.1 < alone < 0.3
    assert lost(0.5) == pytest.approx(alone + 0.5 * (1 - alone), abs=0.03)


def test_a_burst_takes_its_share_of_the_descriptors_that_the_signal_lets_through() -> None:
    """Two causes, a draw each: of descriptors that half come by their signal, a burst of a half leaves a quarter."""

    def heard(loss: float) -> float:
        flight = Hover(faint(loss, group_rate_mbps=24.0), n=5)
        flight.fly(12.0, lambda k: flight.publish(0))
        return sum(len(ids) for _, _, ids in flight.heard) / (4 * len(flight.heard))

    alone = heard(0.0)
    assert 0.35 < alone < 0.65
    assert heard(0.5) == pytest.approx(0.5 * alone, abs=0.06)
