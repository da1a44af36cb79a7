"""The fleet as a graph at a moment: drones as nodes, links as edges (`networkx`)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from sortie.scenarios.frames import instant, instants
from sortie.sim.folders import RunError
from sortie.sim.results import links
from sortie.sim.results.record import HANDSHAKE, SortieRecord

if TYPE_CHECKING:
    import networkx as nx

SENT_WITHIN_S = 1.0
"""An edge tells what was sent over it in this time before."""


def graph(record: SortieRecord, t_s: float) -> nx.DiGraph:
    """The fleet at a moment.

    Args:
        record: of a sortie, with the table `links`.
        t_s: the moment, s; from 0 to the sortie's end.

    Returns:
        Nodes are the drones in the air, with `position_m` (x, y, z, ENU), `soc`, `phase` (of the descriptor that it
        published last, None before the first) and `role` (`drone`, or `ground` for a ground station). Edges are the
        directed links within earshot, with `snr_db`, `goodput_mbps`, `loss` (share of the sender's descriptors that the
        receiver did not hear, NaN where there were none), `usable`, `state` (fresh, degraded or detached, as the sender's
        gate last took it; None before the first directive), and of the last second `sent` (representations) and `bytes`.

    Raises:
        RunError: the moment is outside the sortie, or the run is of a version without links.
    """
    import networkx as nx  # here, as in `sortie.radio.topology`

    scenario, tables = record.scenario, record.tables
    if not 0.0 <= t_s <= scenario.duration_s:
        raise RunError(f"t_s: {t_s:g}, must be 0 to {scenario.duration_s:g}, the length of the sortie")
    if links.TABLE not in tables:
        raise RunError("this run has no table links: an earlier version flew it, fly it again")
    states = rows_at(tables["states"], t_s)
    phases = {row["drone"]: row["phase"] for row in _latest(tables["descriptors"], t_s, ["drone"], ["phase"])}
    ground = {station.drone for station in scenario.fleet.ground}
    found = nx.DiGraph(scenario=scenario.name, t_s=t_s)
    for row in states.filter(states["airborne"]).to_pylist():
        drone = row["drone"]
        found.add_node(
            drone,
            position_m=(row["x_m"], row["y_m"], row["z_m"]),
            soc=row["soc"],
            phase=phases.get(drone),
            role="ground" if drone in ground else "drone",
        )
    state = {
        (r["drone"], r["peer"]): r["link"] for r in _latest(tables["directives"], t_s, ["drone", "peer"], ["link"])
    }
    sent = _sent(tables["transmissions"], t_s)
    for row in rows_at(tables[links.TABLE], t_s).to_pylist():
        ends = row["sender"], row["receiver"]
        if ends[0] in found and ends[1] in found:
            representations, size = sent.get(ends, ((), 0))
            found.add_edge(
                *ends,
                snr_db=row["snr_db"],
                goodput_mbps=row["goodput_mbps"],
                loss=1.0 - row["delivered"],
                usable=row["usable"],
                state=state.get(ends),
                sent=representations,
                bytes=size,
            )
    return found


def edges_of(rows: pa.Table) -> Iterator[tuple[int, int, float]]:
    """Sender, receiver and goodput, Mb/s, of the usable links among rows of `links`."""
    usable = rows.filter(rows["usable"])
    columns = (usable[name].to_pylist() for name in ("sender", "receiver", "goodput_mbps"))
    return zip(*columns, strict=True)


def rows_at(table: pa.Table, t_s: float) -> pa.Table:
    """The rows of the latest time that is not after `t_s`; of a table in order of time."""
    times_s = table["t_s"].to_numpy()
    end = int(np.searchsorted(instants(times_s), instant(t_s), side="right"))
    begin = int(np.searchsorted(times_s, times_s[end - 1], side="left")) if end else 0
    return table.slice(begin, end - begin)


def _latest(table: pa.Table, t_s: float, keys: list[str], columns: list[str]) -> list[dict[str, Any]]:
    """Each key's last row that is not after `t_s`."""
    before = table.filter(pa.array(instants(table["t_s"].to_numpy()) <= instant(t_s))).select([*keys, *columns])
    return list({tuple(row[key] for key in keys): row for row in before.to_pylist()}.values())


def _sent(transmissions: pa.Table, t_s: float) -> dict[tuple[int, int], tuple[tuple[str, ...], int]]:
    """What each link's sender handed to the radio in the last second: representations and bytes."""
    times_s = transmissions["t_sent_s"].to_numpy()
    within = (times_s > t_s - SENT_WITHIN_S) & (instants(times_s) <= instant(t_s))
    found: dict[tuple[int, int], tuple[tuple[str, ...], int]] = {}
    for row in transmissions.filter(pa.array(within)).to_pylist():
        if row["representation"] == HANDSHAKE:
            continue
        ends = row["drone"], row["peer"]
        kinds, size = found.get(ends, ((), 0))
        kinds = kinds if row["representation"] in kinds else (*kinds, row["representation"])
        found[ends] = kinds, size + row["payload_bytes"]
    return found
