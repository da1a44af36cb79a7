"""Pages and stored tables: every page holds what its tables render to, and no measured figure stands outside them."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from paper_examples import ELSEWHERE, Made, papers_world
from places import ROOT

from research.paper import rows
from research.validation import figures
from research.validation.figures import FIGURES, all_sections, pages, seeds_table, speed_table
from research.validation.stored import FOLDER, MARKED, Column, Table, rendered, sections, store
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.experiment.conditions import Cell
from sortie.sim.studies import conditions

GENERATED = {"research/pages/paper/README.md", "research/pages/study/README.md", "sim/results/outcome.md"}
"""Pages that a command writes whole; their own tests hold them to their data."""
BOUNDS = "what tests hold, or what others measured"
DEFINED = "settings, formats and definitions"
NOT_MEASURED = {
    "fleet/README.md": {
        "| what | against | result |": BOUNDS,
        "| claim | compared with | a doubt |": DEFINED,
        "| kind | rule |": DEFINED,
        "| field | default | source |": DEFINED,
    },
    "perception/README.md": {"| part | checked against |": BOUNDS},
    "research/benchmark/README.md": {
        "| split | scenes × frames | for | layouts |": DEFINED,
        "| parameter | default | what it is |": DEFINED,
    },
    "research/paper/README.md": {
        "| ρ | 1 | 0.25 | 0.1 | 0.05 | 0.02 | 0.01 |": DEFINED,
        "| what | against | bound |": BOUNDS,
    },
    "perception/network/fusion/README.md": {
        "| `perception.fusion` | what it does in a cell | reads | bytes per link and frame |": DEFINED,
    },
    "research/flip/README.md": {"| quantity | AP of … | minus AP of … |": DEFINED},
    "research/pages/surrogate.md": {"| step | what it scales | until |": DEFINED},
    "research/pages/fine_network.md": {"| expected of the fine network | found |": DEFINED},
    "research/pages/flip.md": {"| word | meaning |": DEFINED},
    "research/pages/doses.md": {"| word | meaning |": DEFINED},
    "docs/glossary.md": {"| word | meaning |": DEFINED},
    "policies/README.md": {
        "| state | when | `goodput_to` |": DEFINED,
        "| field | default | bounds |": DEFINED,
        "| name | parameters | decides |": DEFINED,
        "| name | parameters | what it does | missing of the published method |": DEFINED,
    },
    "radio/README.md": {
        "| what | against | bound |": BOUNDS,
        "| figure | may differ by |": BOUNDS,
        "| file | what it models |": DEFINED,
    },
    "docs/guide/learn.md": {"| part | is |": DEFINED},
    "docs/guide/scenario.md": {"| row | means |": DEFINED},
    "docs/results/ranking.md": {"| word | means |": DEFINED},
    "scenarios/README.md": {"| name | what it shows |": DEFINED},
    "scenarios/library/traces/README.md": {"| what | value | from |": DEFINED},
    "sim/README.md": {"| when | what |": DEFINED},
    "sim/live/README.md": {"| topic in ROS 2 | type | QoS | who |": DEFINED},
}
"""Tables with numbers that nobody measured, by page and first line, and why."""
ALLOWED = re.compile(r"±102(\.4)?|±0\.02 at every budget|(95|99\.9) %")
"""In sentences: the extent of a map, the surrogate's aim, levels of intervals."""

SECTION = re.compile(r"<!-- (\w+):begin -->.*?<!-- \1:end -->", re.S)
CODE = re.compile(r"^```.*?^```$|`[^`\n]*`|^ {4}.*$", re.S | re.M)
AMOUNT = r"\d(?: ?(?:%|ms|µs|min|kB|MB|GB|Mb/s|kJ|W)(?!\w)| s(?!\w))"
"""A number with a unit in which things are measured here."""
IN_A_TABLE = re.compile(rf"\d\.\d|±|\[[+−-]?\d|{AMOUNT}")
IN_A_SENTENCE = re.compile(r"±|[\[(][+−-]?\d+\.\d+, [+−-]?\d+\.\d+[\])]|(?<![\w.^])[+−]\d+\.\d|\bAP (?:of )?0\.\d")
IN_A_FINDING = re.compile(rf"{IN_A_SENTENCE.pattern}|\d %|\b0\.\d{{3}}\b|\d AP|\d points")
"""In sentences of the pages of results, where a number that is no setting is a finding."""
SETTINGS = re.compile(r"budgets 0\.007, 0\.028, 0\.11 and 0\.45")


