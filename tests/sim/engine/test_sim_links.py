"""Tiles, bursts, traces and relays in a whole sortie: what arrives is fused, what is cut off is noted."""

from __future__ import annotations

import functools
from itertools import pairwise
from pathlib import Path

import pyarrow.compute as pc
import pytest
from recorded import recorded
from sim_examples import example

from sortie.scenarios.link_state import MEASURED_FOR_S, LinkState, state_of
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

LOSSY = (
    "policy={name: all-4, params: {received_budget: 0.1}}",
    "radio={retry_limit: 0, bursts: {loss_good: 0.05}}",
    "perception.detector=surrogate",
    "duration_s=4",
)
TILES = "radio.framing=tiles"


@functools.cache
def flown(*sets: str) -> SortieRecord:
    """A flight of its own: the recorded ones have whole payloads and no traces."""
    return run_sortie(example(*sets))


def assert_bytes_add_up(record: SortieRecord) -> None:
    of, sent = outcome(record)["bytes"], record.tables["transmissions"]
    assert of["data_sent"] == sum(of[f"data_{s}"] for s in ("delivered", "lost", "expired", "in_flight"))
    assert of["data_delivered"] == pc.sum(sent["arrived_bytes"]).as_py()
    for fate in ("delivered", "lost", "expired"):
        assert of[f"data_{fate}"] == record.totals[f"data_{fate}_bytes"]


def test_payloads_arrive_in_part_and_parts_are_fused_where_samples_are_lost() -> None:
    tiled, whole = flown(*LOSSY, TILES), flown(*LOSSY)
    assert_bytes_add_up(tiled)
    sent = tiled.tables["transmissions"]
    partial = sent.filter(pc.equal(sent["status"], "partial"))
    assert partial.num_rows > 0.5 * sent.num_rows
    assert pc.all(pc.less(partial["arrived_bytes"], partial["payload_bytes"])).as_py()
    assert set(partial["representation"].to_pylist()) == {"features"}
    assert outcome(tiled)["deadline_miss_rate"] < 0.01  # fragments are lost, deadlines are not missed
    fused = [pc.sum(pc.list_value_length(r.tables["fusions"]["peers"])).as_py() for r in (tiled, whole)]
    assert fused[0] > 2 * fused[1]
    assert outcome(tiled)["ap50"]["full_scene"] > outcome(whole)["ap50"]["full_scene"]


def test_a_payload_that_its_deadline_cuts_short_has_missed_it() -> None:
    record = flown("policy={name: all-4, params: {received_budget: 1.0}}", TILES, "duration_s=3.5")
    assert_bytes_add_up(record)
    result = outcome(record)
    fates = result["payload_fates"]
    cut = sum(fates.get(f"partial/{r}", 0) for r in ("replaced", "deadline_in_service", "deadline_queued"))
    assert cut > 50
    known = sum(fates.values()) - fates["in_flight"]
    late = sum(n for fate, n in fates.items() if fate.startswith("expired/"))
    assert result["deadline_miss_rate"] == pytest.approx((late + cut) / known)
    rows = record.tables["transmissions"].to_pylist()
    rest = [r for r in rows if r["reason"] in ("replaced", "deadline_in_service", "deadline_queued")]
    assert sum(r["payload_bytes"] - r["arrived_bytes"] for r in rest) == result["bytes"]["data_expired"]
    assert result["bytes"]["data_lost"] == 0  # nothing was, on so good a link


def test_the_topology_is_kept_where_payloads_are_relayed() -> None:
    """Drones 0 and 1 are linked to the other pair by station 4 alone, and at times not at all."""
    rows = recorded("relay").tables["topology"].to_pylist()
    assert [round(r["t_s"]) for r in rows] == list(range(8))
    assert all(r["cut_drones"] == ([] if r["connected"] else [0, 1]) for r in rows)
    assert sum(r["connected"] for r in rows) >= 4
    assert all(4 in (r["bottleneck_sender"], r["bottleneck_receiver"]) for r in rows)
    assert recorded("base").tables["topology"].num_rows == 0


def usable(record: SortieRecord) -> set[tuple[float, int, int]]:
    """Time, sender and receiver of the usable links."""
    rows = record.tables["links"].to_pylist()
    return {(round(row["t_s"], 6), row["sender"], row["receiver"]) for row in rows if row["usable"]}


