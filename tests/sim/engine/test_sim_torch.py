"""What only the torch detector shows: several networks in one flight, and accuracy of what was delivered."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest
from test_sim_makes import BETWEEN, WITHIN, boxes, fleet, fused, silent
from typer.testing import CliRunner

from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.scenarios.shipped import NETWORKS
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.compare import Contender, compare
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

pytestmark = pytest.mark.slow
TRACKED = ("duration_s=8", "mission.phases=[{at_s: 0, phase: track, region: {radius_m: 32}}]", "policy.dwell_s=0.2")
TORCH = ("perception.detector=torch", "duration_s=1.5", "perception.scene.moving_cars_per_km=30")


def test_two_torch_networks_in_one_flight() -> None:
    """Each drone's boxes are its own network's; maps stay within a network, and boxes of the other one are joined."""
    net = NETWORKS / "disconet.safetensors"
    ours, theirs, alone = (
        silent("", *TORCH),
        silent("", *TORCH, f"perception.weights={net}"),
        silent(f"weights: {net}", *TORCH),
    )
    assert boxes(ours, 2) != boxes(theirs, 2)
    assert [boxes(alone, i) for i in (0, 1)] == [boxes(ours, i) for i in (0, 1)]
    assert boxes(alone, 2) == boxes(theirs, 2)
    assert alone.detector == "torch"
    shared = run_sortie(fleet(f"weights: {net}", *TORCH), "all-4")
    assert {(*link, "features") for link in WITHIN} | {(0, 2, "detections"), (2, 0, "detections")} <= fused(shared)
    assert not {(*link, "features") for link in BETWEEN} & fused(shared)
    last_s = max(t_s for t_s, *_ in boxes(shared, 2))
    got, had = ({b for b in boxes(record, 2) if b[0] == last_s} for record in (shared, alone))
    added = [b for b in got - had if not any(np.hypot(b[1] - o[1], b[2] - o[2]) < 0.01 for o in had)]
    sent_to_2 = [b for i in (0, 1) for b in boxes(alone, i)]
    assert added, "it joins what the others found"
    near = [min(np.hypot(b[1] - o[1], b[2] - o[2]) for o in sent_to_2) for b in added]
    assert np.median(near) < 1.0, "which is where their own network put it"


def test_a_torch_drone_and_a_surrogate_one_exchange_boxes_and_coarse_pictures_show_less() -> None:
    record = run_sortie(fleet("detector: surrogate", *TORCH), "all-4")
    assert record.detector == "torch + surrogate"
    assert {(0, 1, "features"), (0, 2, "detections"), (2, 0, "detections")} <= fused(record)
    assert {p for a, p, how in fused(record) if how == "features"} == {0, 1}
    alone = silent("detector: surrogate", *TORCH)
    assert boxes(alone, 0) == boxes(silent("", *TORCH), 0)
    assert boxes(alone, 2) == boxes(silent("", *TORCH, "perception.detector=surrogate"), 2)
    sure = (*TORCH, "perception.score_threshold=0.6")
    usual, coarse, narrow = (
        silent(m, *sure) for m in ("", "camera: {width_px: 64}", "camera: {field_of_view_deg: 40}")
    )
    assert len(boxes(coarse, 2)) < 0.7 * len(boxes(usual, 2))
    assert len(boxes(narrow, 2)) < 0.9 * len(boxes(usual, 2))
    assert boxes(coarse, 0) == boxes(narrow, 0) == boxes(usual, 0)


def scenario(policy: str, *more: str) -> Scenario:
    return load("track_target", [*TRACKED, f"policy.name={policy}", "policy.params={}", *more])


@functools.cache
def alone() -> SortieRecord:
    return run_sortie(scenario("silence"))


def test_cooperation_beats_single_drones_and_the_interval_says_so() -> None:
    """Full maps over a medium that is wide enough for them: sharing every cell gains over silence."""
    wide = ("policy.params={received_budget: 0.25}",)
    rows, gains = compare(
        [Contender("silence", scenario("silence")), Contender("all-4", scenario("all-4", *wide))], [1]
    )
    assert gains[0].low > 0.0, f"gain {gains[0]}"
    assert rows[0].outcome["ap50"]["full_scene"] > 0.05


def test_a_cut_fleet_sees_like_a_silent_one() -> None:
    """Payloads that never arrive cannot help: the boxes are those of single drones, to the last bit."""
    fusions = alone().tables["fusions"].to_pylist()
    assert len(fusions) == 8 * 2 * 5
    assert all(f["peers"] == [] for f in fusions)
    assert outcome(alone())["data_age_s"]["p50"] is None
    cut = run_sortie(scenario("best-2", "radio.tx_power_dbm=-20", "radio.path_loss_exponent=6"))
    assert outcome(cut)["bytes"]["data_delivered"] == 0
    assert cut.tables["detections"].equals(alone().tables["detections"])
    assert run_sortie(scenario("silence")).fingerprint == alone().fingerprint


def test_what_is_fused_was_delivered_in_time_and_is_the_freshest() -> None:
    record = run_sortie(scenario("best-2", "policy.params={received_budget: 0.2}"))
    delivered = [t for t in record.tables["transmissions"].to_pylist() if t["status"] == "delivered"]
    checked = 0
    for fusion in record.tables["fusions"].to_pylist():
        here = [t for t in delivered if t["peer"] == fusion["drone"] and t["t_done_s"] <= fusion["t_s"]]
        for peer, age_s in zip(fusion["peers"], fusion["ages_s"], strict=True):
            newest_s = max(t["captured_s"] for t in here if t["drone"] == peer)
            assert age_s == pytest.approx(fusion["t_s"] - newest_s)
            assert age_s <= 0.5 + 1e-9
            checked += 1
    assert checked > 100


def test_own_fusion_flies_the_methods_own_network(tmp_path: Path) -> None:
    """The stand-ins for V2VNet and DiscoNet send alike; with their own fusions they see otherwise."""

    def seen(*more: str) -> dict[str, float]:
        path = tmp_path / "outcomes.json"
        settings = ["duration_s=1.5", "perception.detector=torch", "mission.phases=[{at_s: 0, phase: search}]"]
        flags = [arg for s in settings for arg in ("--set", s)]
        command = ["compare", "track_target", "--policies", "v2vnet-style(rho=0.02),disconet-style(rho=0.02)"]
        done = CliRunner().invoke(app, [*command, *flags, "--out", str(path), *more])
        assert done.exit_code == 0, done.output
        return {s["policy"]: s["outcome"]["ap50"]["full_scene"] for s in json.loads(path.read_text())["sorties"]}

    one, own = seen(), seen("--own-fusion")
    assert one["v2vnet-style(rho=0.02)"] == one["disconet-style(rho=0.02)"]
    assert len({one["v2vnet-style(rho=0.02)"], *own.values()}) == 3, (
        "DiscoNet's is that which was trained as V2VNet's was"
    )
