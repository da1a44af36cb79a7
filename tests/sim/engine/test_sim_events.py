"""Events: what the record has of each, what overlapping ones leave when one ends, and the frame in which they begin.

Where nothing has to fly, events alone run on the clock of a sortie that was built and not started.
"""

from __future__ import annotations

import math

import numpy as np
import pyarrow.compute as pc
import pytest
from recorded import recorded
from sim_examples import example

from sortie.fleet.flight.rotor import fleet_power_w
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import Parts, build, fly, run_sortie
from sortie.sim.results.record import SortieRecord

SEARCH = "mission.phases=[{at_s: 0, phase: search}]"


def parts(*sets: str) -> Parts:
    scenario = example(SEARCH, *sets)
    return build(scenario, plan_for(scenario), scenario.seed)


def noted(events: str, *sets: str) -> list[tuple[float, int, str, str]]:
    """Time, drone, kind and text of each event in 2.5 s of a silent flight."""
    record = run_sortie(example("duration_s=2.5", SEARCH, f"events=[{events}]", *sets), "silence")
    rows = record.tables["events"].to_pylist()
    return [(round(r["t_s"], 6), r["drone"], r["kind"], r["text"]) for r in rows if r["kind"] != "policy"]


# --- what is noted -------------------------------------------------------------------------------


EVENTS = """
  {kind: link_drop, at_s: 0.5, drone: 1, loss_db: 5.5, until_s: 1.5},
  {kind: link_drop, at_s: 0.6, drone: 2, peer: 3, loss_db: 7, until_s: 1.6},
  {kind: jam, at_s: 0.7, position_m: [1, 2, 3], power_dbm: 11, until_s: 1.7},
  {kind: battery_fault, at_s: 0.8, drone: 4, lost_fraction: 0.25},
  {kind: cell_failure, at_s: 0.9, drone: 3},
  {kind: position_fault, at_s: 1.0, drone: 1, offset_m: [3, -4, 12], drift_mps: [0.3, 0.4, 0], until_s: 1.8},
  {kind: heading_fault, at_s: 1.1, drone: 2, offset_deg: 20, drift_degps: 1.5, until_s: 1.9},
  {kind: camera_blocked, at_s: 1.2, drone: 0, until_s: 2.0},
  {kind: slow_perception, at_s: 1.3, drone: 3, extra_s: 0.04, until_s: 2.1},
  {kind: spoof, at_s: 1.4, drone: 2, attack: replayed, rate_hz: 3},
  {kind: drone_lost, at_s: 2.2, drone: 1}"""


def test_each_event_is_noted_at_its_begin_and_its_end_with_its_own_drone_and_figures() -> None:
    told = noted(EVENTS)
    cells = next(text for _, _, kind, text in told if kind == "cell_failure")
    assert cells.endswith(" cells are left")
    usual = "its believed pose has its usual errors again"
    assert told == [
        (0.5, 1, "link_drop", "links of 1 lose 5.5 dB"),
        (0.6, 2, "link_drop", "links of 2–3 lose 7 dB"),
        (0.7, -1, "jam", "a jammer of 11 dBm at (1.0, 2.0, 3.0)"),
        (0.8, 4, "battery_fault", "25% of the remaining energy is gone"),
        (0.9, 3, "cell_failure", cells),
        (1.0, 1, "position_fault", "believes to be 13 m away, drifting at 0.5 m/s"),
        (1.1, 2, "heading_fault", "believes its heading 20° off, drifting by 1.5° a second"),
        (1.2, 0, "camera_blocked", "its cameras see nothing"),
        (1.3, 3, "slow_perception", "its perception takes 0.04 s longer"),
        (1.4, 2, "spoof", "replayed descriptors at 3 Hz"),
        (1.5, 1, "link_back", "links of 1 are back"),
        (1.6, 2, "link_back", "links of 2–3 are back"),
        (1.7, -1, "jam_over", "the jammer is off"),
        (1.8, 1, "position_fault_over", usual),
        (1.9, 2, "heading_fault_over", usual),
        (2.0, 0, "camera_clear", "its cameras see again"),
        (2.1, 3, "slow_perception_over", "its perception takes its usual time again"),
        (2.2, 1, "drone_lost", "fell silent"),
    ]


