"""Tiles, bursts, traces and relays in a whole sortie: what arrives is fused, what is cut off is told."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pyarrow.compute as pc
import pytest
from sim_examples import example

from sortie.scenarios.link_state import MEASURED_FOR_S, LinkState, state_of
from sortie.scenarios.reading.load import load
from sortie.sim.check.expectations import check
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

LOSSY = (
    "policy.name=all-4",
    "policy.params={received_budget: 0.1}",
    "radio.retry_limit=0",
    "radio.bursts.loss_good=0.05",
)


@pytest.fixture(scope="module")
def tiled() -> SortieRecord:
    return run_sortie(example(*LOSSY, "radio.framing=tiles", "perception.detector=surrogate"))


def test_payloads_arrive_in_part_and_bytes_add_up(tiled: SortieRecord) -> None:
    sent = tiled.tables["transmissions"]
    partial = sent.filter(pc.equal(sent["status"], "partial"))
    assert partial.num_rows > 0.5 * sent.num_rows
    assert pc.all(pc.less(partial["arrived_bytes"], partial["payload_bytes"])).as_py()
    assert set(partial["representation"].to_pylist()) == {"features"}
    of = outcome(tiled)["bytes"]
    assert of["data_sent"] == sum(of[f"data_{s}"] for s in ("delivered", "lost", "expired", "in_flight"))
    assert of["data_delivered"] == pc.sum(sent["arrived_bytes"]).as_py() == tiled.totals["data_delivered_bytes"]
    assert of["data_lost"] == tiled.totals["data_lost_bytes"]


def test_parts_are_fused_where_samples_are_lost(tiled: SortieRecord) -> None:
    whole = run_sortie(example(*LOSSY, "perception.detector=surrogate"))
    held = [pc.sum(pc.list_value_length(r.tables["fusions"]["peers"])).as_py() for r in (tiled, whole)]
    assert held[0] > 2 * held[1]
    assert outcome(tiled)["ap50"]["full_scene"] > outcome(whole)["ap50"]["full_scene"]


def test_a_payload_that_its_deadline_cuts_short_has_missed_it(tiled: SortieRecord) -> None:
    record = run_sortie(example("policy.name=all-4", "policy.params={received_budget: 1.0}", "radio.framing=tiles"))
    result = outcome(record)
    fates = result["payload_fates"]
    cut = sum(fates.get(f"partial/{r}", 0) for r in ("replaced", "deadline_in_service", "deadline_queued"))
    assert cut > 100
    known = sum(fates.values()) - fates["in_flight"]
    late = sum(n for fate, n in fates.items() if fate.startswith("expired/"))
    assert result["deadline_miss_rate"] == pytest.approx((late + cut) / known)
    assert outcome(tiled)["deadline_miss_rate"] < 0.01  # fragments are lost, deadlines are not missed
    sent = record.tables["transmissions"].to_pylist()
    rest = [r for r in sent if r["reason"] in ("replaced", "deadline_in_service", "deadline_queued")]
    expired = sum(r["payload_bytes"] - r["arrived_bytes"] for r in rest)
    assert expired == result["bytes"]["data_expired"] == record.totals["data_expired_bytes"]
    assert result["bytes"]["data_lost"] == record.totals["data_lost_bytes"] == 0  # nothing was, on so good a link


def test_the_topology_is_told_where_payloads_are_relayed() -> None:
    cut = "events=[{kind: link_drop, at_s: 3, drone: 1, loss_db: 60}]"
    record = run_sortie(example(cut, "radio.relay_max_hops=3"))
    rows = record.tables["topology"].to_pylist()
    assert [round(r["t_s"]) for r in rows] == list(range(6))
    assert all(r["connected"] and r["cut_drones"] == [] and r["bottleneck_mbps"] > 20 for r in rows[:3])
    assert all(not r["connected"] and r["cut_drones"] == [1] for r in rows[4:])
    assert run_sortie(example()).tables["topology"].num_rows == 0


@pytest.mark.parametrize("quality", ["loss,1", "goodput_mbps,0", "snr_db,-30"])
def test_links_that_a_trace_cuts_are_not_usable(quality: str, tmp_path: Path) -> None:
    name, value = quality.split(",")
    links = [f"0,{i},{j},{value}" for i in range(5) for j in range(5) if i != j and 1 in (i, j)]
    (tmp_path / "links.csv").write_text("\n".join([f"t_s,sender,receiver,{name}", *links]) + "\n")
    record = run_sortie(example(f"radio.trace={tmp_path / 'links.csv'}", "radio.relay_max_hops=3"))
    assert set(record.tables["medium"]["connected_drones"].to_pylist()) == {4}
    assert [cut for cut in record.tables["topology"]["cut_drones"].to_pylist() if cut != [1]] == []


@pytest.mark.parametrize(("power_dbm", "gained"), [(8, 0), (-4, 2)])
def test_a_trace_of_one_link_leaves_the_others_as_they_are(power_dbm: int, gained: int, tmp_path: Path) -> None:
    """Links of 150 m or more come and go about 0 dB; or none is there, but the one that is there by its trace."""
    far = ("fleet.formation.spacing_m=150", f"radio.tx_power_dbm={power_dbm}")
    (tmp_path / "links.csv").write_text("t_s,sender,receiver,loss\n0,0,1,0\n")
    alone, traced = (run_sortie(example(*far, *t)) for t in ((), (f"radio.trace={tmp_path / 'links.csv'}",)))
    before, after = (r.tables["medium"]["connected_drones"].to_pylist() for r in (alone, traced))
    assert min(before) < 5
    assert after == [k + gained for k in before]


def test_a_link_is_first_unknown_then_probed_then_measured_then_silent() -> None:
    """Drone 1's links break at 4 s. What each descriptor says of its link to drone 0, and why drone 0 sends what."""
    record = run_sortie(example("events=[{kind: link_drop, at_s: 4, drone: 1, loss_db: 90}]"))
    said = [d for d in record.tables["descriptors"].to_pylist() if d["drone"] == 1]
    states = [(d["t_s"], state_of(d["goodput_mbps"][0])) for d in said]
    order = [states[0][1], *(b for (_, a), (_, b) in pairwise(states) if b != a)]
    assert order == [LinkState.UNKNOWN, LinkState.PROBED, LinkState.MEASURED, LinkState.SILENT]
    assert max(t_s for t_s, state in states if state == LinkState.PROBED) > 0.3
    reasons = [r["reason"] for r in record.tables["directives"].to_pylist() if r["drone"] == 1]
    assert reasons[0] == "goodput not measured lately"
    assert "goodput: link silent, nothing got through" in reasons
    assert sum("goodput 0.0" in reason for reason in reasons) <= 1  # of a payload that waited behind the silent link


