"""A small form of `make validate-ns3`: a few short plans through ns-3 and through the Air, where ns-3 is installed."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from research.validation.ns3 import per_fit, wifi_ns3
from research.validation.ns3.wifi_air import QUIET, run_air
from research.validation.ns3.wifi_compare import LOADS, SATURATED, beyond, figures, means, through_air, through_ns3
from research.validation.ns3.wifi_ns3 import Ns3Missing, driver, run_ns3
from research.validation.ns3.wifi_parts import Stations, parts_ms
from research.validation.ns3.wifi_plan import Case, Plan, cross, grid, line, pairs_of, sortie_plan
from sortie.radio.mac import medium
from sortie.radio.rates import CURVES, LEGACY_CURVES


def _is_there() -> bool:
    try:
        driver()
    except Ns3Missing:
        return False
    return True


needs_ns3 = pytest.mark.skipif("not _is_there()", reason="ns-3's wheel or a C++ compiler is not installed")


@needs_ns3
@pytest.mark.slow
@pytest.mark.parametrize("case", [*LOADS[1:4], LOADS[6], *LOADS[13:15], *SATURATED[1:3]], ids=lambda case: case.name)
def test_the_air_stays_within_its_bounds_of_ns3(case: Case) -> None:
    ns3, ours = (means([run(case, seed) for seed in (1, 2, 3)]) for run in (through_ns3, through_air))
    assert beyond(case, ns3, ours) == [], (ns3, ours)


@needs_ns3
def test_a_run_that_takes_too_long_is_ended(capfd: pytest.CaptureFixture[str]) -> None:
    plan = Plan(cross(), saturated=[(0, 1), (1, 2), (2, 3)])
    with pytest.raises(RuntimeError, match=r"ns-3 failed 4 times, the last one took longer than 0\.2 s"):
        run_ns3(plan, 0.5, 60.0, limit_s=0.2, rate="HeMcs7")
    assert "ns-3 with seed 1 took longer" in capfd.readouterr().err


@needs_ns3
def test_the_driver_lists_every_frame_on_the_air() -> None:
    """One payload of 20 fragments over an idle medium, and a descriptor: their frames and answers, in order."""
    plan = Plan(line(2), descriptors=[(0.2, 1, 208)], payloads=[(0.1, 0, 1, 20 * 1344)])
    found = run_ns3(plan, 0.0, 0.4, rate="HeMcs7", exact=1, meet=1, frames=1)["frames"]
    found = found[found["t_ns"] >= 0]
    assert found["kind"].tolist() == ["QOSDATA", "CTL_BACKRESP", "QOSDATA"]
    assert found["station"].tolist() == [0, 1, 1]
    assert found["to"].tolist() == [1, 0, -1]
    assert found["mpdus"].tolist() == [20, 1, 1]
    assert found["ns"].tolist()[1:] == [32_000, 472_000]


@needs_ns3
@pytest.mark.slow
def test_an_exact_receiver_does_not_forget_the_weaker_frame_that_came_first() -> None:
    """Two far senders begin at once, time and again; the second frame at 1 is stronger by less than MCS 7 needs."""
    at = line(4, 20.0)
    payloads = [(0.05 + 0.01 * k + 1e-9, s, r, 13_440) for k in range(60) for s, r in ((0, 1), (3, 2))]
    delivered = [
        run_ns3(Plan(at, payloads=payloads), 0.0, 0.8, rate="HeMcs7", exact=exact, meet=1, frames=1)["frames"]
        for exact in (0, 1)
    ]
    asked = [(frames["kind"] == "CTL_BACKREQ").sum() for frames in delivered]
    assert asked[1] > asked[0]


def _crashes_until(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """In place of the driver: a program that crashes with any other seed."""
    program, code = tmp_path / "driver", tmp_path / "driver.py"
    program.write_text(
        f'#!/bin/sh\nexec "{sys.executable}" "{code}" "$@"\n'
    )  # quoted: a folder's name may have a space
    code.write_text(
        "import sys\n"
        "options = dict(word[2:].split('=', 1) for word in sys.argv[1:])\n"
        f"if options['run'] != '{seed}':\n"
        "    sys.exit('Invalid WifiPhy state')\n"
        "open(options['out'] + '.data.csv', 'w').write('id,t,sender,receiver,bytes,fragments,got,last\\n0,0.1,0,1,9,1,1,0.15\\n')\n"
        "open(options['out'] + '.bcast.csv', 'w').write('id,t,sender,receiver,delay\\n0,0.1,0,1,-1\\n')\n"
        'print(\'{"sat_mbps": [], "tx_s": [0.0], "cpu_s": 1.0}\')\n'
    )
    program.chmod(0o755)
    monkeypatch.setattr(wifi_ns3, "driver", lambda: program)


def test_a_crash_is_told_and_tried_again_with_another_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _crashes_until(tmp_path, monkeypatch, 2003)
    run = run_ns3(Plan(line(2)), 0.0, 1.0, seed=3)
    assert run["crashed"] == 2
    assert run["data"]["ok"].tolist() == [True]
    assert run["descriptors"]["ok"].tolist() == [False]
    assert capsys.readouterr().err.count("Invalid WifiPhy state") == 2
    _crashes_until(tmp_path, monkeypatch, 9)
    with pytest.raises(RuntimeError, match="ns-3 failed 4 times, the last one ended with 1: Invalid WifiPhy state"):
        run_ns3(Plan(line(2)), 0.0, 1.0, seed=3)


def test_without_ns3_the_command_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise wifi_ns3.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(wifi_ns3.metadata, "distribution", missing)
    with pytest.raises(Ns3Missing, match=r"pip install 'sortie-sim\[ns3\]'"):
        driver()


def test_packet_error_rates_are_those_of_ns3() -> None:
    stored = pd.read_csv(per_fit.POINTS)
    assert len(stored[stored["kind"] == "he"]["mcs"].unique()) == len(CURVES)
    curves = {"he": CURVES, "legacy": tuple(LEGACY_CURVES.values())}
    for row in stored.itertuples():
        curve = curves[row.kind][row.mcs]
        assert curve.per(row.snr_db, row.bytes) == pytest.approx(row.per, abs=0.023 if row.kind == "he" else 0.031)


@needs_ns3
def test_the_stored_error_rates_and_curves_come_from_ns3() -> None:
    found = per_fit.tables()
    pd.testing.assert_frame_equal(
        per_fit.points(found).reset_index(drop=True), pd.read_csv(per_fit.POINTS), check_dtype=False
    )
    rows = found[(found["kind"] == "he") & (found["mcs"] == 7) & found["bytes"].isin(per_fit.HE_BYTES)]
    curve, error = per_fit.fitted(rows)
    assert error < 0.015
    assert curve == pytest.approx(CURVES[7], rel=0.01)


def test_fleets_stand_where_their_shape_says() -> None:
    assert cross()[:, :2].tolist() == [[0, 0], [20, 0], [0, 20], [-20, 0], [0, -20]]
    assert cross(drones=7)[5:, :2].tolist() == [[40, 0], [0, 40]]
    assert grid(5, 10.0)[:, :2].tolist() == [[0, 0], [10, 0], [20, 0], [0, 10], [10, 10]]
    assert line(3, 230.0)[:, 0].tolist() == [0, 230, 460]


def test_a_plan_has_each_descriptor_and_payload_once_a_frame() -> None:
    at = cross()
    pairs = pairs_of(at, 7)
    assert pairs == [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (3, 0), (4, 0)]
    plan = sortie_plan(at, pairs, 5000, 1.0)
    assert len(plan.descriptors) == 50
    assert len(plan.payloads) == 70
    assert all(0.0 <= t % 0.1 <= 0.08 for t, _, _ in plan.descriptors)
    assert all(0.036 <= t % 0.1 <= 0.0400001 for t, _, _, _ in plan.payloads)
    words = [row.split() for row in plan.text().splitlines()]
    assert [sum(row[0] == kind for row in words) for kind in ("node", "bcast", "data", "sat")] == [5, 50, 70, 0]
    t, sender, receiver, size = plan.payloads[3]
    assert words[5 + 50 + 3] == ["data", f"{t:.9f}", str(sender), str(receiver), str(size), "3"]


def test_figures_of_a_counted_run() -> None:
    """Two payloads and four receptions within the window by hand; one payload is sent too early, one too late."""
    data = pd.DataFrame(
        [(0.4, 0, 0.001, True), (0.6, 0, 0.010, True), (0.7, 1, 0.2, False), (0.95, 1, 0.001, True)],
        columns=["t", "sender", "delay", "ok"],
    )
    heard = pd.DataFrame(
        [(0.6, 0, 0.001, True), (0.6, 0, 0.001, False), (0.7, 1, -1, False), (0.7, 1, -1, False)],
        columns=["t", "sender", "delay", "ok"],
    )
    run = {"data": data, "descriptors": heard, "sat_mbps": [30.0, 10.0], "tx_s": [0.1, 0.2], "cpu_s": 2.0}
    found = figures(run, 0.5, 1.0)
    assert found == pytest.approx(
        {
            "delivered": 0.5, "p50_ms": 10.0, "p99_ms": 10.0, "worst_sender": 0.0, "descriptor_loss": 0.75,
            "descriptor_lost_for_all": 0.5, "descriptor_p50_ms": 1.0, "descriptor_p99_ms": 1.0,
            "saturated_mbps": 40.0, "best_flow": 0.75, "air_s": 0.3, "cpu_s": 2.0,
        }
    )  # fmt: skip
    other = found | {"delivered": math.nan}
    assert means([found, other])["delivered"] == 0.5
    assert math.isnan(means([other])["delivered"])


def test_what_lies_beyond_its_bound() -> None:
    ns3 = {"delivered": 0.9, "p50_ms": 10.0, "p99_ms": 20.0, "descriptor_loss": 0.10}
    assert beyond(Case("a"), ns3, ns3) == []
    near = {"delivered": 0.86, "p50_ms": 10.9, "p99_ms": 17.5, "descriptor_loss": 0.125}
    assert beyond(Case("a"), ns3, near) == []
    far = {"delivered": 0.84, "p50_ms": 8.9, "p99_ms": 16.5, "descriptor_loss": 0.14}
    assert beyond(Case("a"), ns3, far) == ["delivered", "p50_ms", "p99_ms", "descriptor_loss"]
    assert beyond(Case("a", load=1.5), ns3, far) == ["delivered", "p50_ms", "p99_ms"]  # within a factor of 1.5
    flows = {"saturated_mbps": 100.0, "best_flow": 0.9}
    assert beyond(SATURATED[0], flows, {"saturated_mbps": 107.0, "best_flow": 0.5}) == ["saturated_mbps"]
    assert beyond(SATURATED[-2], flows, {"saturated_mbps": 120.0, "best_flow": 0.6}) == ["best_flow"]


def test_every_case_is_named_once() -> None:
    names = [case.name for case in (*LOADS, *SATURATED)]
    assert len(set(names)) == len(names)


def test_the_parts_of_a_plan_s_time_are_measured_on_the_same_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case("3 in a line", "line", 3, payload_bytes=20_000, pairs=4, stop_s=0.9)
    assert list(parts_ms(case, 1)) == ["all", "set-up and frames", "events and rows", "stations"]
    runs = []
    for again in (False, True):
        monkeypatch.setattr(medium, "_edca", lambda again=again: Stations(again))
        runs.append(run_air(case.plan(1), 0.6, 0.9, mcs=7, **QUIET))
    assert len(runs[0]["data"]) == 36
    pd.testing.assert_frame_equal(runs[0]["data"], runs[1]["data"])
    pd.testing.assert_frame_equal(runs[0]["descriptors"], runs[1]["descriptors"])


def test_the_air_runs_a_plan_at_the_mcs_that_is_asked_for() -> None:
    plan = Plan(line(2), payloads=[(0.05, 0, 1, 13_120), (0.15, 1, 0, 13_120)])
    run = run_air(plan, 0.0, 0.4, mcs=4, **QUIET)
    assert run["data"]["mcs"].tolist() == [4, 4]
    assert run["data"]["ok"].all()


def test_the_driver_is_started_as_a_process_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _crashes_until(tmp_path, monkeypatch, 1)
    seen: list[list[str]] = []
    run = subprocess.run

    def spy(command: list[str], **options: object) -> object:
        seen.append(command)
        assert options["timeout"] == 7.0
        return run(command, **options)  # type: ignore[call-overload]

    monkeypatch.setattr(wifi_ns3.subprocess, "run", spy)
    run_ns3(Plan(line(2)), 0.25, 1.0, limit_s=7.0, rate="HeMcs7", rts=1)
    assert {"--warm=0.25", "--stop=1.0", "--rate=HeMcs7", "--rts=1", "--run=1"} <= set(seen[0])
