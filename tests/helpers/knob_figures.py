"""Figures of a record that knobs of a scenario move; `knobs` has which knob moves which."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sortie.fleet.coverage import unpack_grid
from sortie.sim.results.record import SortieRecord

Array = np.ndarray[Any, Any]


def _columns(record: SortieRecord, table: str, *names: str) -> list[Array]:
    return [record.tables[table][n].to_numpy(zero_copy_only=False) for n in names]


def _states(record: SortieRecord, name: str) -> Array:
    """[T, N]"""
    return np.reshape(_columns(record, "states", name)[0], (-1, record.scenario.fleet.drones)).astype(float)


def _energy(record: SortieRecord, cause: str | None = None, drone: int | None = None) -> float:
    rows = record.tables["energy"].to_pylist()
    return sum(r["energy_j"] for r in rows if cause in (None, r["cause"]) and drone in (None, r["drone"]))


def _sent(record: SortieRecord, column: str, *, drone: int | None = None, features: bool = False) -> float:
    """The mean over payloads, of one drone or of feature maps alone."""
    values, who, what = _columns(record, "transmissions", column, "drone", "representation")
    some = (who == drone if drone is not None else np.ones(len(who), bool)) & ((what == "features") | (not features))
    return float(np.nanmean(values[some])) if some.any() else 0.0


def _delivered(record: SortieRecord) -> Array:
    return np.asarray(_columns(record, "transmissions", "status")[0] == "delivered")


def _link(record: SortieRecord, link: str) -> float:
    """When a gate first called the link to drone 1, which is lost at 1 s, degraded or detached."""
    t_s, peer, state = _columns(record, "directives", "t_s", "peer", "link")
    return float(t_s[(peer == 1) & (state == link) & (t_s > 1.0)].min())


def _descriptor(record: SortieRecord, column: str, drone: int | None = None) -> float:
    values, who, t_s = _columns(record, "descriptors", column, "drone", "t_s")
    return float(values[(t_s > 1.0) & ((who == drone) if drone is not None else True)].mean())


def _cells(record: SortieRecord, least: int, drone: int | None = None) -> float:
    """Cells of the coverage grid seen at least so well, per descriptor."""
    rows = zip(*(record.tables["descriptors"][c].to_pylist() for c in ("coverage_grid", "drone")), strict=True)
    return float(np.mean([(unpack_grid(grid) >= least).sum() for grid, who in rows if drone in (None, who)]))


def _closest(record: SortieRecord) -> float:
    at = np.stack([_states(record, c) for c in ("x_m", "y_m")], axis=-1)
    apart = np.linalg.norm(at[:, :, None] - at[:, None], axis=-1)
    return float(apart[:, ~np.eye(at.shape[1], dtype=bool)].min())


def _region(record: SortieRecord, column: str, group: int | None = None) -> Array:
    values, of = _columns(record, "mission", column, "group")
    values = values[of == group] if group is not None else values
    return values[~np.isnan(values)]


def _tracking(record: SortieRecord) -> float:
    return float(np.mean(_columns(record, "mission", "phase")[0] == "track"))


def _repair_s(record: SortieRecord) -> float:
    """Time from the first service to the end, for each round of repairs."""
    begin_s, end_s, repairs = _columns(record, "transmissions", "t_start_s", "t_done_s", "repairs")
    some = (repairs > 0) & _delivered(record)
    return float(((end_s - begin_s)[some] / repairs[some]).mean())


def _stamp_error_s(record: SortieRecord) -> float:
    t_s, stamp = _columns(record, "descriptors", "t_s", "stamp_ns")
    return float(np.abs(stamp * 1e-9 - t_s).mean())


def _heard(record: SortieRecord) -> float:
    every = {c: float(_columns(record, "receptions", c)[0].sum()) for c in record.tables["receptions"].column_names[1:]}
    return every["heard"] / sum(every.values())


def _sighting_error_m(record: SortieRecord) -> float:
    """Of the only person's sightings."""
    t_s, x, y, who = _columns(record, "sightings", "t_s", "x_m", "y_m", "person")
    at_s, px, py = _columns(record, "people", "t_s", "x_m", "y_m")
    k = np.searchsorted(at_s, t_s[who == 0] - 1e-6)
    return float(np.hypot(x[who == 0] - px[k], y[who == 0] - py[k]).mean())


def _snr(record: SortieRecord, *ends: int) -> float:
    snr, a, b = _columns(record, "transmissions", "snr_db", "drone", "peer")
    some = np.isin(a, ends) | np.isin(b, ends) if ends else np.ones(len(a), bool)
    return float(np.nanmean(snr[some]))


def _first_features_s(record: SortieRecord) -> float:
    t_s, what = _columns(record, "transmissions", "t_sent_s", "representation")
    return float(t_s[what == "features"].min())


def _count(table: str, **where: Any) -> Callable[[SortieRecord], float]:
    def count(record: SortieRecord) -> float:
        rows = record.tables[table].to_pylist()
        return sum(all(r[k] == v for k, v in where.items()) for r in rows)

    return count


def _list_mean(column: str, of: Callable[[list[float]], float]) -> Callable[[SortieRecord], float]:
    return lambda record: float(np.mean([of(v) for v in record.tables["fusions"][column].to_pylist()]))


