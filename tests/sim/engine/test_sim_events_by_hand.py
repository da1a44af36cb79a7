"""What the record says of each event: when, of which drone, of which kind, and in which words."""

from __future__ import annotations

from sim_examples import example

from sortie.sim.engine.sortie import run_sortie

EVENTS = """events=[
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
  {kind: drone_lost, at_s: 2.2, drone: 1}]"""


def test_each_event_is_noted_at_its_begin_and_its_end_with_its_own_drone_and_figures() -> None:
    rows = run_sortie(example("duration_s=2.5", EVENTS), "silence").tables["events"].to_pylist()
    told = [(round(r["t_s"], 6), r["drone"], r["kind"], r["text"]) for r in rows if r["kind"] != "policy"]
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


def texts(*overrides: str) -> list[tuple[float, int, str, str]]:
    rows = run_sortie(example("duration_s=2.5", *overrides), "silence").tables["events"].to_pylist()
    return [(round(r["t_s"], 6), r["drone"], r["kind"], r["text"]) for r in rows if r["kind"] != "policy"]


def test_the_end_of_an_event_says_so_where_another_one_lasts() -> None:
    """Each kind of event twice: the first ends at 1 s, and what it did lasts until 2 s, or to the end."""
    events = """events=[
      {kind: link_drop, at_s: 0, drone: 1, until_s: 1}, {kind: link_drop, at_s: 0, drone: 2, peer: 1, until_s: 2},
      {kind: link_drop, at_s: 0, drone: 3, peer: 4, until_s: 1}, {kind: link_drop, at_s: 0, drone: 3, peer: 0},
      {kind: jam, at_s: 0, position_m: [1, 2, 3], until_s: 1}, {kind: jam, at_s: 0, position_m: [9, 2, 3], until_s: 2},
      {kind: position_fault, at_s: 0, drone: 0, until_s: 1}, {kind: heading_fault, at_s: 0, drone: 0, until_s: 2},
      {kind: position_fault, at_s: 0, drone: 1, until_s: 1}, {kind: gnss_loss, at_s: 0, position_walk_m: 1},
      {kind: camera_blocked, at_s: 0, drone: 2, until_s: 1}, {kind: camera_blocked, at_s: 0, drone: 2, until_s: 2},
      {kind: camera_blocked, at_s: 0, drone: 3, until_s: 1},
      {kind: slow_perception, at_s: 0, drone: 2, until_s: 1}, {kind: slow_perception, at_s: 0, drone: 2, extra_s: 0.3},
      {kind: lie, at_s: 0, drone: 4, until_s: 1}, {kind: lie, at_s: 0, drone: 4, about: battery, until_s: 2}]"""
    assert [(round(t_s), *rest) for t_s, *rest in texts(events) if t_s > 0] == [
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
    events = """events=[
      {kind: drone_leaves, at_s: 0.5, drone: 0}, {kind: drone_leaves, at_s: 1, drone: 0}, {kind: drone_joins, at_s: 2, drone: 0},
      {kind: drone_lost, at_s: 0.8, drone: 2}, {kind: drone_joins, at_s: 1.2, drone: 2}, {kind: drone_joins, at_s: 1.3, drone: 2},
      {kind: drone_lost, at_s: 1.4, drone: 2}, {kind: cell_failure, at_s: 1.5, drone: 2}, {kind: drone_lost, at_s: 1.6, drone: 2}]"""
    assert [(t_s, drone, text) for t_s, drone, kind, text in texts(events) if kind == "no_effect"] == [
        (1.0, 0, "drone_leaves: it already descends"),
        (1.3, 2, "drone_joins: it is already in the fleet"),
        (1.5, 2, "cell_failure: it is not in the fleet"),
        (1.6, 2, "drone_lost: it is not in the fleet"),
        (2.0, 0, "drone_joins: it still descends"),
    ]
    joins = "{kind: drone_joins, at_s: 2, drone: 1}"
    early = f"events=[{{kind: battery_fault, at_s: 0.5, drone: 1, lost_fraction: 0.5}}, {joins}]"
    assert texts(early) == [
        (0.5, 1, "no_effect", "battery_fault: it is not in the fleet"),
        (2.0, 1, "drone_joins", "takes off"),
    ]


def test_the_last_cells_of_a_pack_are_counted_and_a_ground_station_is_switched_on() -> None:
    events = "events=[{kind: cell_failure, at_s: 1, drone: 1}, {kind: cell_failure, at_s: 1.5, drone: 1}, {kind: drone_joins, at_s: 2, drone: 4}]"
    pack = "fleet.makes=[{name: two, drones: [1], battery: {cells: 2, cell_resistance_mohm: 0}}]"
    station = "fleet.ground=[{drone: 4, position_m: [0, 0, 3]}]"
    told = [(kind, text) for _, _, kind, text in texts(events, pack, station) if kind != "landed"]
    assert told == [
        ("cell_failure", "1 cell is left"),
        ("cell_failure", "no cell is left"),
        ("drone_joins", "is switched on"),
    ]
