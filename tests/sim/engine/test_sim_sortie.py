"""A sortie as a whole: one clock, the same record every time, and effects where the scenario asks for them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import simpy
from places import HELPERS
from recorded import recorded
from sim_examples import PATIENT, example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.check.expectations import check
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

FEW = ("duration_s=0.3", "fleet.drones=2", "mission.phases=[{at_s: 0, phase: search}]")

# --- determinism ---------------------------------------------------------------------------------


def test_the_same_sortie_again_and_watched_is_the_same_record() -> None:
    seen: list[pa.Table] = []

    class Watcher:
        def begin(self, scenario: Scenario, scene: object) -> None: ...

        def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
            seen.append(new["states"])

    base = recorded("base")
    again = run_sortie(example(), observer=Watcher(), progress=lambda t_s: None)
    assert again.fingerprint == base.fingerprint
    assert pa.concat_tables(seen).num_rows == base.tables["states"].num_rows, "every row is streamed once"
    changed = {
        name for name in base.tables if str(again.tables[name].to_pydict()) != str(base.tables[name].to_pydict())
    }
    assert changed == set()


SEEN = ("perception.detector=surrogate", "radio.shadowing_distance_m=30", "duration_s=1", "mission.phases=[{}]")


@pytest.mark.parametrize(
    ("extra", "kernels"),
    [(SEEN, "Haswell"), *(pytest.param(sets, "Prescott", marks=pytest.mark.slow) for sets in (SEEN, ()))],
)
def test_another_process_gives_the_same_fingerprint_whatever_matrix_kernels_its_machine_has(
    extra: tuple[str, ...], kernels: str
) -> None:
    """OpenBLAS adds in another order by processor."""
    here = run_sortie(example(*extra)) if extra else recorded("base")
    code = (
        "import sys; from sim_examples import example; from sortie.sim.engine.sortie import run_sortie; "
        "print(run_sortie(example(*sys.argv[1:])).fingerprint)"
    )
    paths = ":".join(p for p in sys.path if p)
    environment = {"PYTHONHASHSEED": "1", "PYTHONPATH": paths, "OPENBLAS_CORETYPE": kernels}
    command = [sys.executable, "-c", code, *extra]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, cwd=HELPERS, env=environment)
    assert printed.stdout.strip() == here.fingerprint


def test_seed_replication_and_policy_make_another_record() -> None:
    changes: list[dict[str, object]] = [{}, {"seed": 2}, {"replication": 1}, {"policy": "silence"}]
    prints = [run_sortie(example(*FEW), **change).fingerprint for change in changes]  # type: ignore[arg-type]
    assert len(set(prints)) == 4


def test_a_sixth_drone_leaves_the_first_five_as_they_were() -> None:
    """A flight of its own, beside the recorded one: how they fly, and when they publish."""
    six, base = run_sortie(example("fleet.drones=6"), "silence"), recorded("base")
    columns = ["t_s", "drone", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "p_radps", "q_radps", "r_radps"]
    theirs = six.tables["states"].filter(pc.less(six.tables["states"]["drone"], 5)).select(columns)
    assert theirs.equals(base.tables["states"].select(columns))
    first = six.tables["descriptors"].filter(pc.less(six.tables["descriptors"]["drone"], 5))
    assert first["t_s"].to_pylist() == base.tables["descriptors"]["t_s"].to_pylist()


@pytest.mark.slow
def test_a_detector_that_works_ahead_leaves_the_same_record(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = example("perception.detector=torch", "perception.sample_rate_hz=5", "duration_s=2.5")
    ahead = run_sortie(scenario)
    assert ahead.tables["fusions"].num_rows == 5 * 13
    monkeypatch.setattr("sortie.sim.engine.scoring.DetectsAhead", type("Nobody", (), {}))
    assert run_sortie(scenario).fingerprint == ahead.fingerprint


# --- the clock -----------------------------------------------------------------------------------


def test_the_end_is_exclusive_and_every_drone_publishes_once_a_frame() -> None:
    base = recorded("base")
    t_s = base.tables["states"]["t_s"].to_numpy()
    assert len(np.unique(t_s)) == 60
    assert t_s.max() == pytest.approx(5.9)
    assert run_sortie(example(*FEW, "duration_s=0.1")).tables["states"].num_rows == 2
    published = [(row["drone"], round(row["t_s"] // 0.1)) for row in base.tables["descriptors"].to_pylist()]
    assert len(published) == len(set(published)) == 5 * 60
    assert not base.tables["drops"].num_rows


def test_nothing_polls() -> None:
    """Events grow with what happens, not with time: a silent fleet needs a handful a drone and frame."""
    steps, step = [0], simpy.Environment.step

    def counted(env: simpy.Environment) -> None:
        steps[0] += 1
        step(env)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simpy.Environment, "step", counted)
        run_sortie(example("duration_s=2", "mission.phases=[{}]"), "silence")
    assert steps[0] < 20 * (5 * 4 + 3)


# --- traffic -------------------------------------------------------------------------------------


def test_full_sharing_does_not_fit_into_the_channel_and_a_small_budget_does() -> None:
    full = recorded("whole_maps")
    result = outcome(full)
    sent = result["bytes"]
    assert sent["data_sent"] == sum(sent[f"data_{s}"] for s in ("delivered", "lost", "expired", "in_flight"))
    assert sent["data_sent"] == full.totals["data_sent_bytes"]
    assert sent["context_sent"] == sent["context_descriptors"] + sent["context_directives"]
    assert sent["data_in_flight"] > 0, "the end cuts through traffic"
    assert result["medium_busy_fraction"] > 0.7
    assert result["deadline_miss_rate"] > 0.5
    queued_s = pc.subtract(full.tables["transmissions"]["t_start_s"], full.tables["transmissions"]["t_sent_s"])
    assert np.nanmax(queued_s.to_numpy()) > 0.05, "the record shows the queue"
    assert "expired/replaced" in result["payload_fates"], "a newer frame takes the place of one that still waits"
    small = outcome(recorded("lost_drone"))
    assert small["deadline_miss_rate"] == 0.0
    assert set(small["payload_fates"]) <= {"delivered", "in_flight", "lost/receiver_gone"}


def test_deliveries_come_after_the_compute_delay_and_before_the_deadline() -> None:
    sent = recorded("base").tables["transmissions"]
    assert set(sent["status"].to_pylist()) == {"delivered"}
    age_s = pc.subtract(sent["t_done_s"], sent["captured_s"]).to_numpy()
    assert age_s.min() > 0.03
    assert (sent["t_done_s"].to_numpy() <= sent["deadline_s"].to_numpy() + 1e-9).all()


# --- decisions -----------------------------------------------------------------------------------


def decisions(record: SortieRecord, **where: object) -> list[dict[str, object]]:
    return [r for r in record.tables["directives"].to_pylist() if all(r[k] == v for k, v in where.items())]


def test_given_context_makes_the_policy_do_what_the_paper_describes() -> None:
    """A flight of the library's own scenario for it."""
    scenario = load("paper_context", ["perception.detector=none"])
    record = run_sortie(scenario)
    checks = check(scenario, record, outcome(record))
    assert [c for c in checks if not c.holds] == []
    assert len(checks) == 7


