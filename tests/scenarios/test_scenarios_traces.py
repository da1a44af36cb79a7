"""Traces: where they are found, and what is wrong with one that cannot be read."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from places import ROOT

from sortie.scenarios.reading.campaign import load_campaign
from sortie.scenarios.reading.load import load
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.scenarios.shipped import located
from sortie.scenarios.traces import TraceError, read_columns

TRACES = ROOT / "scenarios" / "library" / "traces"


def test_a_trace_in_another_encoding_is_told(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_bytes("t_s,höhe_m\n0,1\n".encode("latin-1"))
    what = f"{path}: names of columns are in another encoding, must be UTF-8"
    with pytest.raises(TraceError, match=f"^{re.escape(what)}$"):
        read_columns(path, {"t_s": (0.0, 1.0)})


def test_two_columns_of_one_name_are_told(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_text("t_s,x_m,x_m,note,note\n0,1,2,3,4\n")
    with pytest.raises(TraceError) as caught:
        read_columns(path, {"t_s": (0.0, 1.0), "x_m": (0.0, 1.0)})
    assert str(caught.value) == f"{path}: 2 columns x_m, must be one at most"
    assert list(read_columns(path, {"t_s": (0.0, 1.0)})) == ["t_s"]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32", "cp500"])
def test_a_trace_in_an_encoding_of_other_letters_is_one_line(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_bytes("t_s,x_m\n0,1\n".encode(encoding))
    with pytest.raises(TraceError) as caught:
        read_columns(path, {"t_s": (0.0, 1.0)})
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value).splitlines()) == 1


def test_an_error_is_one_line_whatever_a_file_holds() -> None:
    assert str(TraceError("a\nb\u2028c\td\udcff")) == "a\\nb\\u2028c\\td\\udcff"
    assert str(TraceError("ρ " * 5000)) == "ρ " * 999 + "ρ…"


def test_a_shipped_trace_is_found_by_its_name() -> None:
    path = located(Path("paper_120s/links.csv"))
    assert path.samefile(TRACES / "paper_120s" / "links.csv")
    with pytest.raises(TraceError, match="no such file"):
        read_columns(TRACES / "nowhere.csv", {})


def test_a_name_that_no_file_can_have_is_no_file(tmp_path: Path) -> None:
    """A scenario that names it ended in OSError."""
    (tmp_path / "a.yaml").write_text(f"name: a\nfleet: {{trace: {'a' * 400}}}\n")
    assert load(tmp_path / "a.yaml").fleet.trace == "a" * 400
    with pytest.raises(TraceError, match="no such file"):
        read_columns(Path("a" * 400), {})


def test_a_field_named_thousands_deep_is_one_line(tmp_path: Path) -> None:
    """It ended in RecursionError."""
    (tmp_path / "a.yaml").write_text(
        f"campaign: a\nbase: track_target\nmetrics: [ap50]\nset:\n  {'.'.join('a' * 500)}: 1\n"
    )
    with pytest.raises(ScenarioError, match=r"a\.yaml:\d+: .*levels deep, must be at most 20$"):
        load_campaign(tmp_path / "a.yaml")
