"""The engine's joints: what it hands from one room to another, two events together, drones that are gone, independent draws.

Joints, each with a test below:

1. Truth: asked for at the time of the scoring, with the pose of the capture, of every kind of detector.
2. A share's weight: the directive's times the receiver's trust in its sender.
3. Delays, stamps and rates of one drone: its own, not the first drone's, the receiver's or the fastest.
4. A drone that is lost, lands, goes home, waits or comes back: what it does, what reaches it, what it spends, where it is.
5. Energy of computing and headrooms: of the frames in which perception ran.
6. Events that overlap: each end undoes its own begin. A way that changes in flight: rotors, senses and faults follow it.
7. Ids of drones where some are gone.
8. Groups, phases and targets: each group's own.
9. What a thermal camera found: known after the drone's own delay.

Draws that must be independent of each other: moments of acting of each drone, attacks of each event, and all of them of
each seed and replication (the rooms' own draws are in their files of this name).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from sim_examples import PATIENT, example

from sortie.fleet.flight.rotor import fleet_power_w
from sortie.fleet.memory import PeerMemory, Received
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Directive, Disc, FleetView, Representation
from sortie.radio.rates import STANDARDS
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.people import People
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import Parts, build, fly, run_sortie
from sortie.sim.results.record import Recorder, SortieRecord


def to_all(view: FleetView) -> list[Directive]:
    return [Directive(view.ego, p, Representation.FEATURES, 0.02, None, 10.0, reason="all") for p in view.peers]


def columns(table: pa.Table, *names: str) -> list[Any]:
    return [table[n].to_numpy(zero_copy_only=False) for n in names]


# --- scoring --------------------------------------------------------------------------------------------


class Asked:
    """A detector that finds nothing and keeps what it was asked."""

    def __init__(self) -> None:
        self.truths: list[tuple[float, Capture]] = []

    def detect(self, jobs: Sequence[Any]) -> list[Boxes]:
        return [Boxes.empty() for _ in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        self.truths.append((t_s, ego))
        return Boxes.empty()

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        return 2


class AskedMany(Asked):
    calibration = "none"

    def detect_many(self, moments: Sequence[Sequence[Any]]) -> list[Boxes]:
        return [Boxes.empty() for moment in moments for _ in moment]

    def truth_many(self, t_s: Sequence[float], egos: Sequence[Capture]) -> list[Boxes]:
        return [self.truth(t, ego) for t, ego in zip(t_s, egos, strict=True)]


class AskedAhead(Asked):
    def begin(self, jobs: Sequence[Any]) -> Any:
        return lambda: self.detect(jobs)


@pytest.mark.parametrize("kind", [Asked, AskedMany, AskedAhead])
def test_truth_is_asked_for_at_the_time_of_scoring_and_the_pose_of_the_capture(kind: type[Asked]) -> None:
    detector = kind()
    scenario = example(
        "duration_s=3", "perception.fusion_delay_s=0.07", "events=[{kind: drone_lost, at_s: 1, drone: 2}]"
    )
    record = run_sortie(scenario, to_all, detector_of=lambda *_: detector)
    wanted = [frame * 0.1 + 0.07 for frame in scenario.scored_frames]
    assert [t for t, _ in detector.truths] == pytest.approx(np.repeat(wanted, 5))
    for t_s, ego in detector.truths:
        assert ego.t_s == pytest.approx(t_s - 0.07)
    t_s, drone = columns(record.tables["fusions"], "t_s", "drone")
    assert [(t, d) for t, d in zip(t_s, drone, strict=True) if d == 2 and t > 1.0] == []
    assert {d for t, d in zip(t_s, drone, strict=True) if t > 1.0} == {0, 1, 3, 4}


SEEN = ("perception.detector=surrogate", "perception.sample_rate_hz=10", *PATIENT)


def test_the_weight_of_a_fusion_is_the_directive_s_times_the_trust_in_its_sender() -> None:
    """One lies about its battery, and its payloads come at half weight already."""

    def policy(view: FleetView) -> list[Directive]:
        return [d._replace(fusion_weight=0.5 if view.ego == 1 else 1.0) for d in to_all(view)]

    record = run_sortie(
        example(*SEEN, "duration_s=9", "policy.dwell_s=0", "events=[{kind: lie, at_s: 0, drone: 1, about: coverage}]"),
        policy,
    )
    trust = {(r["drone"], r["peer"]): [] for r in record.tables["trust"].to_pylist()}
    for r in record.tables["trust"].to_pylist():
        trust[r["drone"], r["peer"]].append((r["t_s"], r["trust"]))
    assert {peer for _, peer in trust} == {1}
    checked = set()
    for row in record.tables["fusions"].to_pylist():
        for peer, weight in zip(row["peers"], row["weights"], strict=True):
            held = [v for t, v in trust.get((row["drone"], peer), []) if t <= row["t_s"]]
            wanted = (0.5 if peer == 1 else 1.0) * (held[-1] if held else 1.0)
            assert weight == pytest.approx(wanted)
            checked.add(round(weight, 3))
    assert {1.0, 0.5, 0.0} <= checked


def test_a_drone_s_own_look_may_be_as_old_as_its_own_computer_is_slow() -> None:
    """It detects with it; the others' limit is another."""
    make = "fleet.makes=[{name: slow, drones: [1], compute_delay_s: 0.35}]"
    record = run_sortie(example(*SEEN, "duration_s=3", "perception.max_age_s=0.2", make), "silence")
    t_s, drone, found = columns(record.tables["fusions"], "t_s", "drone", "detections")
    late = t_s > 1.0
    for d in range(5):
        assert found[late & (drone == d)].mean() > 2


