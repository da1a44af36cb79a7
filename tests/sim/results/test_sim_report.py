"""The page of results: whole, well-formed, needing nothing else, and true to the outcome."""

from __future__ import annotations

import builtins
import functools
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from recorded import recorded
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
        inside = ("#", "data:image/png;base64,")
        self.fetched += [v for k, v in attrs if k in ("src", "href", "xlink:href") and v and not v.startswith(inside)]
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


@functools.cache
def eventful() -> SortieRecord:
    """A flight of its own: events at 2 s (twice), at 3 s with a change of phase, and a jammer until 5 s."""
    return run_sortie(
        example(
            "duration_s=8",
            "description='Cars & <houses>'",
            "mission.phases=[{phase: search}, {phase: track, at_s: 3, region: {radius_m: 30}}]",
            "events=[{kind: link_drop, at_s: 2, drone: 2, loss_db: 60},"
            " {kind: link_drop, at_s: 2, drone: 1, loss_db: 3},"
            " {kind: jam, at_s: 3, until_s: 5, position_m: [10, 20, 5]}, {kind: drone_lost, at_s: 6, drone: 3}]",
        )
    )


@functools.cache
def html() -> str:
    return page(eventful())


def test_the_page_stands_alone_and_text_of_users_is_text() -> None:
    read = Page(html())
    assert read.fetched == []
    assert "script" not in read.count
    assert "@import" not in html()
    assert not re.search(r"url\((?!#)", html())
    assert read.count["svg"] == 8  # no accuracy: there was no detector
    assert len(html()) < 1_000_000
    assert "Cars & <houses>" in read.text
    assert "<houses>" not in html()
    assert page(eventful()) == html(), "the same run gives the same page"


def test_the_page_s_figures_decisions_and_events_are_the_outcome_s() -> None:
    read, result = Page(html()), outcome(eventful())
    assert size(result["bytes"]["data_delivered"]) in read.text
    assert f"{result['energy_j']['total'] / 1e3:.1f} kJ" in read.text
    assert any(result["fingerprint"] in text for text in read.text)
    drones = [row for row in read.rows if re.fullmatch(r"drone \d", row[0])]
    assert [row[1] for row in drones] == [f"{100 * d['soc']:.1f} %" for d in result["drones"].values()]
    decided = [(t["t_s"], decision_in_words(t)) for t in result["transitions"]]
    happened = [(2.0, "drone 2: links of 2 lose 60 dB"), (6.0, "drone 3: fell silent")]
    rows = [tuple(row) for row in read.rows if len(row) == 2 and row[0].endswith(" s")]
    assert len(decided) > 5
    assert {(f"{t_s:.2f} s", text) for t_s, text in [*decided, *happened]} <= set(rows)
    assert [float(t.split()[0]) for t, _ in rows] == sorted(float(t.split()[0]) for t, _ in rows)


def test_a_table_without_rows_leaves_every_figure_whole() -> None:
    """Short flights of their own, of one or two drones."""
    all_lost = "events=[{kind: drone_lost, at_s: 0, drone: 0}, {kind: drone_lost, at_s: 0, drone: 1}]"
    for policy, sets, empty in (
        ("worked", (all_lost,), {"descriptors", "transmissions", "directives", "fusions", "ages"}),
        ("worked", ("duration_s=0.05",), {"transmissions", "fusions"}),
        ("worked", ("fleet.drones=1",), {"transmissions", "directives"}),
        ("silence", (), {"transmissions"}),
    ):
        short = ("duration_s=0.6", "fleet.drones=2", "mission.phases=[{}]", "perception.detector=surrogate")
        record = run_sortie(example(*short, *sets), policy)
        assert {name for name in empty if record.tables[name].num_rows} == set()
        assert Page(page(record)).count["svg"] == (
            10 if record.scenario.fleet.drones > 1 else 9
        )  # no links of one drone
    nothing = Page(page(run_sortie(example("duration_s=0.5", "mission.phases=[{}]", "fleet.drones=1"), "silence")))
    assert "Nobody ever sent anything, and nothing happened to the fleet." in nothing.text


def drawn(draw: Any, record: SortieRecord) -> Any:
    axes = Figure().add_subplot()
    draw(axes, record)
    return axes


def lanes(record: SortieRecord) -> dict[int, list[tuple[float, float, str]]]:
    """By drone the bars of its lane: begin, end and colour."""
    bars: dict[int, list[tuple[float, float, str]]] = {i: [] for i in range(record.scenario.fleet.drones)}
    for bar in drawn(report_figures._lanes, record).collections:
        box = bar.get_datalim(bar.axes.transData)
        bars[round((box.y0 + box.y1) / 2)].append((box.x0, box.x1, to_hex(bar.get_facecolor()[0])))
    return bars


