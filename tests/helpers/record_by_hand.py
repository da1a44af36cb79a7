"""A record of a few rows, which tests of the outcome and of everything made of records work out by hand.

Two drones fly four frames of a second each: `search` for two seconds, then `track` about the origin. Drone 1 is gone from
3 s on. A comment beside each group of rows says what follows from it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pyarrow as pa

from sortie.scenarios.reading.load import loads
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import TABLES, SortieRecord

SCENARIO = """
name: by_hand
duration_s: 4
fleet: {drones: 2}
context: {rate_hz: 1}
mission:
  phases:
    - {at_s: 0, phase: search}
    - {at_s: 2, phase: track, region: {centre_m: [0, 0], radius_m: 10}}
perception: {detector: surrogate, sample_rate_hz: 1}
"""
NAN = math.nan
CAR = {"length_m": 4.5, "width_m": 1.9, "yaw_rad": 0.3}
LEVEL = {"z_m": 60.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
FAR_M = 5000.0


def rows() -> dict[str, list[dict[str, Any]]]:
    return {
        # drone 0 stands over the region, and is far off in the last frame; drone 1 is far off throughout
        "states": [
            {
                "t_s": float(k), "drone": d, **LEVEL, "x_m": FAR_M if d or k == 3 else 0.0, "y_m": 0.0, "looks": k,
                "airborne": not (d == 1 and k == 3), "soc": 0.9 - 0.1 * d - 0.01 * k, "voltage_v": 16.0 - k,
            }
            for k in range(4)
            for d in range(2)
        ],
        "mission": [
            {
                "t_s": float(k), "group": 0, "phase": "search" if k < 2 else "track", "target": -1, "target_x_m": NAN,
                "target_y_m": NAN, "region_x_m": NAN if k < 2 else 0.0, "region_y_m": NAN if k < 2 else 0.0,
                "region_radius_m": NAN if k < 2 else 10.0,
            }
            for k in range(4)
        ],
        "energy": [
            {"drone": d, "cause": cause, "energy_j": j}
            for d, cause, j in ((0, "rotor", 100.0), (1, "rotor", 50.0), (0, "radio", 5.0), (1, "fault", 20.0))
        ],
        # captured, sent, what, bytes, fate: by capture the first three belong to the search, though the third was sent later
        "transmissions": [
            {
                "captured_s": captured, "t_sent_s": sent, "drone": 0, "peer": 1, "representation": what,
                "payload_bytes": size, "status": status, "reason": reason, "arrived_bytes": arrived,
            }
            for captured, sent, what, size, status, reason, arrived in (
                (0.0, 0.1, "features", 1000, "delivered", "", 1000),
                (0.1, 0.2, "features", 3000, "lost", "fragment_lost", 0),
                (1.95, 2.05, "detections", 500, "expired", "deadline_queued", 0),
                (2.2, 2.3, "features", 2000, "partial", "deadline_in_service", 1200),
                (2.5, 2.6, "handshake", 100, "delivered", "", 100),
                (3.8, 3.9, "features", 4000, "in_flight", "", 0),
            )
        ],
        "receptions": [
            {"t_s": 0.0, "heard": 3, "collision_context": 1},
            {"t_s": 1.0, "heard": 2, "weak_signal": 2},
            {"t_s": 2.0, "heard": 1, "hidden": 1},
            {"t_s": 3.0, "heard": 0, "half_duplex": 1},
        ],
        "ages": [{"t_s": 1.0, "drone": 0, "age_s": age_s} for age_s in (0.8, 0.2, 0.6, 0.4)],
        "fusions": [
            {
                "t_s": t_s, "drone": d, "peers": [1 - d] * len(ages), "representations": ["features"] * len(ages),
                "ages_s": ages, "weights": [1.0] * len(ages), "detections": found, "truths": there,
            }
            for t_s, d, ages, found, there in (
                (0.5, 0, [0.1], 2, 2),
                (2.5, 0, [0.2, 0.4], 1, 2),
                (2.5, 1, [], 0, 1),
                (3.5, 0, [0.3], 1, 1),
            )
        ],
        "truths": [
            {"t_s": t_s, "drone": d, "x_m": x_m, "y_m": 0.0, **CAR, "car": car}
            for t_s, d, x_m, car in (
                (0.5, 0, 0.0, 0), (0.5, 0, 30.0, 1),
                (2.5, 0, 2.0, 0), (2.5, 0, 40.0, 1),
                (2.5, 1, 2.0, 0),
                (3.5, 0, 3.0, 0),
                (3.5, 1, 3.0, 0),  # of the drone that is gone: no fusion
            )
        ],
        "detections": [
            {"t_s": t_s, "drone": 0, "x_m": x_m, "y_m": 0.0, **CAR, "score": score}
            for t_s, x_m, score in ((0.5, 0.0, 0.9), (0.5, 60.0, 0.8), (2.5, 2.0, 0.7), (3.5, 3.0, 0.6))
        ],
        # the second differs from the first by the place of its disc alone
        "directives": [
            {
                "t_s": t_s, "drone": 0, "peer": 1, "representation": what, "rho": rho, "roi_x_m": x_m, "roi_y_m": 0.0,
                "roi_radius_m": 10.0, "rate_hz": rate, "reason": reason,
            }
            for t_s, what, rho, x_m, rate, reason in (
                (0.5, "features", 0.25, 0.0, 10.0, "a"),
                (1.5, "features", 0.25, 5.0, 10.0, "b"),
                (2.5, "detections", 0.0, 5.0, 2.0, "c"),
            )
        ],
        "trust": [
            {"t_s": 1.0, "drone": 0, "peer": 1, "trust": 0.5, "reason": "x"},
            {"t_s": 2.0, "drone": 0, "peer": 1, "trust": 1.0, "reason": "x"},
            {"t_s": 2.0, "drone": 1, "peer": 0, "trust": 1.0, "reason": ""},
        ],
        "drops": [{"t_s": 1.0, "receiver": 0, "reason": r} for r in ("replay", "replay", "bad_tag")],
    }  # fmt: skip


def tables_of(given: dict[str, list[dict[str, Any]]]) -> dict[str, pa.Table]:
    """All tables of these rows; cells that no row names are zeros."""
    zero = {pa.string(): "", pa.bool_(): False, pa.binary(): b""}
    return {
        name: pa.table({c: pa.array([r.get(c, zero.get(t, [] if pa.types.is_list(t) else 0)) for r in given.get(name, [])], t) for c, t in columns.items()})
        for name, columns in TABLES.items()
    }  # fmt: skip


def record(**changes: Any) -> SortieRecord:
    """The rows as a record."""
    tables = tables_of(rows())
    totals = {
        "context_descriptor_bytes": 700, "context_directive_bytes": 108, "medium_busy_fraction": 0.125,
        "policy_changes": 0, "shield_interventions": 0, "invariant_violations": 0, "violated_ticks": 0,
        "decisions_of worked": 8,
        **{f"violations_of {c}": 0 for c in ("policy", "staleness", "damping", "no peer")},
    }  # fmt: skip
    made = SortieRecord(loads(SCENARIO), "worked", 1, 0, "0", "surrogate", tables, totals, wall={"wall_s": 2.0})
    return replace(made, **changes)


def told_outcome(off: float = 0.0) -> dict[str, Any]:
    """The outcome of the record, with a number of its own in every place, so that no figure passes for another.

    Args:
        off: added to every share, in hundredths: another sortie's outcome.
    """
    share, k = off / 100, 1 + off
    made = outcome(record())
    context = {
        "collision_context": 0.03,
        "collision_data": 0.05,
        "hidden": 0.01,
        "weak_signal": 0.0,
        "half_duplex": 0.02,
    }
    made |= {
        "ap50": made["ap50"] | {
            "full_scene": 0.401 + share, "mission": 0.502 + share, "sample_rate_hz": 2.0, "scored_fusions": 17,
            "calibration": "abc", "grounded_blind": {"full_scene": 0.303 + share, "mission": 0.204 + share},
        },
        "ap_by_class": {
            "car": {"full_scene": 0.401, "mission": 0.502}, "truck": {"full_scene": 0.601 + share, "mission": 0.602},
            "person": {"full_scene": 0.701 + share, "mission": None},
        },
        "mission": {
            "flown_share": 0.911 + share, "region_observed_share": 0.812, "target_in_view_share": 0.713,
            "target_longest_out_of_view_s": 1.25, "target_detected_share": 0.614, "target_longest_undetected_s": 2.75,
        },
        "people": made["people"] | {"located_share": 0.315 + share, "located_alone_share": 0.216},
        "bytes": {
            "context_sent": 1100 * k, "context_descriptors": 900, "context_directives": 200, "data_sent": 22_000 * k,
            "handshakes_sent": 330 * k, "data_delivered": 14_000 * k, "data_lost": 5000, "data_expired": 2600, "data_in_flight": 400,
        },
        "context": {"lost": 0.111 + share, "lost_to": context},
        "context_share": 0.0476, "deadline_miss_rate": 0.122 + share, "medium_busy_fraction": 0.133 + share,
        "age_s": {"p50": 0.141, "p99": 0.452}, "data_age_s": {"p50": 0.263 + share, "p99": 0.574},
        "energy_j": {"rotor": 8100.0, "radio": 1200.0 * k, "compute": 2300.0 * k, "fault": 0.0, "total": 11_600.0 * k},
        "battery": {"0": 0.91, "1": 0.62 + share, "2": 0.73},
        "drones": {
            "0": {"soc": 0.91, "voltage_v": 15.25, "airborne": True, "energy_j": 4400.0, "ap50": {"full_scene": 0.41, "mission": 0.62}},
            "1": {"soc": 0.62, "voltage_v": 14.5, "airborne": False, "energy_j": 7200.0, "ap50": {"full_scene": 0.43, "mission": None}},
            "2": {"soc": 0.73, "voltage_v": 13.75, "airborne": True, "energy_j": 0.0, "ap50": {"full_scene": None, "mission": None}},
        },
        "switches": 3.25, "policy_eval_us": {"p50": 21.0, "p99": 83.0}, "wall_s": 1.6, "realtime_factor": 2.5,
        "own_files": {"own.py": "f00d"}, "fingerprint": "0123456789abcdef" * 4,
        "payload_fates": {"delivered": 6, "lost/retries": 1, "expired/deadline_queued": 3},
        "disagreement": {
            "share": 0.044, "sends_share": 0.033, "episodes": 12, "mean_s": 0.25, "p99_s": 0.75, "longest_s": 1.5,
            "causes": {"roster": 0.0, "trust": 0.1, "values": 0.0, "descriptor": 0.3, "age": 0.6},
        },
    }  # fmt: skip
    return made