@pytest.mark.parametrize("skew_s", [3.0, -3.0])
def test_payloads_of_a_drone_with_a_wrong_clock_are_fused_once_it_is_known(skew_s: float) -> None:
    event = f"events=[{{kind: clock_skew, at_s: 0, drone: 1, skew_s: {skew_s}}}]"
    record = run_sortie(example(*SEEN, "duration_s=4", "policy.dwell_s=0", event), to_all)
    last = [r for r in record.tables["fusions"].to_pylist() if r["t_s"] > 2.5]
    held = [1 in r["peers"] for r in last if r["drone"] != 1]
    own = [len(r["peers"]) for r in last if r["drone"] == 1]
    assert np.mean(held) > 0.9
    assert np.mean(own) > 3.5


@pytest.mark.parametrize("more", [(), ("radio.framing=tiles", "radio.bursts.loss_good=0.3", "radio.retry_limit=0")])
def test_a_payload_brings_the_data_rate_at_which_its_frames_came(
    more: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one of which only some tiles came."""
    came: list[Received] = []
    plain = PeerMemory.receive

    def kept(self: PeerMemory, received: Received) -> None:
        came.append(received)
        plain(self, received)

    monkeypatch.setattr(PeerMemory, "receive", kept)
    record = run_sortie(
        example("duration_s=4", "fleet.formation.spacing_m=120", "policy.dwell_s=0", *PATIENT, *more), to_all
    )
    rates = STANDARDS["ax"].rates_mbps[80]
    sent = record.tables["transmissions"].filter(pc.greater(record.tables["transmissions"]["arrived_bytes"], 0))
    done_s, mcs = columns(sent, "t_done_s", "mcs")
    wanted = sorted((t, rates[m] if m >= 0 else math.inf) for t, m in zip(done_s, mcs, strict=True))
    assert len(set(mcs.tolist())) > 2
    assert sorted((r.t_done_s, r.phy_mbps) for r in came) == wanted
    assert any(r.missing for r in came) == bool(more)


# --- drones that are gone ------------------------------------------------------------------------------------

LEAVES = {
    "lost": "{kind: drone_lost, at_s: 2.02, drone: 1}",
    "empty": "{kind: battery_fault, at_s: 2.02, drone: 1, lost_fraction: 1}",
    "last cell": "{kind: cell_failure, at_s: 2.02, drone: 1}",
    "home": "{kind: drone_leaves, at_s: 1.02, drone: 1}",
}


def flown_without(how: str, *more: str) -> tuple[SortieRecord, float]:
    sets = ["duration_s=5", "policy.dwell_s=0", "perception.compute_delay_s=0.04", *PATIENT, *more]
    if how == "last cell":
        sets.append("fleet.makes=[{name: one, drones: [1], battery: {cells: 1, cell_resistance_mohm: 0}}]")
    if how == "home":
        sets += ["fleet.formation.altitude_m=10", "mission.descent_mps=10"]
    record = run_sortie(example(*sets, f"events=[{LEAVES[how]}]"), to_all)
    t_s, drone, airborne = columns(record.tables["states"], "t_s", "drone", "airborne")
    gone = t_s[(drone == 1) & ~airborne]
    return record, 2.02 if how != "home" else float(gone[0]) - 1e-6


@pytest.mark.parametrize("how", LEAVES)
def test_a_drone_that_is_gone_does_nothing_gets_nothing_spends_nothing_and_stays(how: str) -> None:
    """Also what it had looked at and was about to send: it is lost between its look and its sending."""
    record, gone_s = flown_without(how)
    tables = record.tables
    for name, who, when in (
        ("descriptors", "drone", "t_s"), ("transmissions", "drone", "t_sent_s"), ("directives", "drone", "t_s"),
        ("ages", "drone", "t_s"), ("trust", "drone", "t_s"), ("fusions", "drone", "t_s"),
    ):  # fmt: skip
        drone, t_s = columns(tables[name], who, when)
        assert not ((drone == 1) & (t_s > gone_s)).any(), name
        if name != "trust" and name != "fusions":
            assert ((drone == 1) & (t_s < gone_s)).any(), name
    peer, t_s, status, reason = columns(tables["transmissions"], "peer", "t_sent_s", "status", "reason")
    to_it = (peer == 1) & (t_s > gone_s)
    assert to_it.any()
    assert set(reason[to_it].tolist()) <= {"receiver_gone", "replaced", "deadline_queued", ""}
    assert "delivered" not in status[to_it].tolist()
    states = tables["states"].filter(pc.equal(tables["states"]["drone"], 1))
    t_s, spent, current, x_m, y_m, v, looks = columns(
        states, "t_s", "spent_j", "current_a", "x_m", "y_m", "vx_mps", "looks"
    )
    after = t_s > gone_s + 0.1
    assert after.sum() > 10
    for values in (spent, x_m, y_m, looks):
        assert np.ptp(values[after]) == 0.0
    assert not current[after].any()
    assert not v[after].any()
    heard = columns(tables["receptions"].filter(pc.greater(tables["receptions"]["t_s"], gone_s + 0.1)), "heard")[0]
    assert heard.max() <= 4 * 3  # four that publish, three others each


def test_foreign_bytes_reach_nobody_who_is_gone() -> None:
    spoof = "{kind: spoof, at_s: 0.5, drone: 2, attack: malformed, rate_hz: 20}"
    record = run_sortie(example("duration_s=4", f"events=[{LEAVES['lost']}, {spoof}]"))
    receiver, t_s = columns(record.tables["drops"], "receiver", "t_s")
    assert set(receiver[t_s < 2.0].tolist()) == {0, 1, 3, 4}
    assert set(receiver[t_s > 2.1].tolist()) == {0, 3, 4}


def test_a_drone_that_waits_does_nothing_before_it_joins_and_acts_when_it_comes_back() -> None:
    joins = "{kind: drone_joins, at_s: 1.5, drone: 3}, {kind: drone_lost, at_s: 2.5, drone: 3}, {kind: drone_joins, at_s: 3.5, drone: 3}"
    record = run_sortie(example("duration_s=5", "policy.dwell_s=0", *PATIENT, f"events=[{joins}]"), to_all)
    for name, when in (("descriptors", "t_s"), ("transmissions", "t_sent_s"), ("ages", "t_s")):
        drone, t_s = columns(record.tables[name], "drone", when)
        t_s = t_s[drone == 3]
        away = (t_s < 1.5) | ((t_s > 2.5) & (t_s < 3.5))
        assert not away.any(), name
        assert ((t_s > 1.5) & (t_s < 2.5)).any()
        assert (t_s > 3.6).any()
    captured, drone = columns(record.tables["transmissions"], "captured_s", "drone")
    assert (captured[drone == 3] >= 1.5 - 1e-6).all()


def test_a_drone_that_came_back_is_replaced_again_when_it_goes_again() -> None:
    came_back = "{kind: drone_lost, at_s: 1, drone: 1}, {kind: drone_joins, at_s: 2, drone: 1}, {kind: drone_lost, at_s: 3, drone: 1}"
    group = "mission.groups=[{drones: [1, 3, 4], reserve: [3, 4], phases: [{phase: search}]}]"
    record = run_sortie(example("duration_s=4", group, f"events=[{came_back}]"))
    took_over = [
        (round(r["t_s"], 1), r["drone"]) for r in record.tables["events"].to_pylist() if "takes over" in r["text"]
    ]
    assert took_over == [(1.0, 3), (3.0, 4)]


def test_a_drone_that_came_back_is_scored_from_its_next_look_on() -> None:
    """It joins between its look and the scoring of a frame: what it sensed last is of before it left."""
    away = "events=[{kind: drone_lost, at_s: 2, drone: 1}, {kind: drone_joins, at_s: 3.05, drone: 1}]"
    record = run_sortie(example(*SEEN, "duration_s=4", away), "silence")
    t_s, drone = columns(record.tables["fusions"], "t_s", "drone")
    mine = t_s[drone == 1]
    assert mine[(mine > 2.0) & (mine < 3.15)].size == 0
    assert mine[mine > 3.15].size >= 7
    t_s, drone = columns(record.tables["truths"], "t_s", "drone")
    assert len(np.unique(t_s[drone == 1])) == 40


# --- energy and headrooms -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("duty", [100, 50, 0])
def test_computing_costs_energy_and_headroom_in_the_frames_in_which_perception_ran(duty: int) -> None:
    def resting(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, duty_percent=duty, reason="rest") for p in view.peers]

    sets = (
        "duration_s=6",
        "policy.dwell_s=0",
        "perception.compute_delay_s=0.05",
        "policy.hysteresis=0",
        *PATIENT,
    )
    record = run_sortie(example(*sets), resting)
    drone, looks = columns(record.tables["states"], "drone", "looks")
    energy = {(r["drone"], r["cause"]): r["energy_j"] for r in record.tables["energy"].to_pylist()}
    published_s, who, gpu = columns(record.tables["descriptors"], "t_s", "drone", "gpu_headroom")
    for d in range(5):
        ran = looks[drone == d]
        wanted = 10.0 * 6.0 + 30.0 * 0.5 * 0.1 * ran[-1]  # idle, and active for half of a frame
        assert energy[d, "compute"] == pytest.approx(wanted, abs=30.0 * 0.5 * 0.1 * 2 + 1e-6)
        rate_hz = (ran[50] - ran[30]) / 2.0
        assert rate_hz == pytest.approx(duty / 10, abs=0.6)
        late = (who == d) & (published_s > 4.0)
        assert gpu[late].mean() == pytest.approx(1 - 0.05 * rate_hz, abs=0.012)


# --- events that overlap --------------------------------------------------------------------------------------------


def parts(*sets: str) -> Parts:
    scenario = example(*sets)
    return build(scenario, plan_for(scenario), scenario.seed)


def test_the_radio_costs_what_it_draws_while_it_sends() -> None:
    flight = parts("duration_s=3", "policy.dwell_s=0")
    fly(flight)
    airtime_s = np.array(flight.world.air.airtime_s)
    assert airtime_s.min() > 0.1
    listens_w, more_w = 2.0, 4.0
    np.testing.assert_allclose(
        flight.world.batteries.energy_j["radio"], listens_w * 3.0 + more_w * airtime_s, atol=more_w * 0.01
    )


def test_a_link_that_comes_back_takes_only_its_own_loss_back() -> None:
    """Both ways, link by link, while another event holds all links of one end."""
    flight = parts(
        "events=[{kind: link_drop, at_s: 1, drone: 0, peer: 1, loss_db: 5, until_s: 4},"
        "{kind: link_drop, at_s: 2, drone: 1, loss_db: 7, until_s: 3},"
        "{kind: link_drop, at_s: 2.5, drone: 2, peer: 1, loss_db: 11, until_s: 3.5}]"
    )

    def lost(at_s: float) -> dict[tuple[int, int], float]:
        flight.env.run(until=at_s)
        extra = flight.world.extra_loss_db
        if extra is None:
            return {}
        np.testing.assert_array_equal(extra, extra.T)
        return {(i, j): float(extra[i, j]) for i in range(5) for j in range(i + 1, 5) if extra[i, j]}

    assert lost(0.5) == {}
    assert lost(1.5) == {(0, 1): 5}
    assert lost(2.2) == {(0, 1): 12, (1, 2): 7, (1, 3): 7, (1, 4): 7}
    assert lost(2.7) == {(0, 1): 12, (1, 2): 18, (1, 3): 7, (1, 4): 7}
    assert lost(3.2) == {(0, 1): 5, (1, 2): 11}
    assert lost(3.7) == {(0, 1): 5}
    assert lost(4.5) == {}


def test_jammers_and_lies_end_one_by_one() -> None:
    flight = parts(
        "events=[{kind: jam, at_s: 1, position_m: [0, 0, 10], power_dbm: 1, until_s: 3},"
        "{kind: jam, at_s: 2, position_m: [9, 0, 10], power_dbm: 2, until_s: 4},"
        "{kind: lie, at_s: 1, drone: 1, about: battery, until_s: 3}, {kind: lie, at_s: 2, drone: 1, until_s: 4},"
        "{kind: lie, at_s: 2, drone: 2, until_s: 4}]"
    )
    seen = []
    for at_s in (0.5, 1.5, 2.5, 3.5, 4.5):
        flight.env.run(until=at_s)
        lies = [len(status.lies) for status in flight.world.drones]
        seen.append((sorted(power for _, power in flight.world.jammers.values()), lies))
    assert [jammed for jammed, _ in seen] == [[], [1], [1, 2], [2], []]
    assert [lies[1] for _, lies in seen] == [0, 1, 2, 1, 0]
    assert [lies[2] for _, lies in seen] == [0, 0, 1, 1, 0]
    assert not any(lies[0] or lies[3] or lies[4] for _, lies in seen)


def test_losses_of_weaker_senders_stay_when_an_event_ends() -> None:
    make = "fleet.makes=[{name: weak, drones: [1], tx_power_dbm: 14}]"
    flight = parts(make, "events=[{kind: link_drop, at_s: 1, drone: 1, peer: 0, loss_db: 5, until_s: 2}]")
    for at_s, there, back in ((0.5, 6.0, 0.0), (1.5, 11.0, 5.0), (2.5, 6.0, 0.0)):
        flight.env.run(until=at_s)
        extra = flight.world.extra_loss_db
        assert extra is not None
        assert (extra[1, 0], extra[0, 1], extra[1, 2]) == (there, back, 6.0)


def test_what_blinds_and_slows_a_drone_ends_one_by_one() -> None:
    """Each event's own part, while another of its kind goes on; other drones are as they were."""
    flight = parts(
        "events=[{kind: slow_perception, at_s: 1, drone: 1, extra_s: 0.01, until_s: 3},"
        "{kind: slow_perception, at_s: 2, drone: 1, extra_s: 0.02, until_s: 4},"
        "{kind: slow_perception, at_s: 1, drone: 3, extra_s: 0.04},"
        "{kind: camera_blocked, at_s: 1, drone: 1, until_s: 3}, {kind: camera_blocked, at_s: 2, drone: 1, until_s: 4}]"
    )
    seen = []
    for at_s in (0.5, 1.5, 2.5, 3.5, 4.5):
        flight.env.run(until=at_s)
        drones = flight.world.drones
        seen.append(
            (round(sum(drones[1].slower_s.values()), 9), len(drones[1].blocked), sum(drones[3].slower_s.values()))
        )
    assert seen == [(0.0, 0, 0.0), (0.01, 1, 0.04), (0.03, 2, 0.04), (0.02, 1, 0.04), (0.0, 0, 0.04)]
    assert not any(flight.world.drones[i].slower_s or flight.world.drones[i].blocked for i in (0, 2, 4))


@pytest.mark.parametrize(
    "leaves", ["", ", {kind: drone_leaves, at_s: 1.5, drone: 2}, {kind: drone_joins, at_s: 3, drone: 2}"]
)
def test_a_fleet_that_flies_another_way_pays_for_it_and_believes_as_before(leaves: str) -> None:
    """A drone goes home and comes back: rotors draw what the way as it was flown asks for, and faults of sensors stay."""
    flight = parts(
        "duration_s=5", "mission.descent_mps=10",
        f"events=[{{kind: position_fault, at_s: 1, drone: 1, offset_m: [10, -4, 2]}}, {{kind: heading_fault, at_s: 1, drone: 2, offset_deg: 20}}{leaves}]",
    )  # fmt: skip
    fly(flight)
    world, motion, scenario = flight.world, flight.world.motion, flight.scenario
    for frame, wrong in ((5, False), (14, True), (25, True), (45, True)):
        for drone, off_m, off_rad in ((0, (0, 0, 0), 0.0), (1, (10, -4, 2), 0.0), (2, (0, 0, 0), math.radians(20))):
            here = world.sensed(drone, frame).capture
            assert here.position_m == tuple(motion.position_m[frame, drone])
            error_m = np.subtract(here.est_position_m, motion.est_position_m[frame, drone])
            assert error_m == pytest.approx(off_m if wrong else (0, 0, 0))
            turn = here.est_yaw_rad - motion.est_yaw_rad[frame, drone]
            assert np.mod(turn + 1, 2 * np.pi) - 1 == pytest.approx(off_rad if wrong else 0.0)
    power_w, states = fleet_power_w(scenario.fleet, motion), flight.recorder.finish()["states"]
    airborne = np.reshape(states["airborne"].to_numpy(zero_copy_only=False), (-1, 5))
    used_j = (power_w * airborne).sum(axis=0) * scenario.frame_s / scenario.fleet.battery.drivetrain_efficiency
    flown = [i for i in range(5) if airborne[:, i].all()]
    assert len(flown) >= 4
    for drone in flown:
        assert flight.batteries.energy_j["rotor"][drone] == pytest.approx(used_j[drone], rel=1e-9)
    if leaves:
        assert flight.batteries.energy_j["rotor"][2] == pytest.approx(used_j[2], rel=0.03)  # it landed within a frame


# --- ids, groups, people ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gone", [0, 1, 3])
def test_the_link_that_limits_a_fleet_is_named_by_its_drones_where_some_are_gone(gone: int, tmp_path: Path) -> None:
    slow = 2 if gone != 2 else 3
    rows = ["t_s,sender,receiver,goodput_mbps"]
    for i in range(4):
        for j in range(4):
            if i != j:
                rows.append(f"0,{i},{j},{(5 + (i + j) / 10) if slow in (i, j) else 60}")  # noqa: PERF401
    file = tmp_path / "links.csv"
    file.write_text("\n".join(rows) + "\n")
    record = run_sortie(
        example(
            "fleet.drones=4", "radio.relay_max_hops=2", f"radio.trace={file}", "duration_s=4",
            f"events=[{{kind: drone_lost, at_s: 1.5, drone: {gone}}}]",
        )
    )  # fmt: skip
    left = [i for i in range(4) if i not in (gone, slow)]
    best = max(left)  # the best of the slow one's links
    for row in record.tables["topology"].to_pylist():
        if row["t_s"] > 2:
            assert {row["bottleneck_sender"], row["bottleneck_receiver"]} == {slow, best}
            assert row["bottleneck_mbps"] == pytest.approx(5 + (slow + best) / 10)
            assert row["cut_drones"] == []


@pytest.mark.parametrize("gone", [0, 2])
def test_who_is_cut_off_is_named_by_its_number_where_some_are_gone(gone: int) -> None:
    record = run_sortie(
        example(
            "radio.relay_max_hops=2", "duration_s=4",
            f"events=[{{kind: drone_lost, at_s: 1.5, drone: {gone}}}, {{kind: link_drop, at_s: 1.5, drone: 3, loss_db: 150}}]",
        )
    )  # fmt: skip
    cut = {row["t_s"]: (row["connected"], row["cut_drones"]) for row in record.tables["topology"].to_pylist()}
    assert cut == {0.0: (True, []), 1.0: (True, []), 2.0: (False, [3]), 3.0: (False, [3])}


@pytest.mark.parametrize("skew_s", [0.0, -0.06, 0.06])
def test_the_ages_of_a_record_are_true_whatever_drones_believe(skew_s: float) -> None:
    """A clock that is off by less than its peers can see: they take the payloads for older or younger than they are."""
    events = f"events=[{{kind: clock_skew, at_s: 0, drone: 1, skew_s: {skew_s}}}]" if skew_s else "events=[]"
    record = run_sortie(example("duration_s=4", "perception.detector=surrogate", events, *PATIENT), to_all)
    sent = {
        (row["peer"], row["drone"], round(row["captured_s"], 6)): row["t_done_s"]
        for row in record.tables["transmissions"].to_pylist()
    }
    count = 0
    for row in record.tables["fusions"].to_pylist():
        for peer, age_s in zip(row["peers"], row["ages_s"], strict=True):
            assert sent[row["drone"], peer, round(row["t_s"] - age_s, 6)] <= row["t_s"]
            count += peer == 1
    assert count > 5


def test_each_group_has_its_own_phase_region_and_target() -> None:
    scenario = example(
        "mission.more_targets=[{waypoints_m: [[0, 0], [60, 0]], speed_mps: 3}, {waypoints_m: [[0, 50], [0, 90]], speed_mps: 2}]",
        "mission.groups=[{drones: [1, 2], phases: [{phase: search, target: 1}, {at_s: 2, phase: track, target: 1, region: {radius_m: 20}}]},"
        "{drones: [3], phases: [{phase: track, target: 2, region: {radius_m: 10}}]}]",
    )
    plan = MissionPlan(scenario.mission, 5)
    assert plan.group_of == [0, 1, 1, 2, 0]
    for t_s in (0.0, 2.0, 4.0):
        now = plan.at(t_s)
        assert now[0].target_xy == pytest.approx((-60 + 5 * t_s, -1.75))
        assert now[1].target_xy == pytest.approx((3 * t_s, 0.0))
        assert now[2].target_xy == pytest.approx((0.0, 50 + 2 * t_s))
        assert [now[g].target for g in range(3)] == [0, 1, 2]
        assert now[1].phase == ("search" if t_s < 2 else "track")
        assert now[2].region == pytest.approx((0.0, 50 + 2 * t_s, 10.0))
        assert now[1].region == (None if t_s < 2 else pytest.approx((3 * t_s, 0.0, 20.0)))


def test_a_person_is_known_after_the_delay_of_the_drone_s_own_computer() -> None:
    scenario = example(
        "perception.people=[{waypoints_m: [[0, 0], [1, 0]]}]",
        "perception.thermal={near_probability: 1, half_range_m: 2000, position_error_m: 0, false_alarms_per_min: 0}",
        "fleet.makes=[{name: slow, drones: [1], compute_delay_s: 0.5}]",
        "perception.compute_delay_s=0.1", "perception.scene.building_density=0", "perception.scene.tree_density=0",
    )  # fmt: skip
    perception = scenario.perception
    scene = SceneModel(perception.scene, None, (-50, -50, 50, 50), (), perception.people)
    people = People(scenario, scene, Recorder(), (1, 0))
    region = Disc(0.0, 0.0, 20.0)
    for drone, delay_s in ((0, 0.1), (1, 0.5)):
        at = Capture(drone, 1.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 60.0), 0.0)
        people.look(at, 10)
        assert not people.known_in(drone, region, 1.0 + delay_s - 0.01)
        assert people.known_in(drone, region, 1.0 + delay_s)
        assert not people.known_in(drone, Disc(100.0, 0.0, 20.0), 1.0 + delay_s)
        assert not people.known_in(drone, None, 1.0 + delay_s)
        assert len(people.known(at, [], 1.0 + delay_s - 0.01)) == 0
        assert len(people.known(at, [], 1.0 + delay_s)) == 1


