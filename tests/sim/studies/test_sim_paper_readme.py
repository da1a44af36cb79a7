"""The committed report and the README's results section are what the committed table renders to."""

from __future__ import annotations

import pyarrow.parquet as pq
from places import ROOT

from sortie.perception.evaluation import report, rows
from sortie.perception.evaluation.sensitivity import Varied
from sortie.perception.study import report as study
from sortie.perception.study.figures import CAPTIONS
from sortie.perception.study.measure import from_table
from sortie.perception.study.plan import read_plan
from sortie.sim.folders import replace_section
from sortie.sim.studies import paper


def test_the_repositorys_readme_is_what_its_committed_table_renders_to() -> None:
    table, facts = rows.read(ROOT / "docs" / "paper" / paper.TABLE)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert (
        replace_section(readme, report.short(table, facts, "docs/paper/README.md"), report.BEGIN, report.END) == readme
    )
    text = (ROOT / "docs" / "paper" / paper.REPORT).read_text(encoding="utf-8")
    varied = [Varied(**row) for row in pq.read_table(ROOT / "docs" / "paper" / paper.VARIED).to_pylist()]
    assert text == report.report(table, facts, list(paper.FIGURES.items()), varied)


def test_the_repositorys_study_is_what_its_rows_render_to() -> None:
    folder = ROOT / "docs" / "study"
    rows = from_table(pq.read_table(folder / "study.parquet"))
    plan = read_plan()
    readme = (ROOT / "README.md").read_text("utf-8")
    section = study.short(plan, rows, "docs/study/README.md")
    assert replace_section(readme, section, study.BEGIN, study.END) == readme
    assert (folder / "README.md").read_text("utf-8") == study.report(plan, rows, list(CAPTIONS.items()))