def test_a_last_second_that_is_short_is_one_in_every_figure_and_handshakes_are_traffic() -> None:
    """A flight of its own, of 2.25 s: the last quarter of a second has its own rate, accuracy and age."""
    sets = ("duration_s=2.25", "perception.detector=surrogate", "perception.sample_rate_hz=10", "fleet.drones=3")
    record = run_sortie(example(*sets, "mission.phases=[{}]"), "who2com-style")
    assert "handshake delivered" in page(record)
    ends = [1.0, 2.0, 2.25]
    sent = record.tables["transmissions"].to_pylist()
    lines = {line.get_label(): line for line in drawn(report_figures._traffic, record).get_lines()}
    assert "handshake delivered" in lines
    for label, line in lines.items():
        t_s, mbps = line.get_data()
        assert t_s.tolist() == ends
        kind = [r for r in sent if f"{r['representation']} {r['status']}" == label]
        late = sum(r["payload_bytes"] for r in kind if r["t_done_s"] >= 2.0)
        assert mbps[-1] == pytest.approx(late * 8e-6 / 0.25)
    for draw in (report_figures._accuracy, report_figures._age):
        line = drawn(draw, record).get_lines()[0]
        assert line.get_xdata().tolist() == ends
    last = record.tables["ages"].filter(pc.greater_equal(record.tables["ages"]["t_s"], 2.0))["age_s"].to_numpy()
    assert line.get_ydata()[-1] == pytest.approx(1e3 * np.percentile(last, 99))


def test_a_lane_shows_nothing_of_a_drone_that_is_down_and_goes_on_when_it_comes_back_or_joins() -> None:
    features, nothing = report_figures.SENT["features"], report_figures.SENT["nothing"]
    down = lanes(eventful())
    assert down[3][-2][1:] == (6.0, features)
    assert down[3][-1] == (6.0, 8.0, nothing)
    assert down[0][-1][1:] == (8.0, features)
    members = recorded("members")
    landings = [
        (r["drone"], round(r["t_s"], 6), r["airborne"]) for r in report_figures.landings(members) if r["t_s"] > 0
    ]
    assert {(1, 1.0, False), (1, 4.0, True), (3, 2.0, True)} <= set(landings)
    last = lanes(members)
    assert last[1][-1][1:] == last[3][-1][1:] == (6.0, features)


def test_events_have_numbers_in_the_figures_and_words_above_them() -> None:
    """Of the same moment, one number; a phase that changes with an event stands behind its number."""
    happened = moments(eventful())
    assert [t_s for t_s, _ in happened] == [2.0, 3.0, 5.0, 6.0]
    assert [len(texts) for _, texts in happened] == [2, 1, 1, 1]
    axes = drawn(report_figures.mark_moments, eventful())
    assert [(text.xy[0], text.get_text()) for text in axes.texts] == [
        (2.0, "1"),
        (3.0, "2 track"),
        (5.0, "3"),
        (6.0, "4"),
    ]
    assert "6 s: drone 3: fell silent" in " ".join(Page(page(eventful())).text)


def test_the_map_shows_the_jammer_and_where_the_region_was() -> None:
    axes = drawn(report_figures._map, eventful())
    jammer = next(line for line in axes.get_lines() if line.get_label() == "jammer")
    assert (jammer.get_xdata()[0], jammer.get_ydata()[0]) == (10, 20)
    assert [text.get_text() for text in axes.texts] == ["3–5 s"]
    discs = [patch.center for patch in axes.patches]
    regions = [r for r in eventful().tables["mission"].to_pylist() if r["region_radius_m"] == 30.0]
    assert discs[0] == (regions[0]["region_x_m"], regions[0]["region_y_m"])
    assert discs[-1] == (regions[-1]["region_x_m"], regions[-1]["region_y_m"])
    assert len(discs) == 2 * report_figures.DISCS


def test_the_command_writes_it_into_the_run(tmp_path: Path) -> None:
    record = eventful()
    run_folder.save(record, tmp_path / "run")
    said = CliRunner().invoke(app, ["report", str(tmp_path / "run")])
    assert said.exit_code == 0, said.output
    assert (tmp_path / "run" / "report.html").read_text("utf-8") == page(record)
    run_folder.save(record, tmp_path / "run")  # a run with a report is a run still
    save_page(record, tmp_path / "new" / "page.html")
    assert (tmp_path / "new" / "page.html").read_text("utf-8") == page(record)
    with pytest.raises(RunError, match=r"page\.html/again\.html: cannot be written"):
        save_page(record, tmp_path / "new" / "page.html" / "again.html")


def test_without_matplotlib_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(RunError, match=r"^matplotlib is missing: pip install 'sortie-sim\[report\]'$"):
        page(eventful())
