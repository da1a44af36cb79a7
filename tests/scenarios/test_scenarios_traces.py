"""The shipped context traces: the files are what their maker writes, and tell what their README says."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from sortie.scenarios import context_traces as ct
from sortie.scenarios.reading.campaign import load_campaign
from sortie.scenarios.reading.load import load
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.scenarios.shipped import located
from sortie.scenarios.traces import TraceError, read_columns


def rows(name: str) -> list[dict[str, str]]:
    with (ct.PAPER_120S / name).open(newline="") as file:
        return list(csv.DictReader(file))


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


@pytest.mark.parametrize("name", ct.FILES)
def test_the_files_are_what_their_maker_writes(name: str) -> None:
    assert (ct.PAPER_120S / name).read_text() == ct.text(name)


def test_a_shipped_trace_is_found_by_its_name() -> None:
    path = located(ct.PAPER_120S.relative_to(ct.TRACES) / "links.csv")
    assert path == ct.PAPER_120S / "links.csv"
    with pytest.raises(TraceError, match="no such file"):
        read_columns(ct.TRACES / "nowhere.csv", {})


def test_drone_1_falls_through_both_thresholds() -> None:
    soc = {float(r["t_s"]): float(r["soc"]) for r in rows("drones.csv") if r["drone"] == str(ct.TIRED)}
    assert soc[30.0] > 0.6 > soc[40.0]
    assert soc[90.0] > 0.3 > soc[100.0]
    others = [r for r in rows("drones.csv") if r["drone"] != str(ct.TIRED)]
    assert min(float(r["soc"]) for r in others) > 0.6


def test_drone_2_loses_its_links_within_one_period_and_no_other() -> None:
    for r in rows("links.csv"):
        cut = str(ct.CUT_OFF) in (r["sender"], r["receiver"]) and float(r["t_s"]) >= ct.LINK_DROP_S
        mbps = float(r["goodput_mbps"])
        assert 0 < mbps < 5 if cut else mbps > 200
    assert {float(r["t_s"]) for r in rows("links.csv")} >= {59.9, 60.0}


def test_the_mission_is_the_scenarios() -> None:
    scenario = load("paper_context")
    track = scenario.mission.phases[1]
    assert scenario.fleet.drones == ct.DRONES
    assert scenario.duration_s == ct.DURATION_S
    assert track.at_s == ct.PHASE_CHANGE_S
    assert track.region is not None
    assert scenario.mission.target is not None
    (x_m, y_m), _ = scenario.mission.target.waypoints_m
    for r in rows("mission.csv"):
        t_s = float(r["t_s"])
        assert r["phase"] == ("track" if t_s >= track.at_s else "search")
        if r["phase"] == "track":
            assert float(r["region_x_m"]) == x_m + scenario.mission.target.speed_mps * t_s
            assert float(r["region_y_m"]) == y_m
            assert float(r["region_radius_m"]) == track.region.radius_m


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