FIGURES: dict[str, Callable[[SortieRecord], float]] = {
    **{
        cause: lambda r, cause=cause: _energy(r, cause)  # type: ignore[misc]
        for cause in ("rotor", "avionics", "compute", "radio", "ohmic")
    },
    "rotor of 1": lambda r: _energy(r, "rotor", 1),
    "ohmic of 1": lambda r: _energy(r, "ohmic", 1),
    "charge": lambda r: float(_states(r, "soc")[-1].mean()),
    "charge of 1": lambda r: float(_states(r, "soc")[-1, 1]),
    "voltage": lambda r: float(_states(r, "voltage_v")[-1].mean()),
    "flying": lambda r: float(_states(r, "airborne").mean()),
    "ground speed": lambda r: float(np.hypot(_states(r, "vx_mps"), _states(r, "vy_mps")).mean()),
    "height": lambda r: float(_states(r, "z_m").mean()),
    "height of 1": lambda r: float(_states(r, "z_m")[:, 1].mean()),
    "height's spread": lambda r: float(_states(r, "z_m").std()),
    "vertical speed": lambda r: float(np.abs(_states(r, "vz_mps")).mean()),
    "north": lambda r: float(_states(r, "y_m").mean()),
    "farthest north": lambda r: float(_states(r, "y_m").max()),
    "distance to drone 0": lambda r: float(
        np.hypot(*(_states(r, c)[0, 1:] - _states(r, c)[0, :1] for c in ("x_m", "y_m"))).mean()
    ),
    "closest pair": _closest,
    "rates of roll and pitch": lambda r: float(np.hypot(_states(r, "p_radps"), _states(r, "q_radps")).mean()),
    "fastest turn": lambda r: float(np.sort(np.abs(_states(r, "r_radps")), axis=0)[-5:].mean()),
    "error of stamps": _stamp_error_s,
    "descriptors": lambda r: float(r.tables["descriptors"].num_rows),
    "descriptor's bytes": lambda r: _descriptor(r, "wire_bytes"),
    "processor left": lambda r: _descriptor(r, "cpu_headroom"),
    "processor left of 1": lambda r: _descriptor(r, "cpu_headroom", 1),
    "accelerator left": lambda r: _descriptor(r, "gpu_headroom"),
    "cells seen": lambda r: _cells(r, 1),
    "cells seen by 1": lambda r: _cells(r, 1, 1),
    "cells seen well": lambda r: _cells(r, 2),
    "descriptors heard": _heard,
    "drops": _count("drops"),
    "doubts": _count("trust"),
    "payloads of 1": _count("transmissions", drone=1),
    "cells sent": lambda r: _sent(r, "cells", features=True),
    "payload's bytes": lambda r: _sent(r, "payload_bytes", features=True),
    "codes' bytes": lambda r: _sent(r, "payload_bytes"),
    "fragments": lambda r: _sent(r, "fragments"),
    "airtime": lambda r: _sent(r, "airtime_s", features=True),
    "hops": lambda r: _sent(r, "hops"),
    "mcs": lambda r: _sent(r, "mcs"),
    "time from look to sending": lambda r: _sent(r, "t_sent_s") - _sent(r, "captured_s"),
    "time from look to sending of 1": lambda r: _sent(r, "t_sent_s", drone=1) - _sent(r, "captured_s", drone=1),
    "delivered": lambda r: float(_delivered(r).mean()),
    "wait for a repair": _repair_s,
    "snr": _snr,
    "snr at 1": lambda r: _snr(r, 1),
    "snr from 1": lambda r: _sent(r, "snr_db", drone=1),
    "snr's spread": lambda r: float(np.nanstd(_columns(r, "transmissions", "snr_db")[0])),
    "first features": _first_features_s,
    "degraded at": lambda r: _link(r, "degraded"),
    "detached at": lambda r: _link(r, "detached"),
    "tracking": _tracking,
    "region's radius": lambda r: float(_region(r, "region_radius_m").mean()),
    "region's east": lambda r: float(_region(r, "region_x_m").mean()),
    "region's north": lambda r: float(_region(r, "region_y_m").mean()),
    "region's east of group 1": lambda r: float(_region(r, "region_x_m", 1).mean()),
    "region's north of group 1": lambda r: float(_region(r, "region_y_m", 1).mean()),
    "region's way of group 1": lambda r: float(np.ptp(_region(r, "region_x_m", 1))),
    "longest move": lambda r: max(
        float(e["text"].split()[1]) for e in r.tables["events"].to_pylist() if e["text"].startswith("moves ")
    ),
    "going home": _count("events", kind="drone_leaves"),
    "people's east": lambda r: float(_columns(r, "people", "x_m")[0].mean()),
    "people's north": lambda r: float(_columns(r, "people", "y_m")[0].mean()),
    "people found": _count("sightings", person=0),
    "false alarms": _count("sightings", person=-1),
    "error of sightings": _sighting_error_m,
    "decisions of worst-2": lambda r: (
        r.totals.get("decisions_of worst-2", 0.0) + r.totals.get("decisions_of worst-2(received_budget=0.1)", 0.0)
    ),
    "violations": lambda r: r.totals["invariant_violations"],
    "interventions": lambda r: r.totals["shield_interventions"],
    "detections": lambda r: float(r.tables["detections"].num_rows),
    "truths": lambda r: float(r.tables["truths"].num_rows),
    "fusions": lambda r: float(r.tables["fusions"].num_rows),
    "peers fused": _list_mean("peers", len),
    "age at fusion": lambda r: float(np.mean(np.concatenate(r.tables["fusions"]["ages_s"].to_pylist()))),
}


def figure(name: str, record: SortieRecord) -> float:
    """A figure of a record by its name."""
    return FIGURES[name](record)
