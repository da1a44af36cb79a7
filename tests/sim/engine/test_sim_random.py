"""Random small sorties, and options together: what must hold whatever is flown."""

from __future__ import annotations

import itertools
import json
import math
from collections import defaultdict
from itertools import pairwise
from typing import Any

import knobs
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sim_examples import example
from test_sim_knobs import place

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.scenarios.reading.load import loads
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

pytestmark = pytest.mark.slow
BASE = """
name: random
duration_s: 3
fleet: {route: {waypoints_m: [[0, 0], [80, 0]]}}
perception: {detector: none}
mission: {phases: [{at_s: 0, phase: search}]}
"""


def assert_holds(record: SortieRecord) -> None:
    found = outcome(record)
    json.dumps(found, allow_nan=False)
    sent, counted = found["bytes"], record.totals
    for fate in ("sent", "delivered", "lost", "expired"):  # the radio's own counts, and the rows of the record
        assert counted[f"data_{fate}_bytes"] == sent[f"data_{fate}"], fate
    assert sent["data_sent"] == sum(sent[f"data_{fate}"] for fate in ("delivered", "lost", "expired", "in_flight"))
    energy_j = dict(found["energy_j"])
    total_j = energy_j.pop("total")
    assert min(energy_j.values()) >= 0
    assert math.fsum(energy_j.values()) == pytest.approx(total_j)
    assert total_j == pytest.approx(math.fsum(drone["energy_j"] for drone in found["drones"].values()))
    assert 0 <= found["medium_busy_fraction"] <= 1
    if found["context"]["lost"] is not None:
        assert math.fsum(found["context"]["lost_to"].values()) == pytest.approx(found["context"]["lost"])
    charge: dict[int, float] = {}
    for row in record.tables["states"].select(["t_s", "drone", "soc"]).to_pylist():
        assert 0.0 <= row["soc"] <= charge.get(row["drone"], 1.0), "charge never rises"
        charge[row["drone"]] = row["soc"]
    for row in record.tables["transmissions"].to_pylist():
        begun, done = not math.isnan(row["t_start_s"]), not math.isnan(row["t_done_s"])
        assert begun or row["airtime_s"] == 0.0
        assert not begun or row["t_sent_s"] <= row["t_start_s"]
        assert not done or row["t_sent_s"] <= row["t_done_s"] < record.scenario.duration_s
        assert not (begun and done) or row["t_start_s"] <= row["t_done_s"]
        assert row["status"] != "delivered" or row["t_done_s"] <= row["deadline_s"] + 1e-6
    assert np.all(np.diff(record.tables["descriptors"]["t_s"].to_numpy()) >= 0)


# --- options together: the knobs and their values are those of `knobs` ----------------------------

POLICIES = ("worked", "all-4", "boxes", "adaptive", "uncertain-boxes", "where2comm-style")
NOT_TOGETHER = {"seed", "duration_s", "policy.replays.drone", "fleet.trace", "fleet.viewpoints.separation_m"}
FIELDS = sorted(knobs.TRAFFIC.keys() - NOT_TOGETHER)


def combination(number: int) -> Scenario:
    """The first draw of a number that the schema takes."""
    drawn = (_drawn(number, attempt) for attempt in itertools.count())
    return next(scenario for scenario in drawn if scenario is not None)


def _drawn(number: int, attempt: int) -> Scenario | None:
    """Two to four knobs, up to three events and a policy; None where knobs need different values of one field."""
    rng = stream(number, attempt, (), "test.combinations")
    wanted: dict[str, str] = {}
    for field in rng.choice(FIELDS, int(rng.integers(2, 5)), replace=False).tolist():
        value, _, _, *shared = knobs.TRAFFIC[field]
        for setting in (*map(str, shared), f"{place(field, shared)}={value}"):
            if wanted.setdefault(setting.partition("=")[0], setting) != setting:
                return None
    events = rng.choice(knobs.EVENTS, int(rng.integers(0, 4)), replace=False).tolist()
    if events and not any(key.startswith("events") for key in wanted):
        wanted["events"] = f"events=[{', '.join(e.removeprefix('events=[').removesuffix(']') for e in events)}]"
    if not any(key.startswith("policy") for key in wanted):
        wanted["policy"] = f"policy={{name: {rng.choice(POLICIES)}}}"
    try:
        return example("duration_s=3", *wanted.values())
    except ScenarioError:
        return None


@pytest.mark.parametrize("part", range(4))
def test_what_holds_of_every_sortie_holds_of_options_together(part: int) -> None:
    for number in range(part, 20, 4):
        scenario = combination(number)
        record = run_sortie(scenario)
        assert_holds(record)
        if number < 4:
            assert run_sortie(scenario).fingerprint == record.fingerprint


# --- random fleets and directives -----------------------------------------------------------------

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


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(scenarios, directives, st.sampled_from([0.0, 0.05, -0.05]))
def test_whatever_is_flown(chosen: dict[str, Any], asked: tuple[Representation, float, float], skew_s: float) -> None:
    sets = [f"{k}={v}" for k, v in chosen.items()]
    if chosen["fleet.drones"] > 1 and skew_s:
        sets.append(f"events=[{{kind: clock_skew, at_s: 0.5, drone: 1, skew_s: {skew_s}}}]")
    scenario = loads(BASE, overrides=sets)
    read: dict[tuple[int, int], list[tuple[int, int, float]]] = defaultdict(list)
    rung, rho, rate_hz = asked

    def policy(view: FleetView) -> list[Directive]:
        assert view.me is not None
        for peer in view.peers:
            read[view.ego, peer].append((view.me.stamp_ns, view.descriptors[peer].stamp_ns, view.age_s[peer]))
        return [Directive(view.ego, p, rung, rho, None, rate_hz, reason="as drawn") for p in view.peers]

    assert_holds(run_sortie(scenario, policy))
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
