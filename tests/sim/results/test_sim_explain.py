"""Reasons for a metric: the facts of the record that it depends on, as the record has them."""

from __future__ import annotations

import record_by_hand as by_hand

from sortie.sim.results.explain import explain_metric

FATES = "payloads: 6 delivered, 3 expired/deadline_queued, 1 lost/retries of 10, medium 13 % busy"
FUSED = "0.8 peers' payloads a fusion, 0.26 s old at the median"
GONE = "left the air: drone 1 at 2 s (low)"
LOST = (
    "descriptors lost: 5.0 % collisions with payloads, 3.0 % collisions with descriptors, 2.0 % own transmissions, "
    "1.0 % hidden senders"
)
REFUSED = "descriptors refused: 2 replay, 1 bad_tag"
SPENT = "energy rotor 8.1 kJ, compute 2.3 kJ, radio 1.2 kJ"
EVER = "decided because of '1.05 s old' ×2, 'a' ×1; happened: 1 s jam, 2 s landed"
FACTS: dict[str, list[str]] = {
    "ap50.mission": [GONE, FUSED, FATES],
    "mission.flown_share": [GONE, FUSED],
    "data_age_s.p50": [FUSED, FATES],
    "phases.0.data_rate_mbps": [FUSED, FATES],
    "bytes.data_sent": [FATES],
    "deadline_miss_rate": [FATES],
    "medium_busy_fraction": [FATES],
    "context.lost": [LOST],
    "age_s.p99": [LOST, REFUSED],
    "descriptor_drops.replay": [REFUSED],
    "energy_j.total": [SPENT],
    "battery.1": [SPENT],
    "drones.1.soc": [SPENT],
    "switches": [],
}


def test_a_metric_is_explained_by_the_facts_that_it_depends_on() -> None:
    rows = by_hand.rows()
    rows["events"] = [
        {"t_s": 1.0, "drone": -1, "kind": "jam", "text": "on"},
        {"t_s": 2.0, "drone": 1, "kind": "landed", "text": "low"},
    ]
    reasons = ("1.05 s old", "a", "1.05 s old")  # was once `15 s old`
    rows["directives"] = [row | {"reason": reason} for row, reason in zip(rows["directives"], reasons, strict=True)]
    # 0.8 peers: three fusions of 1, 2 and 1 payloads, and one of none
    rows["fusions"].append(rows["fusions"][2] | {"t_s": 3.9})
    result = by_hand.told_outcome() | {"descriptor_drops": {"bad_tag": 1, "replay": 2, "other_fleet": 0}}
    record = by_hand.record(tables=by_hand.tables_of(rows))
    got = {metric: explain_metric(metric, record, result) for metric in FACTS}
    assert got == {metric: "; ".join([*facts, EVER]) for metric, facts in FACTS.items()}


def test_of_many_who_left_the_air_the_first_are_named() -> None:
    rows = by_hand.rows()
    kinds = ("landed", "drone_lost", "power_lost", "landed", "drone_joins", "landed")
    rows["events"] = [{"t_s": k + 0.5, "drone": k, "kind": kind, "text": "t"} for k, kind in enumerate(kinds)]
    rows["directives"] = []
    told = explain_metric("mission.flown_share", by_hand.record(tables=by_hand.tables_of(rows)), by_hand.told_outcome())
    assert told.startswith(
        "left the air: drone 0 at 0.5 s (t), drone 1 at 1.5 s (t), drone 2 at 2.5 s (t) and 2 more; "
    )
    assert told.endswith("happened: 0.5 s landed, 1.5 s drone_lost, 2.5 s power_lost")
