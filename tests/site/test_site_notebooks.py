"""The notebooks' outputs as they were kept: pictures are there and show something, and the code that made them is this code."""

from __future__ import annotations

import base64
import io
import json
import re
from typing import Any

import pytest
from PIL import Image
from run_notebooks import NOTEBOOKS, code_hash

pytestmark = pytest.mark.slow

AGAIN = "run `make outputs`"


@pytest.fixture(params=NOTEBOOKS, ids=lambda p: p.stem)
def notebook(request: pytest.FixtureRequest) -> dict[str, Any]:
    """A notebook with every cell's text in one piece."""
    found: dict[str, Any] = json.loads(request.param.read_text("utf-8"))
    for cell in found["cells"]:
        cell["source"] = "".join(cell["source"])
    return found


def outputs(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [output for cell in notebook["cells"] for output in cell.get("outputs", [])]


def pictures(notebook: dict[str, Any]) -> list[Image.Image]:
    """The pictures that a notebook shows."""
    data = [output.get("data", {}).get("image/png") for output in outputs(notebook)]
    return [Image.open(io.BytesIO(base64.b64decode("".join(text)))) for text in data if text is not None]


def test_at_least_two_pictures_show_something(notebook: dict[str, Any]) -> None:
    found = pictures(notebook)
    assert len(found) >= 2, AGAIN
    for picture in found:
        assert min(picture.size) > 100
        assert len(picture.convert("RGB").getcolors(1 << 24) or ()) > 20  # no empty canvas


def test_it_ends_with_a_finding(notebook: dict[str, Any]) -> None:
    titles = re.findall(r"^## (.*)$", "\n".join(cell["source"] for cell in notebook["cells"]), re.M)
    assert {"What it shows", "The findings"} & set(titles)


def test_the_outputs_are_of_this_code(notebook: dict[str, Any]) -> None:
    assert notebook["metadata"]["outputs_of"] == code_hash(notebook["cells"]), AGAIN


def test_nothing_failed_and_no_path_of_the_machine_is_kept(notebook: dict[str, Any]) -> None:
    kinds = {output["output_type"] for output in outputs(notebook)}
    assert kinds <= {"execute_result", "display_data"}, kinds
    assert not re.search(r"/(?:tmp|root|home|Users|var)/", json.dumps(outputs(notebook)))