def test_links_that_a_trace_cuts_are_not_usable_and_others_stay_as_they_are(tmp_path: Path) -> None:
    """A trace of all links of drone 1; then of one link, where links of 150 m or more come and go about 0 dB."""
    file, few = tmp_path / "links.csv", ("duration_s=2", "mission.phases=[{}]")
    for quality in ("loss,1", "goodput_mbps,0", "snr_db,-30"):
        name, value = quality.split(",")
        links = [f"0,{i},{j},{value}" for i in range(5) for j in range(5) if i != j and 1 in (i, j)]
        file.write_text("\n".join([f"t_s,sender,receiver,{name}", *links]) + "\n")
        record = run_sortie(example(*few, f"radio.trace={file}", "radio.relay_max_hops=3"), "silence")
        assert usable(record) == {(t_s, i, j) for t_s in (0, 1) for i in (0, 2, 3, 4) for j in (0, 2, 3, 4) if i != j}
        if quality != "goodput_mbps,0":  # a trace of goodput leaves descriptors to the channel
            assert record.tables["medium"]["connected_drones"].to_pylist() == [0, 4]
        assert [cut for cut in record.tables["topology"]["cut_drones"].to_pylist() if cut != [1]] == []
    file.write_text("t_s,sender,receiver,loss\n0,0,1,0\n")
    for power_dbm in (8, -4):
        far = ("fleet.formation.spacing_m=150", f"radio.tx_power_dbm={power_dbm}", "duration_s=6")
        before, after = (usable(run_sortie(example(*few, *far, *t), "silence")) for t in ((), (f"radio.trace={file}",)))
        assert after == before | {(t_s, 0, 1) for t_s in range(6)}


def test_a_link_is_first_unknown_then_probed_then_measured_then_silent() -> None:
    """Drone 2's links break at 4 s. What each descriptor has of its link to drone 0, and why drone 2 sends what."""
    record = recorded("broken_link")
    rows = [d for d in record.tables["descriptors"].to_pylist() if d["drone"] == 2]
    states = [(d["t_s"], state_of(d["goodput_mbps"][0])) for d in rows]
    order = [states[0][1], *(b for (_, a), (_, b) in pairwise(states) if b != a)]
    assert order == [LinkState.UNKNOWN, LinkState.PROBED, LinkState.MEASURED, LinkState.SILENT]
    assert max(t_s for t_s, state in states if state == LinkState.PROBED) > 0.3
    reasons = [r["reason"] for r in record.tables["directives"].to_pylist() if r["drone"] == 2]
    assert reasons[0] == "goodput not measured lately"
    assert "goodput: link silent, nothing got through" in reasons
    assert sum("goodput 0.0" in reason for reason in reasons) <= 1  # of a payload that waited behind the silent link


STOP_S = 2.0
LAST_WORD_S = STOP_S + MEASURED_FOR_S + 0.3
"""A measurement just before the stop expires, and the next descriptor has it."""


def test_a_link_without_payloads_forgets_its_goodput() -> None:
    """All payloads end at 2 s. Whether the link is there shows by the descriptors alone."""
    stop = f"policy={{name: best-2, changes: [{{at_s: {STOP_S}, name: silence}}]}}"
    for events, state in (
        (f"{{kind: link_drop, at_s: {STOP_S}, drone: 1, loss_db: 120}}", LinkState.SILENT),
        ("", LinkState.PROBED),
    ):
        record = run_sortie(example("fleet.drones=3", stop, f"events=[{events}]"))
        rows = [d for d in record.tables["descriptors"].to_pylist() if d["drone"] == 1]
        assert any(mbps > 5.0 for d in rows if d["t_s"] < STOP_S for mbps in d["goodput_mbps"])
        last = [{state_of(mbps) for mbps in d["goodput_mbps"]} for d in rows if d["t_s"] > LAST_WORD_S]
        assert len(last) > 10
        assert set().union(*last) == {state}


def test_the_drones_that_are_heard_are_counted_each_second() -> None:
    """1 is lost, then 2 is cut off, then 3 is lost as well, then 4: until then it and 0 hear each other, and again from 4.5 s."""
    events = (
        "{kind: drone_lost, at_s: 0.5, drone: 1}, {kind: link_drop, at_s: 1.5, drone: 2, loss_db: 200}",
        "{kind: drone_lost, at_s: 2.5, drone: 3}, {kind: drone_lost, at_s: 3.5, drone: 4}",
        "{kind: drone_joins, at_s: 4.5, drone: 4}",
    )
    record = run_sortie(example("duration_s=5.2", f"events=[{', '.join(events)}]"), "silence")
    assert record.tables["medium"]["connected_drones"].to_pylist() == [0, 5, 4, 3, 2, 2]
