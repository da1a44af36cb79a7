"""Losses of the context plane: counted by hand in tiny fleets, and the same in outcome, page and summary."""

from __future__ import annotations

import dataclasses

import pyarrow as pa
import pytest
from recorded import recorded
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.explain import explain_metric
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import TABLES
from sortie.sim.results.report import page
from sortie.sim.results.sentences import losses_in_words
from sortie.sim.results.summary import Summary, outcome_table

CAUSES = tuple(TABLES["receptions"])[2:]
NOTHING = dict.fromkeys(CAUSES, 0.0)


def test_every_reception_after_a_cut_is_lost_to_a_weak_signal() -> None:
    """A flight of its own, of two drones at 10 Hz: a cut at the begin of a phase, and within it from its frame on."""
    for at_s, late in ((3.0, 1.0), (4.0, 2 / 3)):
        cut = f"events=[{{kind: link_drop, at_s: {at_s}, drone: 1, loss_db: 200}}]"
        result = outcome(run_sortie(example("fleet.drones=2", cut), "silence"))
        search, track = (phase["context"] for phase in result["phases"])
        assert search == {"lost": 0.0, "lost_to": NOTHING}
        assert track == {"lost": pytest.approx(late), "lost_to": pytest.approx(NOTHING | {"weak_signal": late})}
        assert result["context"]["lost"] == pytest.approx(late / 2)


def test_drones_out_of_the_air_neither_send_nor_lose_and_a_lone_one_has_nobody_to_hear() -> None:
    """Five drones for 3 s are 600 receptions, four for the other 3 s are 360."""
    record = recorded("lost_drone")
    rows = record.tables["receptions"].to_pylist()
    assert [row["t_s"] for row in rows] == pytest.approx([0.1 * frame for frame in range(60)])
    assert sum(sum(row[name] for name in ("heard", *CAUSES)) for row in rows) == 600 + 360
    alone = run_sortie(example("fleet.drones=1", "duration_s=0.5", "mission.phases=[{at_s: 0}]"))
    assert outcome(alone)["context"] == {"lost": None, "lost_to": dict.fromkeys(CAUSES)}


def test_the_table_adds_up_to_the_radio_s_counters() -> None:
    """A flight of its own, with weak senders and an end within a frame."""
    record = run_sortie(example("fleet.drones=12", "radio.tx_power_dbm=-5", "duration_s=2.05", "mission.phases=[{}]"))
    table = record.tables["receptions"]
    assert sum(table["heard"].to_pylist()) == record.totals["receptions"]
    assert sum(sum(table[cause].to_pylist()) for cause in CAUSES) == record.totals["missed"] > 25
    assert table.num_rows == record.scenario.frames


WORDS = (
    "8.0 % hidden senders, 3.0 % weak signals, 2.0 % collisions with payloads, 1.0 % own transmissions, "
    "1.0 % collisions with descriptors"
)


def test_shares_by_cause_and_phase_are_those_counted_by_hand_wherever_they_are_read() -> None:
    """Twenty receptions in the search, eighty in the track, by every cause."""
    rows = [
        (0.0, 15, 1, 2, 0, 1, 1),
        (2.9, 0, 0, 0, 0, 0, 0),
        (3.0 - 1e-12, 40, 0, 0, 8, 2, 0),
        (5.9, 30, 0, 0, 0, 0, 0),
    ]
    columns = dict(zip(TABLES["receptions"], zip(*rows, strict=True), strict=True))
    table = pa.table({name: pa.array(columns[name], kind) for name, kind in TABLES["receptions"].items()})
    base = recorded("base")
    counted = dataclasses.replace(base, tables={**base.tables, "receptions": table})
    result = outcome(counted)
    search, track = (phase["context"] for phase in result["phases"])
    shares = {"collision_context": 0.05, "collision_data": 0.1, "weak_signal": 0.05, "half_duplex": 0.05}
    assert search == {"lost": 0.25, "lost_to": NOTHING | shares}
    assert track == {"lost": 0.125, "lost_to": NOTHING | {"hidden": 0.1, "weak_signal": 0.025}}
    assert result["context"]["lost"] == 0.15
    assert losses_in_words(result["context"]) == WORDS
    html = page(counted)
    for words in ("Descriptors lost", WORDS, "<td>25.0 %</td>", "<td>12.5 %</td>"):
        assert words in html
    summary = " ".join(str(Summary(outcome_table(result))).split())
    assert "15.0 % of receptions (8.0 % hidden senders, 3.0 % weak signals" in summary
    assert explain_metric("context.lost", counted, result).startswith(f"descriptors lost: {WORDS}")
