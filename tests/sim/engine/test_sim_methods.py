"""Prior methods in flight: each flies in a comparison, and what it asks first takes airtime and is counted."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.compute as pc
import pytest
from sim_examples import example
from typer.testing import CliRunner

from sortie.policies.catalogue.prior import METHODS
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.studies.compare import Contender, compare


def test_every_method_flies_in_a_comparison() -> None:
    rows, _ = compare(
        [Contender(name, example(f"policy.name={name}", "policy.params={}", "duration_s=3")) for name in METHODS], [1]
    )
    sent = {r.policy: r.outcome["bytes"]["data_sent"] for r in rows}
    assert all(sent.values())
    assert sent["fixed-compression"] < sent["where2comm-style"] < sent["v2vnet-style"] == sent["disconet-style"]
    assert sent["who2com-style"] < sent["disconet-style"]


@pytest.mark.filterwarnings("error")
def test_where_there_is_nothing_to_find_there_is_no_gain() -> None:
    """Not a gain of NaN, which JSON has no word for."""
    bare = [
        "perception.detector=surrogate",
        "duration_s=2",
        "mission.target=null",
        "mission.phases=[{at_s: 0, phase: search}]",
    ]
    bare += [f"perception.scene.{name}=0" for name in ("parked_density", "moving_cars_per_km")]
    rows, gains = compare(
        [Contender(name, example(f"policy.name={name}", "policy.params={}", *bare)) for name in ("silence", "all-4")],
        [1],
    )
    assert [r.outcome["ap50"]["scored_fusions"] for r in rows] == [20, 20]
    assert [r.gain for r in rows] == [{"full_scene": None, "mission": None}] * 2
    assert gains == ()


def test_a_handshake_takes_airtime_and_stands_in_the_outcome() -> None:
    plain, asking = (
        run_sortie(example("policy.name=where2comm-style", f"policy.params={{rho: 0.02, rounds: {rounds}}}"))
        for rounds in (1, 2)
    )
    sent = asking.tables["transmissions"]
    asked = sent.filter(pc.equal(sent["representation"], "handshake"))
    assert set(asked["payload_bytes"].to_pylist()) == {8192}
    assert pc.sum(asked["airtime_s"]).as_py() > 0.0
    first, second = outcome(plain), outcome(asking)
    assert first["bytes"]["handshakes_sent"] == 0
    assert second["bytes"]["handshakes_sent"] == asked.num_rows * 8192
    assert second["bytes"]["data_sent"] == pc.sum(sent["payload_bytes"]).as_py()
    assert second["medium_busy_fraction"] > first["medium_busy_fraction"]
    # every drone asks every peer it has heard, once a frame: 20 links, the first frames apart
    assert asked.num_rows == pytest.approx(20 * 60, rel=0.05)


def test_a_handshake_is_no_payload() -> None:
    """The stand-in for Who2com serves each drone by one other: whatever is asked of the rest, only its maps are fused."""
    record = run_sortie(
        example(
            "policy.name=who2com-style", "policy.params={rho: 0.05}", "perception.detector=surrogate", "duration_s=3"
        )
    )
    kinds = {k for ks in record.tables["fusions"]["representations"].to_pylist() for k in ks}
    assert kinds == {"features"}
    assert set(record.tables["transmissions"]["representation"].to_pylist()) == {"features", "handshake"}


@pytest.mark.slow
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
