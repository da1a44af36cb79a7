"""Losses of the context plane: counted by hand in tiny fleets, and the same in outcome, page, summary and comparison."""

from __future__ import annotations

import dataclasses

import pyarrow as pa
import pytest
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.explain import explain_metric
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import TABLES, SortieRecord
from sortie.sim.results.report import page
from sortie.sim.results.sentences import losses_in_words
from sortie.sim.results.summary import Summary, outcome_table
from sortie.sim.studies.compare import Contender, compare
from sortie.sim.studies.comparison_text import comparison_markdown

CAUSES = tuple(TABLES["receptions"])[2:]
NOTHING = dict.fromkeys(CAUSES, 0.0)


def cut_at(at_s: float) -> str:
    """All links of drone 1 are cut from this time on."""
    return f"events=[{{kind: link_drop, at_s: {at_s}, drone: 1, loss_db: 200}}]"


def test_every_reception_after_a_cut_is_lost_to_a_weak_signal() -> None:
    """Two drones at 10 Hz: sixty receptions a second phase, all of them after the cut."""
    result = outcome(run_sortie(example("fleet.drones=2", cut_at(3.0)), "silence"))
    search, track = (phase["context"] for phase in result["phases"])
    assert search == {"lost": 0.0, "lost_to": NOTHING}
    assert track == {"lost": 1.0, "lost_to": NOTHING | {"weak_signal": 1.0}}
    assert result["context"] == {"lost": 0.5, "lost_to": NOTHING | {"weak_signal": 0.5}}


def test_a_cut_within_a_phase_counts_from_its_frame_on() -> None:
    result = outcome(run_sortie(example("fleet.drones=2", cut_at(4.0)), "silence"))
    assert [phase["context"]["lost"] for phase in result["phases"]] == [0.0, pytest.approx(2 / 3)]
    assert result["context"]["lost"] == pytest.approx(1 / 3)


def test_drones_out_of_the_air_neither_send_nor_lose() -> None:
    """Three drones for 2 s are 120 receptions, two for the other 4 s are 80."""
    lost = "events=[{kind: drone_lost, at_s: 2, drone: 2}]"
    record = run_sortie(example("fleet.drones=3", lost), "silence")
    rows = record.tables["receptions"].to_pylist()
    assert [row["t_s"] for row in rows] == pytest.approx([0.1 * frame for frame in range(60)])
    assert sum(sum(row[name] for name in ("heard", *CAUSES)) for row in rows) == 120 + 80
    assert outcome(run_sortie(example("fleet.drones=1"), "silence"))["context"] == {
        "lost": None,
        "lost_to": dict.fromkeys(CAUSES),
    }


def test_the_table_adds_up_to_the_radio_s_counters() -> None:
    record = run_sortie(example("fleet.drones=12", "radio.tx_power_dbm=-5", "duration_s=4.05"))
    table = record.tables["receptions"]
    assert sum(table["heard"].to_pylist()) == record.totals["receptions"]
    assert sum(sum(table[cause].to_pylist()) for cause in CAUSES) == record.totals["missed"] > 50
    assert table.num_rows == record.scenario.frames


@pytest.fixture(scope="module")
def counted() -> SortieRecord:
    """Twenty receptions in the search, eighty in the track, by every cause."""
    record = run_sortie(example("duration_s=6", "perception.detector=none"))
    rows = [
        (0.0, 15, 1, 2, 0, 1, 1),
        (2.9, 0, 0, 0, 0, 0, 0),
        (3.0 - 1e-12, 40, 0, 0, 8, 2, 0),
        (5.9, 30, 0, 0, 0, 0, 0),
    ]
    columns = dict(zip(TABLES["receptions"], zip(*rows, strict=True), strict=True))
    table = pa.table({name: pa.array(columns[name], kind) for name, kind in TABLES["receptions"].items()})
    return dataclasses.replace(record, tables={**record.tables, "receptions": table})


def test_shares_by_cause_and_phase_are_those_counted_by_hand(counted: SortieRecord) -> None:
    result = outcome(counted)
    search, track = (phase["context"] for phase in result["phases"])
    assert search == {
        "lost": 0.25,
        "lost_to": NOTHING
        | {"collision_context": 0.05, "collision_data": 0.1, "weak_signal": 0.05, "half_duplex": 0.05},
    }
    assert track == {"lost": 0.125, "lost_to": NOTHING | {"hidden": 0.1, "weak_signal": 0.025}}
    assert result["context"]["lost"] == 0.15
    assert result["context"]["lost_to"] == {
        "collision_context": 0.01, "collision_data": 0.02, "hidden": 0.08, "weak_signal": 0.03, "half_duplex": 0.01,
    }  # fmt: skip


TOLD = "8.0 % hidden senders, 3.0 % weak signals, 2.0 % collisions with payloads, 1.0 % own transmissions, 1.0 % collisions with descriptors"


def test_page_summary_and_reasons_tell_it(counted: SortieRecord) -> None:
    result = outcome(counted)
    assert losses_in_words(result["context"]) == TOLD
    html = page(counted)
    assert "Descriptors lost" in html
    assert TOLD in html
    assert "<td>25.0 %</td>" in html
    assert "<td>12.5 %</td>" in html
    told = " ".join(str(Summary(outcome_table(result))).split())
    assert "15.0 % of receptions (8.0 % hidden senders, 3.0 % weak signals" in told
    assert explain_metric("context.lost", counted, result).startswith(f"descriptors lost: {TOLD}")


def test_a_comparison_has_the_mean_over_sorties() -> None:
    half, third = (
        example("fleet.drones=2", "policy.name=silence", "policy.params={}", cut_at(at)) for at in (3.0, 4.0)
    )
    flown = compare([Contender("half", half), Contender("third", third)], [1, 2])
    assert "| descriptors lost | 50.0 % | 33.3 % |" in comparison_markdown(flown, "sortie compare")
