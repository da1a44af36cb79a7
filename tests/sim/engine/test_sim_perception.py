"""Traffic and accuracy come out of the same run: what was delivered is what is fused."""

from __future__ import annotations

import pytest

from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.studies.compare import Contender, compare

SHORT = ("duration_s=16", "mission.phases=[{at_s: 0, phase: track, region: {radius_m: 32}}]", "policy.dwell_s=0.2")
pytestmark = pytest.mark.slow


def scenario(policy: str, *more: str) -> Scenario:
    return load("track_target", [*SHORT, f"policy.name={policy}", "policy.params={}", *more])


@pytest.fixture(scope="module")
def silent() -> SortieRecord:
    return run_sortie(scenario("silence"))


def test_cooperation_beats_single_drones_and_the_interval_says_so() -> None:
    """Full maps over a medium that is wide enough for them: sharing every cell gains over silence."""
    wide = ("policy.params={received_budget: 0.25}",)
    rows, gains = compare(
        [Contender("silence", scenario("silence")), Contender("all-4", scenario("all-4", *wide))], [1]
    )
    assert gains[0].low > 0.0, f"gain {gains[0]}"
    assert rows[0].outcome["ap50"]["full_scene"] > 0.05


def test_silence_fuses_nothing(silent: SortieRecord) -> None:
    fusions = silent.tables["fusions"].to_pylist()
    assert len(fusions) == 16 * 2 * 5
    assert all(f["peers"] == [] for f in fusions)
    assert outcome(silent)["data_age_s"]["p50"] is None


def test_a_cut_fleet_sees_like_a_silent_one(silent: SortieRecord) -> None:
    """Payloads that never arrive cannot help: the boxes are those of single drones, to the last bit."""
    cut = run_sortie(scenario("best-2", "radio.tx_power_dbm=-20", "radio.path_loss_exponent=6"))
    assert outcome(cut)["bytes"]["data_delivered"] == 0
    assert cut.tables["detections"].equals(silent.tables["detections"])


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


def test_the_same_sortie_sees_the_same(silent: SortieRecord) -> None:
    assert run_sortie(scenario("silence")).fingerprint == silent.fingerprint