def test_the_end_of_an_event_says_so_where_another_one_lasts() -> None:
    """Each kind of event twice: the first ends at 1 s, and what it did lasts until 2 s, or to the end."""
    events = """
      {kind: link_drop, at_s: 0, drone: 1, until_s: 1}, {kind: link_drop, at_s: 0, drone: 2, peer: 1, until_s: 2},
      {kind: link_drop, at_s: 0, drone: 3, peer: 4, until_s: 1}, {kind: link_drop, at_s: 0, drone: 3, peer: 0},
      {kind: jam, at_s: 0, position_m: [1, 2, 3], until_s: 1}, {kind: jam, at_s: 0, position_m: [9, 2, 3], until_s: 2},
      {kind: position_fault, at_s: 0, drone: 0, until_s: 1}, {kind: heading_fault, at_s: 0, drone: 0, until_s: 2},
      {kind: position_fault, at_s: 0, drone: 1, until_s: 1}, {kind: gnss_loss, at_s: 0, position_walk_m: 1},
      {kind: camera_blocked, at_s: 0, drone: 2, until_s: 1}, {kind: camera_blocked, at_s: 0, drone: 2, until_s: 2},
      {kind: camera_blocked, at_s: 0, drone: 3, until_s: 1},
      {kind: slow_perception, at_s: 0, drone: 2, until_s: 1}, {kind: slow_perception, at_s: 0, drone: 2, extra_s: 0.3},
      {kind: lie, at_s: 0, drone: 4, until_s: 1}, {kind: lie, at_s: 0, drone: 4, about: battery, until_s: 2}"""
    assert [(round(t_s), *rest) for t_s, *rest in noted(events) if t_s > 0] == [
        (1, 1, "link_drop", "links of 1 are back only where no other drop lasts"),
        (1, 3, "link_back", "links of 3–4 are back"),
        (1, -1, "jam", "this jammer is off, another one is still on"),
        (1, 0, "position_fault", "its believed pose is still wrong: another fault lasts"),
        (1, 1, "position_fault", "its believed pose is still wrong: another fault lasts"),
        (1, 2, "camera_blocked", "its cameras still see nothing: another block lasts"),
        (1, 3, "camera_clear", "its cameras see again"),
        (1, 2, "slow_perception", "its perception still takes 0.3 s longer"),
        (1, 4, "lie", "still lies: another lie lasts"),
        (2, 2, "link_back", "links of 2–1 are back"),
        (2, -1, "jam_over", "the jammer is off"),
        (2, 0, "heading_fault", "its believed pose is still wrong: another fault lasts"),
        (2, 2, "camera_clear", "its cameras see again"),
        (2, 4, "lie_over", "tells the truth again"),
    ]


def test_an_event_that_changes_nothing_is_noted_with_the_reason() -> None:
    events = """
      {kind: drone_leaves, at_s: 0.5, drone: 0}, {kind: drone_leaves, at_s: 1, drone: 0},
      {kind: drone_joins, at_s: 2, drone: 0}, {kind: drone_lost, at_s: 0.8, drone: 2},
      {kind: drone_joins, at_s: 1.2, drone: 2}, {kind: drone_joins, at_s: 1.3, drone: 2},
      {kind: drone_lost, at_s: 1.4, drone: 2}, {kind: cell_failure, at_s: 1.5, drone: 2},
      {kind: drone_lost, at_s: 1.6, drone: 2}"""
    assert [(t_s, drone, text) for t_s, drone, kind, text in noted(events) if kind == "no_effect"] == [
        (1.0, 0, "drone_leaves: it already descends"),
        (1.3, 2, "drone_joins: it is already in the fleet"),
        (1.5, 2, "cell_failure: it is not in the fleet"),
        (1.6, 2, "drone_lost: it is not in the fleet"),
        (2.0, 0, "drone_joins: it still descends"),
    ]
    joins = "{kind: drone_joins, at_s: 2, drone: 1}"
    early = f"{{kind: battery_fault, at_s: 0.5, drone: 1, lost_fraction: 0.5}}, {joins}"
    assert noted(early) == [
        (0.5, 1, "no_effect", "battery_fault: it is not in the fleet"),
        (2.0, 1, "drone_joins", "takes off"),
    ]


def test_the_last_cells_of_a_pack_are_counted_and_a_ground_station_is_switched_on() -> None:
    cells = ", ".join(f"{{kind: cell_failure, at_s: {at_s}, drone: 1}}" for at_s in (1, 1.5))
    events = f"{cells}, {{kind: drone_joins, at_s: 2, drone: 4}}"
    pack = "fleet.makes=[{name: two, drones: [1], battery: {cells: 2, cell_resistance_mohm: 0}}]"
    station = "fleet.ground=[{drone: 4, position_m: [0, 0, 3]}]"
    told = [(kind, text) for _, _, kind, text in noted(events, pack, station) if kind != "landed"]
    assert told == [
        ("cell_failure", "1 cell is left"),
        ("cell_failure", "no cell is left"),
        ("drone_joins", "is switched on"),
    ]