def stray(page: str, name: str) -> list[str]:
    """Measured-looking tables (their first lines) and sentences of a page that stand outside its sections."""
    text = CODE.sub(
        lambda code: code[0] if "\n" not in code[0] and code[0].startswith("`") else "", SECTION.sub("", page)
    )
    rule = IN_A_FINDING if name == "README.md" or name.startswith("docs/results/") else IN_A_SENTENCE
    found, head = [], ""
    for line in map(str.strip, text.splitlines()):
        if not line.startswith("|"):
            head = ""
            if rule.search(SETTINGS.sub("", ALLOWED.sub("", re.sub(r"`[^`]*`", "", line)))):
                found.append(line)
        elif not head:
            head = line
        elif IN_A_TABLE.search(re.sub(r"`[^`]*`", "", line)) and head not in (*NOT_MEASURED.get(name, ()), *found):
            found.append(head)
    return found


PAGES = [
    path for path in pages() if path.relative_to(ROOT).as_posix() not in GENERATED and path.parent.name != "weights"
]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_a_page_measures_stands_between_markers(path: Path) -> None:
    """If this fails, give the figure a table (`figures.py`) or leave it out; a definition goes into NOT_MEASURED."""
    assert stray(path.read_text("utf-8"), path.relative_to(ROOT).as_posix()) == []


def test_every_page_is_what_the_stored_tables_render_to() -> None:
    """If this fails: make figures FIGURE=--render."""
    found, seen = all_sections(), []
    for path in pages():
        page = path.read_text("utf-8")
        seen += MARKED.findall(page)
        assert rendered(page, found) == page, path
    assert sorted(seen) == sorted(found)  # every table is on one page


def _refuse(constant: str) -> None:
    pytest.fail(f"{constant} in a table; store None, which is printed as a dash")


def test_every_stored_file_has_its_command() -> None:
    reports = {"paper", "study"}
    assert {path.stem for path in FOLDER.glob("*.json")} == {*FIGURES, *figures.CLOSED} - reports
    for path in FOLDER.glob("*.json"):
        made = json.loads(path.read_text("utf-8"), parse_constant=_refuse)
        assert re.fullmatch(r"\d+\.\d+\.\d+(\+[0-9a-f]{16})?", made["sortie"]), path
        assert ("hardware" in made) == (path.stem in FIGURES and FIGURES[path.stem].timed), path


@pytest.mark.parametrize(
    ("planted", "found"),
    [
        ("| policy | AP |\n|---|---|\n| silence | 0.290 |", ["| policy | AP |"]),
        ("| what | time |\n|---|---|\n| a frame | 12 ms |", ["| what | time |"]),
        ("| what | spent |\n|---|---|\n| a flight | 95 % |", ["| what | spent |"]),
        ("It gains +5.1 points.", ["It gains +5.1 points."]),
        ("It gains 5 [3.6, 6.7].", ["It gains 5 [3.6, 6.7]."]),
        ("It errs by 3 ± 1 m.", ["It errs by 3 ± 1 m."]),
        ("It has an AP of 0.284.", ["It has an AP of 0.284."]),
        ("<!-- t:begin -->\n| a | b |\n|---|---|\n| c | 0.1 |\n<!-- t:end -->", []),
        ("| file | holds |\n|---|---|\n| `a.py` | 802 things |", []),
        ("At ρ = 0.02 a 95 % interval over ±102.4 m, `[1.0, 2.0]`.", []),
        ("```\ngain +5.1 [3.6, 6.7]\n```", []),
    ],
)
def test_a_planted_figure_is_found(planted: str, found: list[str]) -> None:
    assert stray(f"# Page\n\n{planted}\n", "sim/README.md") == found