@pytest.mark.slow
def test_the_papers_three_transitions() -> None:
    bare = ["perception.detector=none"]
    # Drone 1's battery falls through 60 % and 30 %. Quarters are sent: whole maps of all would fill the air, and a link
    # that is silent or degraded rises to what the battery allows only after its dwell time.
    calm = run_sortie(load("paper_replay_contention", [*bare, *PATIENT, "policy.params={rho: 0.25}"]))
    charge = {row["t_s"]: row["soc"] for row in calm.tables["descriptors"].to_pylist() if row["drone"] == 1}
    for threshold, rate_hz, rung, reason in (
        (0.6, 5.0, "features", "battery < 60 %"),
        (0.3, 2.0, "detections", "battery < 30 %"),
    ):
        crossed_s = next(t_s for t_s, soc in charge.items() if soc < threshold)
        first = decisions(calm, drone=1, peer=0, representation=rung, rate_hz=rate_hz, reason=reason)
        late = decisions(calm, drone=1, peer=0, representation=rung, rate_hz=rate_hz)
        got = (first or [r for r in late if str(r["reason"]).startswith(reason)])[0]
        assert got["t_s"] == crossed_s, "decided on the very descriptor that crossed the threshold"
    # The phase changes at 45 s: the payload falls about tenfold.
    result = outcome(run_sortie(load("paper_replay_contention", bare)))
    search, track = result["phases"]
    assert 8 < search["feature_payload_bytes"] / track["feature_payload_bytes"] < 16
    confined = [t for t in result["transitions"] if "in 32 m" in t["to"] and "in 32 m" not in t["from"]]
    assert min(t["t_s"] for t in confined) == pytest.approx(45.0, abs=0.02)
    assert "track: ROI 32 m" in confined[0]["reason"]
    # Drone 2's links drop at 60 s: its outgoing links carry detections within one descriptor period.
    dropped = next(t for t in result["transitions"] if t["drone"] == 2 and t["t_s"] >= 60.0)
    assert dropped["t_s"] <= 60.0 + 0.1 + 0.02
    assert dropped["to"].startswith("detections at 2 Hz")
    assert dropped["reason"].startswith("goodput")


