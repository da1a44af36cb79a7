"""Which decisions are printed: rows by hand, and those of recorded flights."""

from __future__ import annotations

from typing import Any

from record_by_hand import told_outcome
from recorded import recorded
from rich.table import Table
from wrong_rows import wrong_rows

from sortie.sim.results import summary
from sortie.sim.results.decisions import MAX_ROWS, decision_rows
from sortie.sim.results.outcome import outcome

F, D, N = "features", "detections", "nothing"
Step = tuple[float, str, str, str]
"""When a link changes, from what, to what, and why."""


def result(links: dict[str, list[Step]], events: list[tuple[float, int]], phases: list[float]) -> dict[str, Any]:
    """An outcome with these changes, a link `12` from drone 1 to drone 2."""
    names = ("t_s", "from", "to", "reason")
    changes = [
        dict(zip(names, step, strict=True)) | {"drone": int(link[0]), "peers": [int(link[1])]}
        for link, steps in links.items()
        for step in steps
    ]
    return {
        "frame_s": 0.1,
        "transitions": sorted(changes, key=lambda c: c["t_s"]),
        "events": [{"t_s": t_s, "drone": drone, "kind": "drop", "text": "fades"} for t_s, drone in events],
        "phases": [{"begin_s": t_s, "phase": "track"} for t_s in phases],
    }


def back_and_forth(begin_s: float, times: int) -> list[Step]:
    """Down to detections and up again, once a second."""
    one = [(0.0, F, D, "degraded: 0.31 s"), (0.5, D, F, "battery ≥ 60 %")]
    return [(begin_s + k + dt, *rest) for k in range(times) for dt, *rest in one]  # type: ignore[misc]


UP: Step = (1.0, N, F, "battery ≥ 60 %")
CASES: list[tuple[str, dict[str, list[Step]], list[tuple[float, int]], list[float], list[str]]] = [
    ("nothing happens", {}, [], [], []),
    ("links that do alike", {"01": [UP], "20": [UP]}, [], [], ["1.0 0→1 2→0 nothing → features: battery ≥ 60 %"]),
    ("another frame", {"01": [UP], "20": [(1.1, *UP[1:])]}, [], [], [
        "1.0 0→1 nothing → features: battery ≥ 60 %", "1.1 2→0 nothing → features: battery ≥ 60 %"]),
    ("reasons that differ in numbers", {"01": [(1.0, F, D, "goodput 1.5 < 5")], "20": [(1.0, F, D, "goodput 0.2 < 5")]},
        [], [], ["1.0 0→1 2→0 features → detections: goodput 1.5 < 5, …"]),
    ("reasons that differ in words", {"01": [(1.0, F, D, "goodput")], "20": [(1.0, F, D, "silent")]}, [], [], [
        "1.0 0→1 features → detections: goodput", "1.0 2→0 features → detections: silent"]),
    ("flapping is one row", {"01": [UP, *back_and_forth(5.0, 7)]}, [], [], [
        "1.0 0→1 nothing → features: battery ≥ 60 %",
        "5.0 0→1 features ⇄ detections: back and forth 7 times until 11.5 s: degraded (7), battery (7)"]),
    ("once there and back", {"01": back_and_forth(5.0, 1)}, [], [], [
        "5.0 0→1 features ⇄ detections: back and forth once until 5.5 s: degraded (1), battery (1)"]),
    ("what lasts after flapping stays", {"01": [*back_and_forth(5.0, 2), (9.0, F, D, "battery < 30 %")]}, [], [], [
        "5.0 0→1 features ⇄ detections: back and forth 2 times until 6.5 s: degraded (2), battery (2)",
        "9.0 0→1 features → detections: battery < 30 %"]),
    ("a loop of three", {"01": [UP, (2.0, F, D, "slow"), (3.0, D, N, "gone"), (4.0, N, F, "back")]}, [], [], [
        "1.0 0→1 nothing ⇄ features ⇄ detections: back and forth once until 3.0 s: battery (1), slow (1), gone (1)",
        "4.0 0→1 nothing → features: back"]),
    ("down by an event and up when it ends", {"01": [(5.1, F, D, "silent"), (9.0, D, F, "back")]}, [(5.0, 1)], [], [
        "5.0 drone 1 drop: fades", "5.1 0→1 features → detections: silent", "9.0 0→1 detections → features: back"]),
    ("an event of another drone", {"01": back_and_forth(5.1, 1)}, [(5.0, 2)], [], [
        "5.0 drone 2 drop: fades",
        "5.1 0→1 features ⇄ detections: back and forth once until 5.6 s: degraded (1), battery (1)"]),
    ("an event of the fleet, long before", {"01": back_and_forth(6.4, 1)}, [(5.0, -1)], [], [
        "5.0 fleet drop: fades",
        "6.4 0→1 features ⇄ detections: back and forth once until 6.9 s: degraded (1), battery (1)"]),
    ("by a phase", {"01": back_and_forth(5.0, 1)}, [], [5.0], [
        "5.0 fleet phase: track", "5.0 0→1 features → detections: degraded: 0.31 s",
        "5.5 0→1 detections → features: battery ≥ 60 %"]),
]  # fmt: skip