def test_a_finding_of_the_results_is_found() -> None:
    for line in ("20 of 30 points more", "It misses 18 % of them.", "a drone alone reaches 0.306"):
        assert stray(line, "docs/results/policies.md") == [line]


def test_cells_are_printed_by_their_column() -> None:
    gain = Column("gain", "+.1f", factor=100)
    assert gain.text((0.0512, 0.036, 0.067)) == "+5.1 [+3.6, +6.7]"
    assert gain.text((-0.0512, -0.067, -0.0001)) == "−5.1 [−6.7, 0.0]"
    assert gain.text((0.1, None, None)) == "+10.0"  # type: ignore[arg-type]
    assert Column("data", ",.1f", " kB", 1e-3).text(13_107_200) == "13,107.2 kB"
    assert [Column("of").text(cell) for cell in (None, "4 of 8")] == ["–", "4 of 8"]


def test_a_stored_table_comes_back_and_goes_between_its_markers(tmp_path: Path) -> None:
    one = Table([Column("policy"), Column("AP", ".3f")], [["silence", 0.29], ["worked", None]], "Two sorties.")
    store("some", {"one": one, "two": "as a command\nprinted it"}, {"sortie": "9.9.9", "date": "2026-01-02"}, tmp_path)
    found = sections("some", tmp_path)
    made = "*Made by `make figures FIGURE=some` with Sortie 9.9.9, 2026-01-02.*"
    assert found == {"one": f"{one.markdown()}\n\n{made}", "two": f"as a command\nprinted it\n\n{made}"}
    page = rendered("# Page\n\n<!-- one:begin --><!-- one:end -->\n", found)
    assert page == f"# Page\n\n<!-- one:begin -->\n\n{found['one']}\n\n<!-- one:end -->\n"
    assert rendered(page, found) == page
    with pytest.raises(ValueError, match="no table is called three; there are one, two"):
        rendered("<!-- three:begin --><!-- three:end -->", found)


def test_times_are_printed_in_the_unit_that_reads_best() -> None:
    stats = [{"median": seconds, "rounds": 3} for seconds in (1.2345, 0.0123, 8.5e-6)]
    benchmarks = [
        {"fullname": "tests/benchmarks/test_bench_fleet.py::x", "group": None, "name": "test_a_b", "stats": s}
        for s in stats
    ]
    assert [row[3] for row in speed_table(benchmarks).rows] == ["1.23 s", "12.3 ms", "8.5 µs"]
    assert speed_table(benchmarks).rows[0][:3] == ["fleet", "", "a b"]


def test_gains_over_conditions_are_split_by_phase_and_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty conditions, half of them tracking; `boxes` gains in those alone."""

    def flown(flown_in: ConditionSet, policies: Sequence[str], **_: object) -> list[Cell]:
        gain = {"silence": 0.0, "boxes": 0.2}
        return [
            Cell(p, c.name, 0.3 + gain[p] * (c.metric == "mission"), 1e6, 1.0, 0.01)
            for p in policies
            for c in flown_in.conditions
        ]

    monkeypatch.setattr(conditions, "fly_all", flown)
    made = figures._over_conditions("conditions_fourth", ["silence", "boxes"])
    names, (boxes, silence) = [c.name for c in made.columns], made.rows
    assert names[2:5] == ["over silence", "searching", "tracking"]
    assert list(silence[2:9]) == [None] * 7
    assert boxes[3] == (0.0, 0.0, 0.0)
    assert boxes[4] == pytest.approx((0.2, 0.2, 0.2))
    assert boxes[2][0] == pytest.approx(0.1)  # type: ignore[index]
    assert made.columns[2].text(boxes[2]).startswith("+10.0 [")


def test_verdicts_of_other_seeds_are_counted_against_the_first() -> None:
    table = rows.judge({"zero": Made({}, papers_world)}, ELSEWHERE)
    changed = [dataclasses.replace(row, verdict="another") if row.id == "gain" else row for row in table]
    made = seeds_table({"here": table, "there": changed})
    assert made.rows[0][1] == len(table)
    assert made.rows[0][2] == len(table) - sum(row.id == "gain" for row in table)
    assert all(row[1] == row[2] for row in made.rows[1:])
    assert len(made.rows) > 5
