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
