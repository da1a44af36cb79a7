"""Options together: random combinations of knobs and events fly, and what holds of every sortie holds of theirs.

The knobs and their values are those of `test_sim_knobs`. A combination that the schema refuses is left out.
"""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pytest
import test_sim_knobs as knobs
from sim_examples import example

from sortie.scenarios.reading.nodes import ScenarioError
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

pytestmark = pytest.mark.slow

EVENTS = (
    knobs.JAM, knobs.DROP, knobs.SPOOF, knobs.LIE, knobs.LOST, knobs.JOINS, knobs.LEAVES, knobs.FAULT, knobs.CELL, knobs.SKEW,
    knobs.DRIFT, knobs.AWAY, knobs.ASTRAY, knobs.SLOW, knobs.BLOCKED, knobs.LOST_GNSS,
)  # fmt: skip
POLICIES = ("worked", "all-4", "boxes", "adaptive", "uncertain-boxes", "where2comm-style")
NEED_A_FILE = {
    f for f, (value, shared) in knobs.TRAFFIC.items() if value == "TRACE" or "policy.name=CROSSING" in shared
}
FIELDS = sorted(knobs.TRAFFIC.keys() - NEED_A_FILE - {"events.kind", "seed", "duration_s", "policy.replays.drone"})


def combination(number: int) -> Scenario:
    """The first draw of a number that the schema takes."""
    drawn = (_drawn(number, attempt) for attempt in itertools.count())
    return next(scenario for scenario in drawn if scenario is not None)


def _drawn(number: int, attempt: int) -> Scenario | None:
    """Two to four knobs, up to three events and a policy; None where knobs need different values of one field."""
    rng = stream(number, attempt, (), "test.combinations")
    wanted: dict[str, str] = {}
    for field in rng.choice(FIELDS, int(rng.integers(2, 5)), replace=False).tolist():
        value, shared = knobs.TRAFFIC[field]
        for setting in (*shared, f"{knobs.place(field, shared)}={value}"):
            if wanted.setdefault(setting.partition("=")[0], setting) != setting:
                return None
    events = rng.choice(EVENTS, int(rng.integers(0, 4)), replace=False).tolist()
    if events and not any(key.startswith("events") for key in wanted):
        wanted["events"] = f"events=[{', '.join(e.removeprefix('events=[').removesuffix(']') for e in events)}]"
    if not any(key.startswith("policy.") for key in wanted):
        wanted["policy.name"], wanted["policy.params"] = f"policy.name={rng.choice(POLICIES)}", "policy.params={}"
    try:
        return example("duration_s=3", *wanted.values())
    except ScenarioError:
        return None


@pytest.mark.parametrize("number", [*range(12), *(pytest.param(k, marks=pytest.mark.slow) for k in range(12, 24))])
def test_what_holds_of_every_sortie_holds_of_options_together(number: int) -> None:
    scenario = combination(number)
    record = run_sortie(scenario)
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
    assert all(0 <= drone["soc"] <= 1 for drone in found["drones"].values())
    assert 0 <= found["medium_busy_fraction"] <= 1
    if found["context"]["lost"] is not None:
        assert math.fsum(found["context"]["lost_to"].values()) == pytest.approx(found["context"]["lost"])
    sendings = record.tables["transmissions"].to_pandas()
    over = sendings[sendings["t_done_s"].notna()]
    assert (over["t_done_s"] >= over["t_sent_s"]).all()
    assert (
        over[over["status"] == "delivered"]["t_done_s"] <= over[over["status"] == "delivered"]["deadline_s"] + 1e-6
    ).all()
    assert np.all(np.diff(record.tables["descriptors"]["t_s"].to_numpy()) >= 0)
    if number % 4 == 0:
        assert run_sortie(scenario).fingerprint == record.fingerprint
