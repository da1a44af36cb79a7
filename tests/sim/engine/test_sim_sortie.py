"""A sortie as a whole: one clock, the same record every time, and effects where the scenario asks for them."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from places import HELPERS
from sim_examples import PATIENT, example

from sortie.policies.contract import Directive, FleetView, PolicyError, Representation
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord


@pytest.fixture(scope="module")
def base() -> SortieRecord:
    return run_sortie(example())


@pytest.fixture(scope="module")
def full_sharing() -> SortieRecord:
    """All-to-all, whole maps: 1.05 Gb/s asked of one 80 MHz channel."""
    return run_sortie(example(), "all-4")


# --- determinism ---------------------------------------------------------------------------------


def test_the_same_sortie_twice_is_the_same_record(base: SortieRecord) -> None:
    again = run_sortie(example())
    assert again.fingerprint == base.fingerprint
    assert all(again.tables[name].equals(base.tables[name]) for name in base.tables if name not in WITH_NANS)


WITH_NANS = {"descriptors", "directives", "mission", "transmissions"}  # NaN ≠ NaN; the fingerprint compares their bytes


SURROGATE = ["perception.detector=surrogate", "radio.shadowing_distance_m=30"]


@pytest.mark.parametrize(
    ("extra", "kernels"),
    [
        ([], ""),
        (SURROGATE, "Haswell"),
        *(
            pytest.param(extra, kernels, marks=pytest.mark.slow)
            for extra, kernels in (([], "Haswell"), ([], "Prescott"), (SURROGATE, ""), (SURROGATE, "Prescott"))
        ),
    ],
)
def test_another_process_gives_the_same_fingerprint_whatever_matrix_kernels_its_machine_has(
    extra: list[str], kernels: str, base: SortieRecord
) -> None:
    """OpenBLAS adds in another order by processor."""
    here = run_sortie(example(*extra)) if extra else base
    code = (
        "import sys; from sim_examples import example; from sortie.sim.engine.sortie import run_sortie; "
        "print(run_sortie(example(*sys.argv[1:])).fingerprint)"
    )
    for hash_seed in ("1", "2"):
        printed = subprocess.run(
            [sys.executable, "-c", code, *extra],
            capture_output=True, text=True, check=True, cwd=HELPERS,
            env={"PYTHONHASHSEED": hash_seed, "PYTHONPATH": ":".join(p for p in sys.path if p)}
            | ({"OPENBLAS_CORETYPE": kernels} if kernels else {}),
        )  # fmt: skip
        assert printed.stdout.strip() == here.fingerprint


@pytest.mark.parametrize("change", [{"seed": 2}, {"replication": 1}, {"policy": "silence"}])
def test_seed_replication_and_policy_make_another_record(base: SortieRecord, change: dict[str, object]) -> None:
    assert run_sortie(example(), **change).fingerprint != base.fingerprint


def test_a_sixth_drone_leaves_the_first_five_as_they_were(base: SortieRecord) -> None:
    six = run_sortie(example("fleet.drones=6"))
    columns = ["t_s", "drone", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "p_radps", "q_radps", "r_radps"]
    ours = base.tables["states"].select(columns)
    theirs = six.tables["states"].filter(pc.less(six.tables["states"]["drone"], 5)).select(columns)
    assert theirs.equals(ours)
    first = six.tables["descriptors"].filter(pc.less(six.tables["descriptors"]["drone"], 5))
    assert first["t_s"].to_pylist() == base.tables["descriptors"]["t_s"].to_pylist(), "when they publish"


def test_an_observer_changes_nothing(base: SortieRecord) -> None:
    seen: list[pa.Table] = []

    class Watcher:
        def begin(self, scenario: Scenario, scene: object) -> None: ...

        def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
            seen.append(new["states"])

    assert run_sortie(example(), observer=Watcher(), progress=lambda t_s: None).fingerprint == base.fingerprint
    assert pa.concat_tables(seen).num_rows == base.tables["states"].num_rows, "every row is streamed once"


# --- the clock -----------------------------------------------------------------------------------


def test_the_search_for_garbage_spares_older_objects_in_flight_alone() -> None:
    spared: list[int] = []
    run_sortie(
        example("duration_s=0.2", "mission.phases=[{at_s: 0, phase: search}]"),
        progress=lambda _: spared.append(gc.get_freeze_count()),
    )
    assert min(spared) > 0
    assert gc.get_freeze_count() == 0


def test_the_end_is_exclusive(base: SortieRecord) -> None:
    t_s = base.tables["states"]["t_s"].to_numpy()
    assert len(np.unique(t_s)) == 60
    assert t_s.max() == pytest.approx(5.9)
    one_frame = run_sortie(example("duration_s=0.1", "mission.phases=[{at_s: 0, phase: search}]"))
    assert one_frame.tables["states"].num_rows == 5


def test_every_drone_publishes_once_a_frame(base: SortieRecord) -> None:
    published = base.tables["descriptors"]
    assert published.num_rows == 5 * 60
    assert set(published["wire_bytes"].to_pylist()) <= {208, 210}, "180 B and 28 B; 2 B more with the target's id"
    assert not base.tables["drops"].num_rows


def test_nothing_polls() -> None:
    """Events grow with what happens, not with time: a silent fleet needs a handful a drone and frame."""
    import simpy

    steps = 0
    step = simpy.Environment.step

    def counted(env: simpy.Environment) -> None:
        nonlocal steps
        steps += 1
        step(env)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simpy.Environment, "step", counted)
        run_sortie(example(), "silence")
    assert steps < 60 * (5 * 4 + 3)


# --- traffic -------------------------------------------------------------------------------------


def test_bytes_are_conserved(full_sharing: SortieRecord) -> None:
    o = outcome(full_sharing)["bytes"]
    assert o["data_sent"] == sum(o[f"data_{s}"] for s in ("delivered", "lost", "expired", "in_flight"))
    assert o["data_sent"] == full_sharing.totals["data_sent_bytes"]
    assert o["context_sent"] == o["context_descriptors"] + o["context_directives"]
    assert o["data_in_flight"] > 0, "the end cuts through traffic"


def test_full_sharing_does_not_fit_into_the_channel(full_sharing: SortieRecord) -> None:
    o = outcome(full_sharing)
    assert o["medium_busy_fraction"] > 0.85
    assert o["deadline_miss_rate"] > 0.5
    sent = full_sharing.tables["transmissions"]
    queued_s = pc.subtract(sent["t_start_s"], sent["t_sent_s"]).to_numpy()
    assert np.nanmax(queued_s) > 0.05, "the record shows the queue"
    assert "replaced" in set(sent["reason"].to_pylist()), "a newer frame takes the place of one that still waits"


def test_a_small_budget_fits() -> None:
    o = outcome(run_sortie(example("policy.name=all-4", "policy.params={received_budget: 0.02}")))
    assert o["deadline_miss_rate"] == 0.0
    assert o["bytes"]["data_delivered"] > 0.99 * (o["bytes"]["data_sent"] - o["bytes"]["data_in_flight"])


def test_deliveries_come_after_the_compute_delay_and_before_the_deadline(base: SortieRecord) -> None:
    sent = base.tables["transmissions"].filter(pc.equal(base.tables["transmissions"]["status"], "delivered"))
    age_s = pc.subtract(sent["t_done_s"], sent["captured_s"]).to_numpy()
    assert age_s.min() > 0.03
    assert (sent["t_done_s"].to_numpy() <= sent["deadline_s"].to_numpy() + 1e-9).all()


# --- decisions -----------------------------------------------------------------------------------


def decisions(record: SortieRecord, **where: object) -> list[dict[str, object]]:
    return [r for r in record.tables["directives"].to_pylist() if all(r[k] == v for k, v in where.items())]


def test_the_papers_three_transitions() -> None:
    bare = ["perception.detector=none"]
    # Drone 1's battery falls through 60 % and 30 %. Whole maps of all would fill the air: a link that is silent or degraded
    # already carries less, and rises to what the battery allows only after its dwell time. So quarters of maps are sent.
    calm = run_sortie(load("paper_replay", [*bare, *PATIENT, "policy.params={rho: 0.25}"]))
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
    o = outcome(run_sortie(load("paper_replay", bare)))
    search, track = o["phases"]
    assert 8 < search["feature_payload_bytes"] / track["feature_payload_bytes"] < 16
    confined = [t for t in o["transitions"] if "in 32 m" in t["to"] and "in 32 m" not in t["from"]]
    assert min(t["t_s"] for t in confined) == pytest.approx(45.0, abs=0.02)
    assert "track: ROI 32 m" in confined[0]["reason"]
    # Drone 2's links drop at 60 s: its outgoing links carry detections within one descriptor period.
    dropped = next(t for t in o["transitions"] if t["drone"] == 2 and t["t_s"] >= 60.0)
    assert dropped["t_s"] <= 60.0 + 0.1 + 0.02
    assert dropped["to"].startswith("detections at 2 Hz")
    assert dropped["reason"].startswith("goodput")


def test_a_lost_drone_degrades_and_detaches() -> None:
    record = run_sortie(
        example(
            "events=[{kind: drone_lost, drone: 2, at_s: 3.0}]",
            "policy.name=all-4",
            "policy.params={received_budget: 0.02}",
        )
    )
    rows = decisions(record, drone=0, peer=2)
    degraded = next(r for r in rows if r["link"] == "degraded")
    detached = next(r for r in rows if r["link"] == "detached")
    assert degraded["representation"] == "detections"
    assert degraded["t_s"] == pytest.approx(3.0 + 0.3, abs=0.11), "more than three periods after the last one"
    assert detached["representation"] == "none"
    assert detached["t_s"] == pytest.approx(3.0 + 1.0, abs=0.11)
    assert str(detached["reason"]).startswith("detached: descriptor")
    after = [r for r in record.tables["transmissions"].to_pylist() if r["drone"] == 2 and r["t_sent_s"] > 3.0]
    assert after == []


def test_a_skewed_clock_looks_stale() -> None:
    """Until its offset is found out; see test_sim_clocks."""
    skew = "events=[{kind: clock_skew, drone: 2, at_s: 8.0, skew_s: -0.5}]"
    record = run_sortie(example("duration_s=10", "perception.detector=none", skew))
    assert {r["link"] for r in decisions(record, drone=0, peer=2) if r["t_s"] > 8.0} >= {"degraded"}
    assert all(r["link"] == "fresh" for r in decisions(record, drone=0, peer=1))


@pytest.mark.parametrize(
    ("attack", "reason"),
    [
        ("forged", "unknown_key|forged"),
        ("replayed", "replayed"),
        ("malformed", "unknown_key|forged"),
        ("oversized", "oversized"),
    ],
)
def test_bad_datagrams_are_counted_by_reason_and_change_nothing(base: SortieRecord, attack: str, reason: str) -> None:
    attacked = run_sortie(example(f"events=[{{kind: spoof, drone: 0, at_s: 1.0, attack: {attack}, rate_hz: 20}}]"))
    drops = outcome(attacked)["descriptor_drops"]
    assert set(drops) <= set(reason.split("|"))
    assert sum(drops.values()) == pytest.approx(4 * 20 * 5, abs=8)
    for name in set(base.tables) - {"drops", "events"} - WITH_NANS:
        assert attacked.tables[name].equals(base.tables[name]), f"the attack changed {name}"


def test_without_authentication_a_forged_descriptor_is_believed(base: SortieRecord) -> None:
    open_plane = ("context.authentication=false",)
    honest = run_sortie(example(*open_plane))
    attack = "events=[{kind: spoof, drone: 0, at_s: 1.0, attack: forged, rate_hz: 20}]"
    attacked = run_sortie(example(*open_plane, attack))
    assert set(honest.tables["descriptors"]["wire_bytes"].to_pylist()) <= {180, 182}
    assert not attacked.tables["drops"].num_rows
    assert attacked.fingerprint != honest.fingerprint


def test_a_drone_lands_at_its_landing_charge() -> None:
    record = run_sortie(example("fleet.overrides=[{drone: 3, capacity_wh: 2, initial_soc: 0.3}]"))
    (event,) = record.tables["events"].to_pylist()
    assert (event["drone"], event["kind"]) == (3, "landed")
    states = [r for r in record.tables["states"].to_pylist() if r["drone"] == 3]
    assert min(r["soc"] for r in states) >= 0
    assert [r["airborne"] for r in states] == sorted((r["airborne"] for r in states), reverse=True)
    silent_from_s = event["t_s"]
    assert not [r for r in record.tables["descriptors"].to_pylist() if r["drone"] == 3 and r["t_s"] > silent_from_s]


@pytest.mark.parametrize(("rate_hz", "at_s"), [(10, 2.0), (10, 2.05), (0.5, 2.0), (0.5, 3.0)])
def test_a_lost_drone_has_spent_what_it_flew(rate_hz: float, at_s: float) -> None:
    lost = f"events=[{{kind: drone_lost, drone: 3, at_s: {at_s}}}]"
    spent_j = [
        outcome(run_sortie(example(f"context.rate_hz={rate_hz}", *more)))["drones"]["3"]["energy_j"]
        for more in ((lost,), ("events=[]", f"duration_s={at_s}"))
    ]
    assert spent_j[0] == pytest.approx(spent_j[1], rel=1e-3)


def test_a_battery_fault_takes_its_energy_and_is_in_the_ledger() -> None:
    o = outcome(run_sortie(example("events=[{kind: battery_fault, drone: 1, at_s: 2.0, lost_fraction: 0.5}]")))
    assert o["energy_j"]["fault"] > 0.4 * 130 * 3600 * 0.9
    assert o["battery"]["1"] < 0.6 < o["battery"]["0"]


def test_a_battery_fault_takes_a_share_of_what_is_left_at_its_moment() -> None:
    """Between two frames too: what was spent until then is booked to what spent it."""
    fault = "events=[{kind: battery_fault, drone: 1, at_s: 2.07, lost_fraction: 1}]"
    ledgers = [
        {r["cause"]: r["energy_j"] for r in run_sortie(example(*sets)).tables["energy"].to_pylist() if r["drone"] == 1}
        for sets in (("duration_s=3", fault), ("duration_s=2.07",))
    ]
    for cause in ("rotor", "avionics", "ohmic"):
        assert ledgers[0][cause] == pytest.approx(ledgers[1][cause], rel=1e-6)


@pytest.mark.parametrize("fault", ["battery_fault, lost_fraction: 0.5", "cell_failure"])
def test_a_drone_that_left_the_air_loses_no_energy(fault: str) -> None:
    events = f"events=[{{kind: drone_lost, drone: 1, at_s: 2}}, {{kind: {fault}, drone: 1, at_s: 3}}]"
    o = outcome(run_sortie(example("duration_s=4", events)))
    assert o["energy_j"]["fault"] == 0.0
    assert [e["kind"] for e in o["events"]] == ["drone_lost", "no_effect"]


def test_jam_and_link_drop_end_when_they_should(base: SortieRecord) -> None:
    def snr(record: SortieRecord, begin_s: float, end_s: float) -> float:
        sent = record.tables["transmissions"]
        keep = pc.and_(pc.greater_equal(sent["t_sent_s"], begin_s), pc.less(sent["t_sent_s"], end_s))
        keep = pc.and_(keep, pc.equal(sent["drone"], 2))
        return float(np.nanmean(sent.filter(keep)["snr_db"].to_numpy()))

    for event in ("kind: link_drop, drone: 2, loss_db: 15", "kind: jam, position_m: [-60, 0, 60], power_dbm: 0"):
        hit = run_sortie(example(f"events=[{{at_s: 2.0, until_s: 4.0, {event}}}]"))
        assert snr(hit, 1.0, 2.0) == pytest.approx(snr(base, 1.0, 2.0))
        assert snr(hit, 2.2, 4.0) < snr(base, 2.2, 4.0) - 5
        assert snr(hit, 4.2, 6.0) > snr(hit, 2.2, 4.0) + 5
        assert len(outcome(hit)["events"]) == 2


@pytest.mark.parametrize(("begin_s", "end_s"), [(2.4, 6.7), (6.65, 6.7)])
def test_what_ends_with_a_frame_ends_before_it(begin_s: float, end_s: float) -> None:
    """2.4 + (6.7 − 2.4) is a digit above 6.7, and at 6.65 the frame of 6.7 stands on the clock already."""
    drop = f"events=[{{kind: link_drop, drone: 2, at_s: {begin_s}, until_s: {end_s}, loss_db: 15}}]"
    flown = [run_sortie(example("duration_s=7", events)) for events in ("events=[]", drop)]
    assert [e["t_s"] for e in flown[1].tables["events"].to_pylist()] == [begin_s, end_s]
    clear_db, after_db = (
        {
            (row["peer"], row["snr_db"])
            for row in record.tables["transmissions"].to_pylist()
            if row["drone"] == 2 and end_s < row["t_sent_s"] < end_s + 0.1
        }
        for record in flown
    )
    assert after_db == clear_db != set()


def test_an_event_comes_before_its_frame_whatever_the_clock_rounds() -> None:
    """At 7.5 Hz the frame of 14.8 s stands a last digit below it on the clock."""
    lost = "events=[{kind: drone_lost, drone: 3, at_s: 14.8}]"
    record = run_sortie(example("context.rate_hz=7.5", "duration_s=15", "perception.detector=none", lost))
    seen = record.tables["states"].filter(pc.equal(record.tables["states"]["drone"], 3)).to_pylist()
    assert [row["t_s"] < 14.8 - 1e-9 for row in seen] == [row["airborne"] for row in seen]


def test_an_event_with_a_frame_leaves_the_others_headrooms_alone() -> None:
    """0.3 is a last digit below the third frame: what lies between them is no time to tell the radio's share of."""
    said = []
    for events in ("[]", "[{kind: battery_fault, drone: 3, at_s: 0.3, lost_fraction: 0.01}]"):
        told = run_sortie(example("duration_s=0.5", f"events={events}")).tables["descriptors"].to_pylist()
        said.append([d["cpu_headroom"] for d in told if d["drone"] != 3])
    assert said[0] == pytest.approx(said[1])
    assert min(said[0]) < 1.0


