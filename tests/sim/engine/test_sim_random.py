"""Random small sorties: what must hold whatever is flown."""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.scenarios.reading.load import loads
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

BASE = """
name: random
duration_s: 3
fleet: {route: {waypoints_m: [[0, 0], [80, 0]]}}
perception: {detector: none}
mission: {phases: [{at_s: 0, phase: search}]}
"""

scenarios = st.fixed_dictionaries(
    {
        "fleet.drones": st.integers(1, 5),
        "fleet.formation.spacing_m": st.floats(10, 300),
        "fleet.battery.initial_soc": st.floats(0.05, 1.0),
        "fleet.battery.capacity_wh": st.floats(1, 130),
        "radio.tx_power_dbm": st.floats(-10, 20),
        "radio.retry_limit": st.integers(0, 7),
        "radio.framing": st.sampled_from(["sample", "tiles"]),
        "radio.relay_max_hops": st.integers(1, 3),
        "context.publish_every": st.integers(1, 4),
        "seed": st.integers(0, 999),
    }
)
directives = st.tuples(st.sampled_from(Representation), st.floats(0.01, 1.0), st.sampled_from([0.5, 2.0, 10.0]))


@pytest.mark.slow
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(scenarios, directives, st.sampled_from([0.0, 0.05, -0.05]))
def test_whatever_is_flown(knobs: dict[str, Any], asked: tuple[Representation, float, float], skew_s: float) -> None:
    sets = [f"{k}={v}" for k, v in knobs.items()]
    if knobs["fleet.drones"] > 1 and skew_s:
        sets.append(f"events=[{{kind: clock_skew, at_s: 0.5, drone: 1, skew_s: {skew_s}}}]")
    scenario = loads(BASE, overrides=sets)
    read: dict[tuple[int, int], list[tuple[int, int, float]]] = defaultdict(list)
    rung, rho, rate_hz = asked

    def policy(view: FleetView) -> list[Directive]:
        assert view.me is not None
        for peer in view.peers:
            read[view.ego, peer].append((view.me.stamp_ns, view.descriptors[peer].stamp_ns, view.age_s[peer]))
        return [Directive(view.ego, p, rung, rho, None, rate_hz, reason="as drawn") for p in view.peers]

    record = run_sortie(scenario, policy)
    # ages: between two arrivals a descriptor grows older by the time that passes, and an arrival makes none older
    for (ego, _), seen in read.items():
        assert all(age_s >= 0.0 for *_, age_s in seen)
        for (t0, stamp0, age0), (t1, stamp1, age1) in pairwise(seen):
            passed_s = (t1 - t0) * 1e-9
            jumped = ego == 1 and abs(passed_s - scenario.frame_s) > 1e-6  # its clock was set in between
            if stamp1 == stamp0 and not jumped:
                assert age1 == pytest.approx(age0 + passed_s, abs=2e-9)
            elif not jumped:
                assert stamp1 > stamp0
                assert age1 < age0 + passed_s + 1e-9
    # bytes: sent = delivered + lost + expired + in flight
    b = outcome(record)["bytes"]
    assert b["data_sent"] == b["data_delivered"] + b["data_lost"] + b["data_expired"] + b["data_in_flight"]
    # charge never rises; nothing happens before it is asked for
    charge: dict[int, float] = {}
    for row in record.tables["states"].select(["t_s", "drone", "soc"]).to_pylist():
        assert 0.0 <= row["soc"] <= charge.get(row["drone"], 1.0)
        charge[row["drone"]] = row["soc"]
    for row in record.tables["transmissions"].to_pylist():
        assert row["captured_s"] <= row["t_sent_s"]
        if math.isnan(row["t_start_s"]):
            assert row["airtime_s"] == 0.0
        else:
            assert row["t_sent_s"] <= row["t_start_s"]
        if not math.isnan(row["t_done_s"]):
            assert row["t_sent_s"] <= row["t_done_s"] < scenario.duration_s
            assert math.isnan(row["t_start_s"]) or row["t_start_s"] <= row["t_done_s"]
