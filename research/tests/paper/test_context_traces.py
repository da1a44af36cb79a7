"""The shipped context traces: the files are what their maker writes, and tell what their README says."""

from __future__ import annotations

import csv

import pytest

from research.paper import context_traces as ct
from sortie.scenarios.reading.load import load


def rows(name: str) -> list[dict[str, str]]:
    with (ct.PAPER_120S / name).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", ct.FILES)
def test_the_files_are_what_their_maker_writes(name: str) -> None:
    assert (ct.PAPER_120S / name).read_text() == ct.text(name)


def test_drone_1_falls_through_both_thresholds() -> None:
    soc = {float(r["t_s"]): float(r["soc"]) for r in rows("drones.csv") if r["drone"] == str(ct.TIRED)}
    assert soc[30.0] > 0.6 > soc[40.0]
    assert soc[90.0] > 0.3 > soc[100.0]
    others = [r for r in rows("drones.csv") if r["drone"] != str(ct.TIRED)]
    assert min(float(r["soc"]) for r in others) > 0.6


@pytest.mark.parametrize(("name", "drones"), [("links.csv", ct.DRONES), ("steady_links.csv", ct.STEADY_DRONES)])
def test_drone_2_loses_its_links_within_one_period_and_no_other(name: str, drones: int) -> None:
    for r in rows(name):
        cut = str(ct.CUT_OFF) in (r["sender"], r["receiver"]) and float(r["t_s"]) >= ct.LINK_DROP_S
        mbps = float(r["goodput_mbps"])
        assert 0 < mbps < 5 if cut else mbps > 200
    assert {float(r["t_s"]) for r in rows(name)} >= {59.9, 60.0}
    assert len({(r["sender"], r["receiver"]) for r in rows(name)}) == drones * (drones - 1)


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