def test_headrooms_are_of_the_work_of_the_last_second_and_not_of_the_radio() -> None:
    """From a full map in each direction and frame of four links, by hand; and from silence, perception resting or not."""

    def published(policy: Callable[[FleetView], list[Directive]], *sets: str) -> list[tuple[float, float]]:
        raw = ("duration_s=3", "policy.hysteresis=0")
        rows = run_sortie(example(*raw, *sets), policy).tables["descriptors"].to_pylist()
        return [(d["cpu_headroom"], d["gpu_headroom"]) for d in rows if d["drone"] == 0 and d["t_s"] > 1.5]

    def saying(**decided: object) -> Callable[[FleetView], list[Directive]]:
        return lambda view: [Directive(view.ego, p, **decided) for p in view.peers]  # type: ignore[arg-type]

    looking = 1 - (30 + 0.1) / (12 * 100), 1 - 0.3
    assert published(saying()) == [pytest.approx(looking)] * 15
    assert published(saying(), "radio.tx_power_dbm=0", "radio.bandwidth_mhz=20") == [pytest.approx(looking)] * 15
    half = 1 - (15 + 0.1) / (12 * 100), 1 - 0.15
    assert published(saying(duty_percent=50)) == [pytest.approx(half)] * 15
    assert published(saying(duty_percent=50), "context.publish_every=2") == [pytest.approx(half)] * 7
    maps = saying(representation=Representation.FEATURES, rho=0.05, rate_hz=10.0)
    bytes_each = run_sortie(example("duration_s=3"), maps).tables["transmissions"]["payload_bytes"][-1].as_py()
    accelerator_ms = 30 + 4 * 0.32
    cpu_ms = accelerator_ms + 0.1 + 8 * bytes_each * 8e-6 / 19.5
    usual = sorted(published(maps))[7]
    assert usual == pytest.approx((1 - cpu_ms / (12 * 100), 1 - accelerator_ms / 100))


