"""The page of a comparison: every policy's figures, sorties over time, and nothing fetched."""

from __future__ import annotations

import re
from html import escape
from pathlib import Path

import pytest
from sim_examples import example

import sortie
from sortie.sim.experiment.compare import Flown
from sortie.sim.experiment.comparison_text import side_by_side

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def compared() -> sortie.Comparison:
    scenario = example("duration_s=3", "fleet.drones=2", "perception.detector=surrogate")
    return sortie.compare(scenario, ["worked", "all-4(received_budget=0.1)", "silence"], seeds=2)


def test_the_page_has_each_policy_in_the_table_and_in_every_figure(compared: sortie.Comparison, tmp_path: Path) -> None:
    html = compared.report(tmp_path / "compared.html").read_text("utf-8")
    rows = [re.findall(r"<t[hd]>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", html)]
    assert rows[0] == ["", "worked", "all-4(received_budget=0.1)", "silence"]
    flown = Flown(compared.sorties, compared.gains)
    assert rows[1:] == [[name.strip(), *map(escape, cells)] for name, cells in side_by_side(flown).items()]
    assert not re.search(r"<script|@import|https?://(?!www\.w3\.org|purl\.org|creativecommons\.org)", html)
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", html)
    assert captions[0] == "AP@0.5, full scene"
    assert sum(caption.startswith(("worked: ", "all-4", "silence: ")) for caption in captions) == 3
    accuracy = html.split("Accuracy over the last five seconds, full scene")[1].split("</figure>")[0]
    assert all(f">{policy}</text>" in accuracy for policy in ("worked", "silence"))
    means = [s.outcome["ap50"]["full_scene"] for s in compared.sorties if s.policy == "silence"]
    assert f">{sum(means) / 2:.3g}</text>" in html.split("</figure>")[0]