def test_a_lost_drone_degrades_and_detaches() -> None:
    record = recorded("lost_drone")
    rows = decisions(record, drone=0, peer=2)
    degraded, detached = (next(r for r in rows if r["link"] == link) for link in ("degraded", "detached"))
    assert degraded["representation"] == "detections"
    assert degraded["t_s"] == pytest.approx(3.0 + 0.3, abs=0.11), "more than three periods after the last one"
    assert detached["representation"] == "none"
    assert detached["t_s"] == pytest.approx(3.0 + 1.0, abs=0.11)
    assert str(detached["reason"]).startswith("detached: descriptor")
    after = [r for r in record.tables["transmissions"].to_pylist() if r["drone"] == 2 and r["t_sent_s"] > 3.0]
    assert after == []


def test_headrooms_are_of_the_work_of_the_last_second() -> None:
    """By hand, in a flight of its own: drone 0 looks, drone 1 in half of the frames, 2 and 3 exchange maps."""

    def policy(view: FleetView) -> list[Directive]:
        if view.ego < 2:
            return [Directive(view.ego, p, duty_percent=50 if view.ego else 100) for p in view.peers]
        return [
            Directive(view.ego, p, Representation.FEATURES, 0.05, None, 10.0)
            if p == 5 - view.ego
            else Directive(view.ego, p)
            for p in view.peers
        ]

    sets = ("duration_s=3", "fleet.drones=4", "mission.phases=[{}]", "policy.hysteresis=0", *PATIENT)
    record = run_sortie(example(*sets), policy)
    map_b = record.tables["transmissions"]["payload_bytes"][-1].as_py()
    looks_ms = {0: 30.0, 1: 15.0, 2: 30 + 0.32, 3: 30 + 0.32}
    rows = record.tables["descriptors"].to_pylist()
    for drone, accelerator_ms in looks_ms.items():
        exchanged_b = 2 * map_b if drone > 1 else 0
        cpu_ms = accelerator_ms + 0.1 + exchanged_b * 8e-6 / 19.5
        left = [(d["cpu_headroom"], d["gpu_headroom"]) for d in rows if d["drone"] == drone and d["t_s"] > 1.5]
        usual = sorted(left)[len(left) // 2]
        assert usual == pytest.approx((1 - cpu_ms / (12 * 100), 1 - accelerator_ms / 100))
    first = [1.0 - d["gpu_headroom"] for d in rows if d["drone"] == 0]
    assert first[0] == 0.0
    assert first[1:9] == pytest.approx([0.3] * 8, rel=0.02), (
        "of the time that was flown, where that is less than a second"
    )


def test_one_drone_flies_alone() -> None:
    alone = outcome(run_sortie(example(*FEW, "fleet.drones=1")))
    assert alone["bytes"]["data_sent"] == 0
    assert alone["deadline_miss_rate"] is None
    assert alone["switches"] is None