def test_the_end_of_a_link_drop_names_the_link() -> None:
    drop = "{kind: link_drop, drone: 2, at_s: 1, until_s: 2"
    for peer, whom in (("", "2"), (", peer: 4", "2–4")):
        events = outcome(run_sortie(example("duration_s=3", f"events=[{drop}{peer}}}]")))["events"]
        assert [e["text"] for e in events] == [f"links of {whom} lose 30 dB", f"links of {whom} are back"]


# --- policies ------------------------------------------------------------------------------------


def test_a_policy_that_breaks_the_contract_stops_the_sortie_with_its_name() -> None:
    def greedy(view: object) -> list[Directive]:
        return [Directive(view.ego, p, rho=7.0) for p in view.peers]  # type: ignore[attr-defined]

    with pytest.raises(PolicyError, match=r"directive \d→\d: rho is 7.0, must be in \[0, 1\]"):
        run_sortie(example(), greedy)


def test_one_drone_flies_alone() -> None:
    o = outcome(run_sortie(example("fleet.drones=1")))
    assert o["bytes"]["data_sent"] == 0
    assert o["deadline_miss_rate"] is None
    assert o["switches"] is None


def test_duty_cycle_rests_the_computer() -> None:
    def resting(view: object) -> list[Directive]:
        return [Directive(view.ego, p, duty_percent=20) for p in view.peers]  # type: ignore[attr-defined]

    def awake(view: object) -> list[Directive]:
        return [Directive(view.ego, p) for p in view.peers]  # type: ignore[attr-defined]

    rested, worked = (outcome(run_sortie(example(), p))["energy_j"]["compute"] for p in (resting, awake))
    idle = 5 * 6 * 10.0
    assert rested - idle == pytest.approx(0.2 * (worked - idle), rel=0.15)


@pytest.mark.slow
def test_a_detector_that_works_ahead_leaves_the_same_record(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = example("perception.detector=torch", "perception.sample_rate_hz=5", "duration_s=2.5")
    ahead = run_sortie(scenario)
    assert ahead.tables["fusions"].num_rows == 5 * 13
    monkeypatch.setattr("sortie.sim.engine.scoring.DetectsAhead", type("Nobody", (), {}))
    assert run_sortie(scenario).fingerprint == ahead.fingerprint
