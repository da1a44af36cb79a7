"""How the fleet hung together over its usable links, from the table `links`: every 10 s of the flight."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, shortest_path

from sortie.radio.topology import Connectivity, connectivity, usable_graph
from sortie.scenarios.disc import LISTED_IDS
from sortie.sim.results import links
from sortie.sim.results.graph import edges_of, rows_at
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.section import Amount, Count, Flown, Mbps, OutcomeSection, Seconds, Share, figure

SAMPLE_S = 10.0


class Bottleneck(OutcomeSection):
    sender: Count | None = figure("Whose link it is.")
    receiver: Count | None = figure("To whom.")
    mbps: Mbps | None = figure("What it would carry alone on the channel.")


class ConnectivityOutcome(OutcomeSection):
    """Null without links, and where fewer than two drones ever fly."""

    connected_share: Share | None = figure("Share of the moments at which all drones that fly reach each other.")
    partitioned_s: Seconds | None = figure("The rest of them, as time: for how long the fleet was in parts.")
    mean_hops: Amount | None = figure(
        "Links on the shortest route, mean over all pairs with one; above 200 drones over pairs from some 200 of them."
    )
    bottleneck: Bottleneck = figure(
        "The link that limited the worst-off connected pair, at worst. Null in fleets of more than 200 drones."
    )
    articulation: dict[str, Share] = figure(
        "Share of the moments at which the fleet, or its part, would fall apart without the drone; of drones with any."
    )

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, Any]:
        looks = list(_looks(flown.record)) if links.TABLE in flown.tables else []
        hops = [look.hops for look in looks if look.hops is not None]
        worst = min((look.bottleneck for look in looks if look.bottleneck), key=lambda edge: edge[2], default=None)
        share = sum(look.connected for look in looks) / len(looks) if looks else None
        cut_by = Counter(drone for look in looks for drone in look.articulation)
        return {
            "connected_share": share,
            "partitioned_s": None if share is None else (1.0 - share) * flown.scenario.duration_s,
            "mean_hops": sum(hops) / len(hops) if hops else None,
            "bottleneck": dict(zip(Bottleneck.model_fields, worst or (None, None, None), strict=True)),
            "articulation": {str(drone): cut_by[drone] / len(looks) for drone in sorted(cut_by)},
        }


def _looks(record: SortieRecord) -> Iterator[Connectivity]:
    states, table = record.tables["states"], record.tables[links.TABLE]
    for t_s in np.arange(0.0, record.scenario.duration_s, SAMPLE_S):
        frame, rows = rows_at(states, t_s), rows_at(table, t_s)
        flying: list[int] = frame.filter(frame["airborne"])["drone"].to_pylist()
        if 2 <= len(flying) <= LISTED_IDS:
            yield connectivity(usable_graph(flying, edges_of(rows)))
        elif len(flying) > LISTED_IDS:
            yield _of_large_fleet(flying, rows)


def _of_large_fleet(drones: list[int], rows: pa.Table) -> Connectivity:
    """By scipy: whether it is connected, and hops from some 200 drones; nothing that needs a look at each drone."""
    place = {drone: k for k, drone in enumerate(drones)}
    ends = [(place[a], place[b]) for a, b, _ in edges_of(rows) if a in place and b in place]
    at = np.array(ends, np.intp).reshape(-1, 2).T
    matrix = csr_array((np.ones(at.shape[1]), (at[0], at[1])), shape=(len(drones), len(drones)))
    groups, _ = connected_components(matrix, directed=True, connection="strong")
    sources = np.arange(0, len(drones), max(1, len(drones) // LISTED_IDS))
    lengths = shortest_path(matrix, unweighted=True, indices=sources)
    known = lengths[np.isfinite(lengths) & (lengths > 0)]
    return Connectivity(groups == 1, (), (), float(known.mean()) if len(known) else None, None)
