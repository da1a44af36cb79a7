"""The notebooks' outputs as they were kept: pictures are there and show something, and the code that made them is this code."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from run_notebooks import NOTEBOOKS, code_hash

pytestmark = pytest.mark.pages


def cells_of(path: Path) -> list[dict[str, Any]]:
    """A notebook's cells, with every text in one piece."""
    cells: list[dict[str, Any]] = json.loads(path.read_text("utf-8"))["cells"]
    for cell in cells:
        cell["source"] = "".join(cell["source"])
    return cells


def outputs(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [output for cell in cells for output in cell.get("outputs", [])]


def pictures(cells: list[dict[str, Any]]) -> list[Image.Image]:
    """The pictures that a notebook shows."""
    data = [output.get("data", {}).get("image/png") for output in outputs(cells)]
    return [Image.open(io.BytesIO(base64.b64decode("".join(text)))) for text in data if text is not None]


def faults(path: Path) -> list[str]:
    """What is wrong with the outputs that a notebook keeps."""
    cells, metadata = cells_of(path), json.loads(path.read_text("utf-8"))["metadata"]
    found = []
    if metadata["outputs_of"] != code_hash(cells):
        found.append("its code has changed since its outputs were made: run `make outputs`")
    shown = pictures(cells)
    if len(shown) < 2:
        found.append("fewer than two pictures")
    empty = [p for p in shown if min(p.size) <= 100 or len(p.convert("RGB").getcolors(1 << 24) or ()) <= 20]
    found += ["an empty picture" for _ in empty]
    titles = re.findall(r"^## (.*)$", "\n".join(cell["source"] for cell in cells), re.M)
    if not {"What it shows", "The findings"} & set(titles):
        found.append("no finding at its end")
    if {output["output_type"] for output in outputs(cells)} - {"execute_result", "display_data"}:
        found.append("an output that is an error or a stream")
    if re.search(r"/(?:tmp|root|home|Users|var)/", json.dumps(outputs(cells))):
        found.append("a path of the machine")
    return found


def test_the_outputs_of_notebooks_are_whole_and_of_this_code() -> None:
    assert len(NOTEBOOKS) >= 5
    assert {path.stem: found for path in NOTEBOOKS if (found := faults(path))} == {}
