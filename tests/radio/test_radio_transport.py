"""Samples and pieces on a lossy link, and what their rows say; the clock that may skip an event; settings as values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simpy
from radio_examples import CROSS_M, still
from radio_flights import Hover, trace
from scipy import stats

from sortie.radio import Air, BurstSettings, Status, Transmission
from sortie.radio.event_loop import EventLoop
from sortie.radio.mac.airtime import sample_wire
from sortie.radio.settings import AirSettings
from sortie.scenarios.schema import Radio

CALM = AirSettings(shadowing_sigma_db=0.0)
LOSSY = AirSettings(shadowing_sigma_db=0.0, retry_limit=0, bursts=BurstSettings(loss_good=0.5))


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


def test_reliable_pieces_come_back_and_the_sample_is_whole(tmp_path: Path) -> None:
    flight = Hover(lossy(tmp_path, 0.2))
    flight.fly(10.0, lambda frame: flight.send(0, 1, 100 * 1336 + 10, piece_bytes=1336, reliable=True, deadline_s=0.5))
    done = [r for r in flight.rows if r.reason != "replaced"]
    assert {r.status for r in done} == {Status.DELIVERED}
    assert all(r.arrived_bytes == 133_610 and r.missing == () and r.repairs > 0 for r in done)


def test_a_newer_sample_replaces_the_older_of_its_kind_only() -> None:
    f = Hover(CALM).fly(0.1)
    for kind in ("features", "detections", "features"):
        f.send(0, 1, 600_000, kind=kind)
    f.env.run(until=0.2)
    assert [(r.number, r.reason) for r in f.rows] == [(0, "replaced"), (1, ""), (2, "")]
    assert isnan(f.rows[0].t_start_s) or f.rows[0].airtime_s == 0.0


@pytest.mark.parametrize("hops", [1, 2])
def test_the_row_of_a_sample_that_was_never_served_has_the_snr_of_its_link_at_its_sending(hops: int) -> None:
    """Of this frame and not of the one before, which its sender knows; of the first hop."""
    flight = Hover(AirSettings(shadowing_sigma_db=0.0, relay_max_hops=hops), CROSS_M[[0, 1, 3]])
    flight.air.advance()
    flight.extra = np.array([[0.0, 7.0, 0.0], [0.0] * 3, [0.0] * 3])
    flight.air.advance(flight.extra)
    snr_db = flight.air.snr_db
    flight.send(0, 2, 2_000_000, kind="long", deadline_s=0.05)
    flight.send(0, 1, 1000, kind="waits", deadline_s=0.02)
    flight.env.run(until=0.06)
    (waited,) = [r for r in flight.rows if r.kind == "waits"]
    assert (waited.reason, waited.mcs) == ("deadline_queued", -1)
    assert waited.snr_db == pytest.approx(snr_db[0, 1])
    assert snr_db[0, 1] == pytest.approx(snr_db[1, 0] - 7.0)


@pytest.mark.parametrize("by_trace", [False, True])
def test_a_payload_goes_at_the_rate_of_the_frame_before_and_is_lost_to_the_present_one(
    by_trace: bool, tmp_path: Path
) -> None:
    """A link that fades from one frame to the next, for four frames: its sender learns it a frame late, both times."""
    weak = set(range(5, 9))
    rows = [f"{0.1 * k:.1f},0,1,{8 if k in weak else 40},," for k in range(20)]
    config = AirSettings(trace=trace(tmp_path, *rows)) if by_trace else CALM
    flight = Hover(config, np.array([[0.0, 0.0, 60.0], [20.0, 0.0, 60.0]]))
    planned: list[Any] = []

    def tick(k: int) -> None:
        flight.send(0, 1, 3000)
        planned.append(flight.air.link_mbps()[0, 1])

    for k in range(12):
        flight.extra = None
        if not by_trace and k in weak:
            flight.extra = np.full((2, 2), 38.0)
        flight.air.advance(flight.extra)
        tick(k)
        flight.env.run(until=0.1 * (k + 1))
    mcs, snr_db = ({round(10 * r.t_sent_s): getattr(r, name) for r in flight.rows} for name in ("mcs", "snr_db"))
    fast = mcs[0]
    assert {k for k in range(12) if mcs[k] < fast} == {k for k in range(12) if planned[k] < planned[0]} == {6, 7, 8, 9}
    assert {k for k in range(12) if snr_db[k] < 20} == weak


def test_a_sample_was_given_the_channel_in_all_its_passes(tmp_path: Path) -> None:
    """Repairs included: what its sender has transmitted, it was given at least, and no more than passed meanwhile."""
    settings = AirSettings(retry_limit=0, trace=trace(tmp_path, "0,0,1,,0.5,", "0,1,0,,0,"))
    flight = Hover(settings)
    flight.air.advance()
    flight.send(0, 1, 40_000, reliable=True, deadline_s=2.0)
    flight.env.run(until=2.0)
    (row,) = flight.rows
    assert row.repairs > 1
    assert flight.air.airtime_s[0] <= row.airtime_s < row.t_done_s - row.t_start_s


def test_bytes_that_arrived_are_those_of_the_pieces_that_did() -> None:
    """Of 53 pieces the last is shorter, and counts as what it is, whether it comes or not."""
    flight = Hover(LOSSY, n=2)
    flight.fly(8.0, lambda k: flight.send(0, 1, 52 * 200 + 30, piece_bytes=200))
    cut = [r for r in flight.rows if r.missing]
    assert {52 in r.missing for r in cut} == {True, False}
    for r in cut:
        assert r.arrived_bytes == sum(30 if k == 52 else 200 for k in range(53) if k not in r.missing)


# --- the clock and the settings ---------------------------------------------------------------------


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


ELSEWHERE = {"framing", "path_loss_params", "link_params"}
"""Fields of the section that callers of the air act on."""


def test_fields_and_defaults_are_those_of_a_scenarios_radio_section() -> None:
    settings = asdict(AirSettings())
    assert settings.pop("own_antennas") == {}, "makes have those"
    assert settings == Radio().model_dump(exclude=ELSEWHERE)
    assert list(settings) == [name for name in Radio.model_fields if name not in ELSEWHERE]


def test_a_section_becomes_settings() -> None:
    section = Radio.model_validate({"standard": "n", "bandwidth_mhz": 40, "bursts": {"good_to_bad": 0.1}})
    expected = AirSettings(standard="n", bandwidth_mhz=40, bursts=BurstSettings(good_to_bad=0.1))
    assert AirSettings.of(section.model_dump(exclude=ELSEWHERE)) == expected


def test_choices_of_the_schema_are_those_of_the_settings() -> None:
    for name in ("standard", "antenna", "path_loss", "rate_control"):
        field = Radio.model_json_schema()["properties"][name]
        for value in field.get("enum") or field["anyOf"][0]["enum"]:
            assert getattr(AirSettings(**{"bandwidth_mhz": 20, name: value}), name) == value


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"standard": "be"}, r"standard is 'be', must be one of \['n', 'ac', 'ax'\]"),
        ({"path_loss": "none"}, "path_loss is 'none', must be one of"),
        ({"standard": "n", "bandwidth_mhz": 80}, r"bandwidth_mhz is 80, must be one of \[20, 40\]"),
    ],
)
def test_an_unknown_choice_is_refused(values: dict[str, object], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        AirSettings.of(values)
