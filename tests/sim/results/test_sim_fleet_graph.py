"""The table of links, the fleet's graph at a moment, and the outcome's connectivity: they agree with what was heard."""

from __future__ import annotations

import functools
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

import sortie

JAM = {"kind": "jam", "at_s": 3, "position_m": [-235, 0, 62], "power_dbm": 18, "until_s": 9}
SHORT = {"duration_s": 12, "perception.detector": "none", "fleet.route.speed_mps": 1, "expect": []}


@functools.cache
def jammed() -> sortie.Run:
    """Five drones in a line; the jammer over them is on from 3 to 9 s, and drone 4 leaves the air at 10 s."""
    lost = {"kind": "drone_lost", "at_s": 10, "drone": 4}
    return sortie.fly("track_target", SHORT | {"fleet.formation.shape": "line", "events": [JAM, lost]})


def test_links_count_the_descriptors_that_receptions_count() -> None:
    run = jammed()
    links = run.tables["links"].to_pandas()
    published = run.tables["descriptors"].to_pandas()
    heard = 0
    for _, row in links[links.t_s > 0].iterrows():
        age_s = row.t_s - published.t_s
        mine = published[(published.drone == row.sender) & (age_s > 1e-6) & (age_s < 1 + 1e-6)]
        heard += round(row.delivered * len(mine)) if len(mine) else 0
    receptions = run.tables["receptions"].to_pandas()
    assert heard == receptions[receptions.t_s < links.t_s.max() - 1e-6].heard.sum()


def test_a_jammer_shows_in_links_graph_and_connectivity() -> None:
    run = jammed()
    links = run.tables["links"].to_pandas()
    calm, loud = links[links.t_s == 2.0], links[(links.t_s > 4) & (links.t_s < 9)]
    assert calm.usable.all()
    assert loud.snr_db.max() < calm.snr_db.min()
    assert loud.usable.sum() < 4 * len(calm) / 2  # of the four seconds
    assert loud.delivered.mean() < 0.5 < calm.delivered.min()
    assert run.graph(2.0).number_of_edges() == 20
    assert run.graph(6.0).number_of_edges() < 20


def test_a_graph_has_drones_in_the_air_and_what_they_sent() -> None:
    graph = jammed().graph(2.5)
    assert isinstance(graph, nx.DiGraph)
    states = jammed().tables["states"].to_pandas()
    (row,) = states[np.isclose(states.t_s, 2.5) & (states.drone == 2)].itertuples()
    assert graph.nodes[2] == {
        "position_m": (row.x_m, row.y_m, row.z_m),
        "soc": row.soc,
        "phase": "search",
        "role": "drone",
    }
    sent = jammed().tables["transmissions"].to_pandas()
    within = sent[(sent.t_sent_s > 1.5) & (sent.t_sent_s <= 2.5) & (sent.representation != "handshake")]
    assert sum(size for *_, size in graph.edges(data="bytes")) == within.payload_bytes.sum() > 0
    assert graph.edges[0, 1]["state"] == "fresh"
    assert sorted(jammed().graph(11.5)) == [0, 1, 2, 3]


def test_connectivity_is_looked_at_every_ten_seconds() -> None:
    """At 0 s and at 10 s, when the jam is over and drone 4 is still there or gone: all reach all."""
    found = jammed().outcome["connectivity"]
    assert (found["connected_share"], found["partitioned_s"]) == (1.0, 0.0)
    assert found["mean_hops"] == 1.0
    assert found["articulation"] == {}
    usable = [jammed().graph(t_s).edges[edge] for t_s in (0.0, 10.0) for edge in jammed().graph(t_s).edges]
    assert found["bottleneck"]["mbps"] >= min(edge["goodput_mbps"] for edge in usable)


def test_a_run_from_a_folder_has_the_same_graph(tmp_path: Path) -> None:
    read = sortie.open_run(jammed().save(tmp_path / "a", recording=False))
    assert nx.utils.graphs_equal(read.graph(2.5), jammed().graph(2.5))
    (tmp_path / "a" / "links.parquet").unlink()  # as in a run of 0.2.0
    old = sortie.open_run(tmp_path / "a")
    with pytest.raises(sortie.RunError, match="no table links: an earlier version flew it"):
        old.graph(2.5)


def test_a_moment_outside_the_flight_is_told() -> None:
    with pytest.raises(sortie.RunError, match=r"t_s: 12\.5, must be 0 to 12, the length"):
        jammed().graph(12.5)
