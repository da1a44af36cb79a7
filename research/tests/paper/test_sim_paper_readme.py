"""The committed reports and the pages of results are what the committed tables render to."""

from __future__ import annotations

import pyarrow.parquet as pq
from places import ROOT

from research.flip import report as study
from research.flip.figures import CAPTIONS
from research.flip.measure import from_table
from research.flip.plan import read_plan
from research.paper import making as paper
from research.paper import report, rows
from research.paper.sensitivity import Varied
from sortie.scenarios.report_text import replace_section


def test_the_page_of_claims_is_what_its_committed_table_renders_to() -> None:
    table, facts = rows.read(ROOT / "research/pages/paper" / paper.TABLE)
    page = (ROOT / "research/pages" / "claims.md").read_text(encoding="utf-8")
    assert replace_section(page, report.short(table, facts, "paper/README.md"), report.BEGIN, report.END) == page
    text = (ROOT / "research/pages/paper" / paper.REPORT).read_text(encoding="utf-8")
    varied = [Varied(**row) for row in pq.read_table(ROOT / "research/pages/paper" / paper.VARIED).to_pylist()]
    assert text == report.report(table, facts, list(paper.FIGURES.items()), varied)


def test_the_repositorys_study_is_what_its_rows_render_to() -> None:
    folder = ROOT / "research/pages/study"
    rows = from_table(pq.read_table(folder / "study.parquet"))
    plan = read_plan()
    page = (ROOT / "research/pages" / "flip.md").read_text("utf-8")
    section = study.short(plan, rows, "study/README.md")
    assert replace_section(page, section, study.BEGIN, study.END) == page
    assert (folder / "README.md").read_text("utf-8") == study.report(plan, rows, list(CAPTIONS.items()))