def in_words(outcome: dict[str, Any], max_rows: int = MAX_ROWS) -> list[str]:
    rows, _ = decision_rows(outcome, max_rows)
    who = [" ".join(f"{a}→{b}" for a, b in r.links) or ("fleet" if r.fleet else f"drone {r.drone}") for r in rows]
    return [f"{r.t_s:.1f} {of} {r.what}: {r.why}" for r, of in zip(rows, who, strict=True)]


def test_rows_of_decisions() -> None:
    def check(_: str, links: Any, events: Any, phases: Any, expected: list[str]) -> None:
        got = in_words(result(links, events, phases))
        assert got == expected, got

    assert not (wrong := wrong_rows(CASES, check)), wrong


def test_phases_events_and_what_they_cause_stay_where_rows_are_too_many() -> None:
    """Eighteen links change at times of their own and eighteen flap: these share a row, and what is left out is counted."""
    others = {f"{a}{b}": [(70.0 + 5 * (5 * a + b), N, f"maps {a}{b}", "own")] for a in range(6) for b in range(6, 9)}
    flapping = {f"{a}{b}": back_and_forth(40.0 + a, 3) for a in range(6, 9) for b in range(6)}
    flown = result({**others, **flapping, "91": [(60.1, F, D, "silent")]}, [(60.0, 9)], [0.0, 30.0])
    rows, more = decision_rows(flown)
    got = in_words(flown)
    assert len(rows) == MAX_ROWS or not more
    assert sum("back and forth 54 times" in row for row in got) == 1
    assert decision_rows(flown, 5)[1] == len(rows) + more - 5
    assert [row.split(" ", 1)[1].split(":")[0] for row in in_words(flown, 5)] == [
        "fleet phase", "fleet phase", " ".join(f"{a}→{b}" for a in range(6, 9) for b in range(6)) + " features ⇄ detections",
        "drone 9 drop", "9→1 features → detections",
    ]  # fmt: skip
    together = result({"01": [(5.0, N, F, "up")], "02": [(9.9, N, F, "up")], "03": [(10.0, N, F, "up")]}, [], [])
    assert len(decision_rows(together)[0]) == 3
    assert [row.links for row in decision_rows(together, 2)[0]] == [((0, 1), (0, 2)), ((0, 3),)]


def test_recorded_flights_show_their_events_and_what_these_caused() -> None:
    for name in ("broken_link", "faults", "members", "lost_drone"):
        flown = outcome(recorded(name))
        rows, more = decision_rows(flown)
        assert len(rows) <= MAX_ROWS
        shown = {(row.t_s, row.what) for row in rows}
        assert {(e["t_s"], e["kind"]) for e in flown["events"]} <= shown, name
        assert more == 0 or len(rows) == MAX_ROWS
    lost = [row for row in decision_rows(outcome(recorded("lost_drone")))[0] if (0, 2) in row.links]
    assert [row.what.split(" → ")[1].split(" ")[0] for row in lost][-2:] == ["detections", "nothing"]


def cells(table: Table) -> list[list[str]]:
    """Its rows as they are printed."""
    return [list(row) for row in zip(*(map(str, column.cells) for column in table.columns), strict=True)]


def test_the_table_names_drones_once_and_counts_what_it_leaves_out() -> None:
    """In order of the drones' numbers; of many links the first are named."""
    twenty = ",".join(str(k) for k in range(20, 40))

    def change(t_s: float, drone: int, peers: list[int]) -> dict[str, Any]:
        return {"t_s": t_s, "drone": drone, "from": N, "to": F, "reason": "r", "peers": peers}

    many = [change(0.5, 10, list(range(20, 40))), change(0.5, 9, [3]), change(0.5, 9, [1, 2]), change(0.5, 100, [0])]
    plain = told_outcome() | {"frame_s": 0.1, "phases": [], "events": []}
    events = [{"t_s": 0.6, "drone": 3, "kind": "drone_lost", "text": "fell silent"}]
    table = summary.transitions_table(plain | {"transitions": many, "events": events})
    assert cells(table) == [
        ["0.50", f"9→1,2,3  10→{twenty}  100→0", "nothing → features", "r"],
        ["0.60", "3", "drone_lost", "fell silent"],
    ]
    assert table.caption is None
    ((_, who, _, _),) = cells(summary.transitions_table(plain | {"transitions": [*many, many[0] | {"drone": 0}]}))
    assert who == f"0→{twenty}  9→1,2,3  10→20  and 20 more"
    apart = [change(5.0 * k, 0, [k + 1]) for k in range(MAX_ROWS + 3)]
    assert summary.transitions_table(plain | {"transitions": apart}).caption == "and 3 more in outcome.json"