# --- draws that must be independent ----------------------------------------------------------------------------------------


def moments(seed: int, replication: int = 0) -> list[float]:
    """When in a frame each drone acts."""
    record = run_sortie(example("duration_s=0.3", f"seed={seed}"), replication=replication)
    t_s, drone = columns(record.tables["ages"], "t_s", "drone")
    return [float(t_s[drone == d].max()) % 0.1 for d in range(5)]


def test_drones_act_at_moments_of_their_own() -> None:
    every = [*moments(1), *moments(2), *moments(1, 1)]
    assert min(every) >= 0.0
    assert max(every) < 0.01
    assert len({round(m, 7) for m in every}) == 15


def test_a_seed_and_a_replication_move_every_table_that_chance_fills() -> None:
    """Motion, air and thermal cameras alike, in every drone."""
    sets = (
        "duration_s=2", "policy.dwell_s=0", "perception.people=[{waypoints_m: [[-60, 0], [60, 0]], speed_mps: 5}]",
        "perception.thermal={false_alarms_per_min: 600}", "fleet.clock.offset_s=0.01",
    )  # fmt: skip

    def flown(seed: int, replication: int) -> SortieRecord:
        return run_sortie(example(*sets), to_all, seed, replication=replication)

    usual, again, seeded, repeated = flown(1, 0), flown(1, 0), flown(2, 0), flown(1, 1)
    assert usual.fingerprint == again.fingerprint
    chance = {"states": ("x_m", "y_m", "z_m", "qx"), "transmissions": ("t_done_s", "snr_db"), "sightings": ("x_m",)}
    for name, which in chance.items():
        for column in which:
            values = [
                {round(v, 9) for v in r.tables[name][column].to_pylist() if not math.isnan(v)}
                for r in (usual, seeded, repeated)
            ]
            for other in values[1:]:
                assert len(values[0] & other) <= 0.05 * len(values[0]) + 1, (name, column)