def test_given_context_makes_the_policy_do_what_the_paper_tells() -> None:
    scenario = load("paper_context", ["perception.detector=none"])
    record = run_sortie(scenario)
    checks = check(scenario, record, outcome(record))
    assert [c for c in checks if not c.holds] == []
    assert len(checks) == 7


STOP_S = 4.0
LAST_WORD_S = STOP_S + MEASURED_FOR_S + 0.3
"""A measurement just before the stop expires, and the next descriptor says so."""


@pytest.mark.parametrize(("loss_db", "state"), [(120, LinkState.SILENT), (0, LinkState.PROBED)])
def test_a_link_without_payloads_forgets_its_goodput(loss_db: int, state: LinkState) -> None:
    """All payloads end at 4 s. Whether the link is there shows by the descriptors alone."""
    lost = "" if not loss_db else f"{{kind: link_drop, at_s: {STOP_S}, drone: 1, loss_db: {loss_db}}}"
    stop = f"policy={{name: best-2, changes: [{{at_s: {STOP_S}, name: silence}}]}}"
    record = run_sortie(example("duration_s=8", "perception.detector=none", stop, f"events=[{lost}]"))
    said = [d for d in record.tables["descriptors"].to_pylist() if d["drone"] == 1]
    assert any(mbps > 5.0 for d in said if d["t_s"] < STOP_S for mbps in d["goodput_mbps"])
    last = [{state_of(mbps) for mbps in d["goodput_mbps"]} for d in said if d["t_s"] > LAST_WORD_S]
    assert len(last) > 10
    assert set().union(*last) == {state}


def test_a_drone_is_linked_by_those_that_fly() -> None:
    """1 is lost, then 2 is cut off, then 3 is lost as well: who is gone has no link, and is none to others."""
    record = run_sortie(
        example(
            "duration_s=5.2", "perception.detector=none", "events=[{kind: drone_lost, at_s: 0.5, drone: 1}, "
            "{kind: link_drop, at_s: 1.5, drone: 2, loss_db: 200}, {kind: drone_lost, at_s: 2.5, drone: 3}, "
            "{kind: drone_lost, at_s: 3.5, drone: 4}, {kind: drone_joins, at_s: 4.5, drone: 4}]",
        )
    )  # fmt: skip
    assert record.tables["medium"]["connected_drones"].to_pylist() == [5, 4, 3, 2, 0, 2]