# --- events that overlap -------------------------------------------------------------------------


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
        seen.append((sorted(power for _, power in flight.world.jammers), lies))
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


def test_a_fleet_that_flies_another_way_pays_for_it_and_believes_as_before() -> None:
    """A drone goes home and comes back: rotors draw what the way as flown asks for, and sensors' faults stay."""
    events = (
        "{kind: position_fault, at_s: 1, drone: 1, offset_m: [10, -4, 2]}",
        "{kind: heading_fault, at_s: 1, drone: 2, offset_deg: 20}",
        "{kind: drone_leaves, at_s: 1.5, drone: 2}, {kind: drone_joins, at_s: 3, drone: 2}",
    )
    flight = parts("duration_s=5", "mission.descent_mps=10", f"events=[{', '.join(events)}]")
    fly(flight)
    world, motion, scenario = flight.world, flight.world.motion[:], flight.scenario
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
    assert flight.batteries.energy_j["rotor"][2] == pytest.approx(used_j[2], rel=0.03)  # it landed within a frame


# --- the moment of an event ----------------------------------------------------------------------


def snr_of_2(record: SortieRecord, begin_s: float, end_s: float) -> float:
    sent = record.tables["transmissions"]
    keep = pc.and_(pc.greater_equal(sent["t_sent_s"], begin_s), pc.less(sent["t_sent_s"], end_s))
    return float(np.nanmean(sent.filter(pc.and_(keep, pc.equal(sent["drone"], 2)))["snr_db"].to_numpy()))


def test_a_jammer_weakens_links_from_its_begin_to_its_end() -> None:
    """It is on from 2.5 s to 3.5 s; a link of drone 2 loses 15 dB from 1 s to 2 s."""
    jammed, base = recorded("faults"), recorded("base")
    assert snr_of_2(jammed, 0.0, 0.95) == pytest.approx(snr_of_2(base, 0.0, 0.95))
    assert snr_of_2(jammed, 2.7, 3.5) < snr_of_2(base, 2.7, 3.5) - 5
    assert snr_of_2(jammed, 3.7, 5.0) > snr_of_2(jammed, 2.7, 3.5) + 5


def test_what_ends_with_a_frame_ends_before_it() -> None:
    """2.4 + (6.7 − 2.4) is a digit above 6.7, and at 6.65 the frame of 6.7 stands on the clock already."""
    few = ("duration_s=7", "fleet.drones=3", SEARCH)
    clear = run_sortie(example(*few))
    for begin_s, end_s in ((2.4, 6.7), (6.65, 6.7)):
        drop = f"events=[{{kind: link_drop, drone: 2, at_s: {begin_s}, until_s: {end_s}, loss_db: 15}}]"
        dropped = run_sortie(example(*few, drop))
        assert [e["t_s"] for e in dropped.tables["events"].to_pylist()] == [begin_s, end_s]
        clear_db, after_db = (
            {
                (row["peer"], row["snr_db"])
                for row in record.tables["transmissions"].to_pylist()
                if row["drone"] == 2 and end_s < row["t_sent_s"] < end_s + 0.1
            }
            for record in (clear, dropped)
        )
        assert after_db == clear_db != set()


def test_an_event_comes_before_its_frame_whatever_the_clock_rounds() -> None:
    """At 7.5 Hz the frame of 14.8 s stands a last digit below it on the clock."""
    lost = "events=[{kind: drone_lost, drone: 1, at_s: 14.8}]"
    record = run_sortie(example("context.rate_hz=7.5", "duration_s=15", "fleet.drones=2", lost), "silence")
    seen = record.tables["states"].filter(pc.equal(record.tables["states"]["drone"], 1)).to_pylist()
    assert [row["t_s"] < 14.8 - 1e-9 for row in seen] == [row["airborne"] for row in seen]


def test_an_event_with_a_frame_leaves_the_others_headrooms_alone() -> None:
    """0.3 is a last digit below the third frame: what lies between them is no time of which the radio has a share."""
    left = []
    for events in ("", "{kind: battery_fault, drone: 3, at_s: 0.3, lost_fraction: 0.01}"):
        record = run_sortie(example("duration_s=0.5", SEARCH, f"events=[{events}]"))
        left.append([d["cpu_headroom"] for d in record.tables["descriptors"].to_pylist() if d["drone"] != 3])
    assert left[0] == pytest.approx(left[1])
    assert min(left[0]) < 1.0
