"""The page of results: whole, well-formed, needing nothing else, and true to the outcome."""

from __future__ import annotations

import builtins
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from sim_examples import example
from typer.testing import CliRunner

from sortie.scenarios.report_text import size
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.results import report_figures, run_folder
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.report import page, save_page
from sortie.sim.results.report_figures import moments
from sortie.sim.results.sentences import decision_in_words

VOID = {"meta", "br", "link", "img"}


class Page(HTMLParser):
    """Holds a page's text, its elements, and whatever it would fetch; fails where elements do not close."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.count: dict[str, int] = {}
        self.text: list[str] = []
        self.rows: list[list[str]] = []
        self.fetched: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        self.fetched += [v for k, v in attrs if k in ("src", "href", "xlink:href") and v and not v.startswith("#")]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)
        if "td" in self.open or "th" in self.open:
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    event = "events=[{kind: link_drop, at_s: 4, drone: 2, loss_db: 60}]"
    return run_sortie(example("duration_s=6", event, "description='Cars & <houses>'"))


@pytest.fixture(scope="module")
def html(record: SortieRecord) -> str:
    return page(record)


@pytest.fixture(scope="module")
def read(html: str) -> Page:
    return Page(html)


def test_the_page_stands_alone(read: Page, html: str) -> None:
    assert read.fetched == []
    assert "script" not in read.count
    assert "@import" not in html
    assert not re.search(r"url\((?!#)", html)
    assert read.count["svg"] == 6  # no accuracy: there was no detector
    assert len(html) < 1_000_000


def test_text_of_users_is_text(read: Page, html: str) -> None:
    assert "Cars & <houses>" in read.text
    assert "<houses>" not in html


def test_every_decision_and_event_is_there_in_order(read: Page, record: SortieRecord) -> None:
    result = outcome(record)
    expected = [(t["t_s"], decision_in_words(t)) for t in result["transitions"]]
    expected.append((4.0, "drone 2: links of 2 lose 60 dB"))
    rows = [row for row in read.rows if len(row) == 2 and row[0].endswith(" s")]
    assert len(expected) > 5
    assert rows == [[f"{t_s:.2f} s", text] for t_s, text in sorted(expected, key=lambda e: e[0])]


def test_figures_of_the_outcome_are_the_page_s(read: Page, record: SortieRecord) -> None:
    result = outcome(record)
    assert size(result["bytes"]["data_delivered"]) in read.text
    assert f"{result['energy_j']['total'] / 1e3:.1f} kJ" in read.text
    assert any(result["fingerprint"] in text for text in read.text)
    drones = [row for row in read.rows if re.fullmatch(r"drone \d", row[0])]
    assert [row[1] for row in drones] == [f"{100 * d['soc']:.1f} %" for d in result["drones"].values()]


def test_the_same_run_gives_the_same_page(html: str, record: SortieRecord) -> None:
    assert page(record) == html


def test_a_run_in_which_nothing_was_sent_has_a_page() -> None:
    read = Page(page(run_sortie(example("duration_s=2", "fleet.drones=1"), "silence")))
    assert "Nobody ever sent anything, and nothing happened to the fleet." in read.text


ALL_LOST = "events=[{kind: drone_lost, at_s: 0, drone: 0}, {kind: drone_lost, at_s: 0, drone: 1}]"


@pytest.mark.parametrize(
    ("policy", "sets", "empty"),
    [
        ("worked", ("fleet.drones=2", ALL_LOST), ("descriptors", "transmissions", "directives", "fusions", "ages")),
        ("worked", ("duration_s=0.05",), ("transmissions", "fusions")),
        ("worked", ("fleet.drones=1",), ("transmissions", "directives")),
        ("silence", (), ("transmissions",)),
    ],
    ids=["no descriptors", "no fusions", "one drone", "no transmissions"],
)
def test_a_table_without_rows_leaves_every_figure_whole(
    policy: str, sets: tuple[str, ...], empty: tuple[str, ...]
) -> None:
    record = run_sortie(example("duration_s=2", "perception.detector=surrogate", *sets), policy)
    assert [name for name in empty if record.tables[name].num_rows] == []
    assert Page(page(record)).count["svg"] == 7


def drawn(draw: Any, record: SortieRecord) -> Any:
    axes = Figure().add_subplot()
    draw(axes, record)
    return axes


def test_handshakes_are_traffic_too() -> None:
    record = run_sortie(example("duration_s=2"), "who2com-style")
    assert "handshake delivered" in page(record)
    assert {line.get_label() for line in drawn(report_figures._traffic, record).get_lines()} >= {"handshake delivered"}


def test_a_last_second_that_is_short_is_one_in_every_figure() -> None:
    """2.25 s: the last quarter of a second has its own rate, accuracy and age, at the end of the sortie."""
    record = run_sortie(example("duration_s=2.25", "perception.detector=surrogate", "perception.sample_rate_hz=10"))
    ends = [1.0, 2.0, 2.25]
    sent = record.tables["transmissions"].to_pylist()
    for line in drawn(report_figures._traffic, record).get_lines():
        t_s, mbps = line.get_data()
        assert t_s.tolist() == ends
        kind = [r for r in sent if f"{r['representation']} {r['status']}" == line.get_label()]
        late = sum(r["payload_bytes"] for r in kind if r["t_done_s"] >= 2.0)
        assert mbps[-1] == pytest.approx(late * 8e-6 / 0.25)
    for draw in (report_figures._accuracy, report_figures._age):
        line = drawn(draw, record).get_lines()[0]
        assert line.get_xdata().tolist() == ends
    last = record.tables["ages"].filter(pc.greater_equal(record.tables["ages"]["t_s"], 2.0))["age_s"].to_numpy()
    assert line.get_ydata()[-1] == pytest.approx(1e3 * np.percentile(last, 99))


def test_a_lane_says_nothing_of_a_drone_that_is_down() -> None:
    record = run_sortie(example("duration_s=6", "events=[{kind: drone_lost, at_s: 4, drone: 2}]"))
    lanes: dict[int, list[tuple[float, float, str]]] = {i: [] for i in range(record.scenario.fleet.drones)}
    for bar in drawn(report_figures._lanes, record).collections:
        box = bar.get_datalim(bar.axes.transData)
        lanes[round((box.y0 + box.y1) / 2)].append((box.x0, box.x1, to_hex(bar.get_facecolor()[0])))
    assert lanes[2][-2][1:] == (4.0, report_figures.SENT["features"])
    assert lanes[2][-1] == (4.0, 6.0, report_figures.SENT["nothing"])
    assert lanes[0][-1][1:] == (6.0, report_figures.SENT["features"])


def test_a_lane_goes_on_when_a_drone_comes_back_or_joins() -> None:
    events = "{kind: drone_lost, at_s: 2, drone: 2}, {kind: drone_joins, at_s: 3, drone: 2}, {kind: drone_joins, at_s: 3, drone: 1}"
    record = run_sortie(example("duration_s=6", f"events=[{events}]"))
    told = {
        (row["drone"], row["airborne"]): row["t_s"]
        for row in report_figures.landings(record)
        if row["t_s"] > 0 or row["drone"] == 1
    }
    assert told == pytest.approx({(1, False): 0.0, (1, True): 3.0, (2, False): 2.0, (2, True): 3.0})
    last = {}
    for bar in drawn(report_figures._lanes, record).collections:
        box = bar.get_datalim(bar.axes.transData)
        last[round((box.y0 + box.y1) / 2)] = (box.x1, to_hex(bar.get_facecolor()[0]))
    assert last[1] == last[2] == (6.0, report_figures.SENT["features"])


@pytest.fixture(scope="module")
def eventful() -> SortieRecord:
    """Events at 2 s (twice), at 3 s with a change of phase, and a jammer."""
    return run_sortie(
        example(
            "duration_s=8",
            "mission.phases=[{phase: search}, {phase: track, at_s: 3, region: {radius_m: 30}}]",
            "events=[{kind: link_drop, at_s: 2, drone: 2, loss_db: 60}, {kind: link_drop, at_s: 2, drone: 1, loss_db: 3},"
            " {kind: jam, at_s: 3, until_s: 5, position_m: [10, 20, 5]}, {kind: drone_lost, at_s: 6, drone: 3}]",
        )
    )


def test_events_have_numbers_in_the_figures_and_words_above_them(eventful: SortieRecord) -> None:
    """Of the same moment, one number; a phase that changes with an event stands behind its number."""
    happened = moments(eventful)
    assert [t_s for t_s, _ in happened] == [2.0, 3.0, 5.0, 6.0]
    assert [len(texts) for _, texts in happened] == [2, 1, 1, 1]
    axes = drawn(report_figures.mark_moments, eventful)
    assert [(text.xy[0], text.get_text()) for text in axes.texts] == [
        (2.0, "1"),
        (3.0, "2 track"),
        (5.0, "3"),
        (6.0, "4"),
    ]
    assert "6 s: drone 3: fell silent" in " ".join(Page(page(eventful)).text)


def test_legends_lie_beside_the_curves(eventful: SortieRecord) -> None:
    for draw in (report_figures._lanes, report_figures._traffic, report_figures._goodput, report_figures._map):
        axes = drawn(draw, eventful)
        legend = axes.get_legend()
        assert legend.get_bbox_to_anchor().x0 >= axes.get_window_extent().x1


def test_the_map_shows_the_jammer_and_where_the_region_was(eventful: SortieRecord) -> None:
    axes = drawn(report_figures._map, eventful)
    jammer = next(line for line in axes.get_lines() if line.get_label() == "jammer")
    assert (jammer.get_xdata()[0], jammer.get_ydata()[0]) == (10, 20)
    assert [text.get_text() for text in axes.texts] == ["3–5 s"]
    discs = [patch.center for patch in axes.patches]
    regions = [r for r in eventful.tables["mission"].to_pylist() if r["region_radius_m"] == 30.0]
    assert discs[0] == (regions[0]["region_x_m"], regions[0]["region_y_m"])
    assert discs[-1] == (regions[-1]["region_x_m"], regions[-1]["region_y_m"])
    assert len(discs) == 2 * report_figures.DISCS


def test_what_arrived_is_told_second_by_second(eventful: SortieRecord) -> None:
    """By counting: a span has the richest payload that was delivered in each of its seconds."""
    ladder = ["detections", "tracks", "features", "raw"]
    best: dict[tuple[int, int], int] = {}
    for row in eventful.tables["transmissions"].to_pylist():
        if row["status"] in ("delivered", "partial"):
            second = row["drone"], int(row["t_done_s"])
            best[second] = max(best.get(second, 0), ladder.index(row["representation"]))
    told = {
        (drone, second): ladder.index(kind)
        for drone, begin_s, until_s, kind in report_figures.arrived(eventful)
        for second in range(int(begin_s), int(until_s))
    }
    assert told == best
    assert len({drone for drone, _ in told}) == 5
    assert (3, 7) not in told  # it is lost by then


def test_what_is_delivered_in_all_seconds_is_the_outcome_s_also_of_payloads_that_came_in_part() -> None:
    weak = ["radio.framing=tiles", "radio.tx_power_dbm=-4", "radio.bandwidth_mhz=20"]
    flown = run_sortie(example("duration_s=3.5", "perception.detector=none", *weak))
    result, (until_s, mbps) = outcome(flown), report_figures.delivered_mbps(flown).T
    assert any(fate.startswith("partial") for fate in result["payload_fates"])
    assert (mbps * np.diff(until_s, prepend=0.0)).sum() / 8e-6 == pytest.approx(result["bytes"]["data_delivered"])


def test_the_command_writes_it_into_the_run(record: SortieRecord, tmp_path: Path) -> None:
    run_folder.save(record, tmp_path / "run")
    said = CliRunner().invoke(app, ["report", str(tmp_path / "run")])
    assert said.exit_code == 0, said.output
    assert (tmp_path / "run" / "report.html").read_text("utf-8") == page(record)
    run_folder.save(record, tmp_path / "run")  # a run with a report is a run still
    save_page(record, tmp_path / "new" / "page.html")
    assert (tmp_path / "new" / "page.html").read_text("utf-8") == page(record)
    with pytest.raises(RunError, match=r"page\.html/again\.html: cannot be written"):
        save_page(record, tmp_path / "new" / "page.html" / "again.html")


def test_without_matplotlib_it_is_said_how_to_get_it(record: SortieRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(RunError, match=r"^matplotlib is missing: pip install 'sortie-sim\[report\]'$"):
        page(record)
