"""Links in a playback: arrows of their traffic and goodput, crossings of those that are gone, and what peers sent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from played_flight import Kept, Rows, drawn, flown, with_tables
from record_by_hand import tables_of

from sortie.perception.budget import CELL_M
from sortie.scenarios.link_state import SILENT_MBPS
from sortie.sim.playback.canvas import packed
from sortie.sim.playback.links import BROKEN_MBPS, LinkArrows
from sortie.sim.playback.received import hatch
from sortie.sim.results import palette
from sortie.sim.results.link_traffic import LinkTraffic
from sortie.sim.results.palette import goodput_colours
from sortie.sim.results.record import SortieRecord


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    return flown()


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    return drawn(flown(), tmp_path_factory.mktemp("rrd"))


# --- traffic ----------------------------------------------------------------------------------------------


def test_a_frame_has_what_was_said_and_settled_before_it() -> None:
    """What is published or settled at its very instant is the next frame's; traffic is of the second before."""
    said = {"t_s": [0.0, 1.0], "drone": [0, 0], "goodput_mbps": [[5.0], [7.0]]}
    settled = {"t_done_s": [0.0, 1.0], "drone": [0, 0], "peer": [1, 1], "payload_bytes": [125_000, 250_000]}
    t_s, tables = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5]), (pa.table(said), pa.table(settled))
    goodput, recent = LinkTraffic(2, 2.0).add(t_s, *tables)
    assert goodput[:, 0, 1].tolist() == [0.0, 5.0, 5.0, 7.0, 7.0, 7.0]
    assert recent[:, 0, 1].tolist() == [0.0, 1.0, 1.0, 2.0, 2.0, 0.0]
    assert not goodput[:, 1, 0].any()


def test_traffic_at_rates_that_do_not_divide_a_second() -> None:
    """Mb/s over as many whole frames as come nearest to a second: 2 s at 0.5 Hz, 1.33 s at 1.5 Hz."""
    done_s, size = [0.5, 2.5, 3.0], [125_000, 250_000, 500_000]
    settled = {"t_done_s": done_s, "drone": [0] * 3, "peer": [1] * 3, "payload_bytes": size}
    said = {"t_s": [0.0], "drone": [0], "goodput_mbps": [[5.0]]}
    for rate_hz, window_s in ((0.5, 2.0), (1.5, 4 / 3)):
        t_s = np.arange(7) / rate_hz
        _, recent = LinkTraffic(2, rate_hz).add(t_s, pa.table(said), pa.table(settled))
        within = (t_s[:, None] - window_s <= done_s) & (done_s < t_s[:, None])
        assert recent[:, 0, 1] == pytest.approx(within @ np.array(size) * 8e-6 / window_s)
        assert recent[1, 0, 1] > 0


def test_goodput_runs_from_red_by_yellow_to_green() -> None:
    colours = goodput_colours(np.array([0.0, SILENT_MBPS, 1.0, 10.0, 100.0, 1000.0]))[:, :2].tolist()
    assert colours == [[185, 190], [255, 45], [255, 45], [255, 230], [50, 230], [50, 230]]


# --- arrows by hand ---------------------------------------------------------------------------------------


Goodput = list[list[float]]
Payloads = Sequence[tuple[int, int, int]]


def arrows(n: int, goodput: Goodput, up: list[bool], sent: Payloads = ()) -> Kept:
    """Drones 100 m apart on a line, for a second; each has said its goodput, and payloads came to an end at 0.5 s."""
    kept = Kept()
    links = LinkArrows(kept, n, 10.0)  # type: ignore[arg-type]
    tables = {
        "descriptors": [{"t_s": 0.1, "drone": d, "goodput_mbps": goodput[d]} for d in range(n)],
        "transmissions": [{"t_done_s": 0.5, "drone": a, "peer": b, "payload_bytes": size} for a, b, size in sent],
    }
    position = np.array([[(100.0 * d, 0.0, 60.0) for d in range(n)]] * 11)
    links.add(np.arange(11) / 10, position, np.array([up] * 11), tables_of(tables))
    return kept


def last_arrows(kept: Kept) -> dict[tuple[int, int], tuple[int, float]]:
    """Colour and radius by sender and receiver, of the last frame."""
    names = ("origins", "vectors", "colors", "radii")
    origins, vectors, colours, radii = (kept.rows[f"world/links {name}"][-1][1] for name in names)
    found = {}
    for origin, vector, colour, radius in zip(origins, vectors, colours, radii, strict=True):
        step = 1 if vector[0] > 0 else -1
        sender = round((origin[0] - 3.5 * step) / 100)
        found[sender, round((origin[0] + vector[0] + 3.5 * step) / 100)] = (colour, radius)
    return found


def test_an_arrow_is_as_green_as_its_own_direction_and_as_wide_as_its_traffic() -> None:
    kept = arrows(2, [[100.0], [1.0]], [True, True], [(0, 1, 125_000), (1, 0, 375_000)])
    found = last_arrows(kept)
    for (sender, receiver), mbps, goodput in (((0, 1), 1.0, 100.0), ((1, 0), 3.0, 1.0)):
        colour, radius = found[sender, receiver]
        assert colour == int(packed(palette.goodput_colours(np.array([goodput])))[0])
        assert radius == pytest.approx(-(1.5 + math.log2(1.0 + mbps)))
    idle = last_arrows(arrows(2, [[100.0], [1.0]], [True, True]))
    assert idle == {
        pair: (int(packed(np.array([palette.IDLE], np.uint8))[0]), pytest.approx(-0.75)) for pair in ((0, 1), (1, 0))
    }


def test_links_are_between_those_in_the_air() -> None:
    assert set(last_arrows(arrows(3, [[9.0, 9.0]] * 3, [True, False, True]))) == {(0, 2), (2, 0)}


def test_large_fleets_show_what_carries_something_alone() -> None:
    shown = {n: len(last_arrows(arrows(n, [[9.0] * (n - 1)] * n, [True] * n, [(0, 1, 1000)]))) for n in (8, 9)}
    assert shown == {8: 56, 9: 1}


def test_a_pair_is_crossed_out_by_either_direction_and_not_before_anything_was_tried() -> None:
    weak = BROKEN_MBPS / 2

    def crosses(goodput: list[list[float]], up: list[bool]) -> int:
        shown = arrows(3, goodput, up).rows.get("world/broken strips", [(0.0, [])])
        return len(shown[-1][1]) // 4

    fine, unknown = [9.0, 9.0], [0.0, 0.0]
    assert crosses([fine, fine, fine], [True] * 3) == 0
    assert crosses([[weak, 9.0], fine, fine], [True] * 3) == 1
    assert crosses([fine, [weak, 9.0], fine], [True] * 3) == 1, "what drone 1 says of drone 0"
    assert crosses([[SILENT_MBPS, 9.0], fine, fine], [True] * 3) == 1
    assert crosses([unknown, unknown, unknown], [True] * 3) == 0
    assert crosses([[weak, 9.0], fine, fine], [True, False, True]) == 0
    assert crosses([[weak, 9.0], fine, fine], [False, True, True]) == 0


# --- what peers sent --------------------------------------------------------------------------------------


def test_what_peers_sent_is_hatched_cell_by_cell(rows: Rows, record: SortieRecord) -> None:
    """As many cells as the payload carried, all in its region and in the sender's grid; wiped out a second later."""
    sent = [
        t
        for t in record.tables["transmissions"].to_pylist()
        if (t["representation"], t["status"]) == ("features", "delivered")
    ]
    regions, checked = record.tables["directives"].to_pylist(), 0
    for ego, peer in ((0, 1), (1, 0), (3, 4)):
        of_link = [t for t in sent if (t["drone"], t["peer"]) == (peer, ego)]
        asked = [d for d in regions if (d["drone"], d["peer"]) == (peer, ego)]
        drawn = rows[f"/world/received/{ego}/{peer}/cells"]
        shapes = zip(*(drawn.get(f"Boxes3D:{k}", []) for k in ("centers", "half_sizes")), strict=True)
        for (t_s, _, centres), (_, _, halves) in shapes:
            came = [t for t in of_link if t_s - 1.0 <= t["t_done_s"] < t_s]
            if not centres:
                assert not came or max(came, key=lambda t: t["t_done_s"])["captured_s"] < 3.0
                continue
            last = max(came, key=lambda t: t["t_done_s"])
            cells = sum(round(2 * half[1] / CELL_M) for half in halves)
            assert abs(cells - last["cells"]) <= 12  # the sender reckoned with its own estimate of where it was
            disc = [d for d in asked if d["t_s"] <= last["t_sent_s"]][-1]
            away = [math.hypot(c[0] - disc["roi_x_m"], c[1] - disc["roi_y_m"]) for c in centres]
            assert max(away) <= disc["roi_radius_m"] + CELL_M
            checked += 1
    assert checked >= 5
    whole = rows["/world/received/0/1/whole_map"]["LineStrips3D:strips"]
    assert whole
    assert {len(v) for _, _, v in whole} <= {0, 1}


def test_of_a_payload_that_came_in_part_as_much_is_drawn_as_came(record: SortieRecord, tmp_path: Path) -> None:
    """By area: rows of cells in a region, the square of a whole map."""
    whole, share = record.tables["transmissions"], 0.4
    came = pc.equal(whole["status"], "delivered")
    arrived = pc.cast(pc.multiply(whole["payload_bytes"], share), whole.schema.field("arrived_bytes").type, safe=False)
    changed = {
        "status": pc.if_else(came, "partial", whole["status"]),
        "reason": pc.if_else(came, "fragment_lost", whole["reason"]),
        "arrived_bytes": arrived,
    }
    partial = whole
    for name, column in changed.items():
        partial = partial.set_column(whole.schema.get_field_index(name), name, column)
    parts, full = (drawn(each, tmp_path) for each in (with_tables(record, transmissions=partial), record))
    seen = {"cells": 0, "whole_map": 0}
    for ego, peer in ((i, j) for i in range(5) for j in range(5) if i != j):
        path = f"/world/received/{ego}/{peer}"
        for name, what in (("cells", "Boxes3D:half_sizes"), ("whole_map", "LineStrips3D:strips")):
            at = {t_s: shapes for t_s, _, shapes in full[f"{path}/{name}"].get(what, [])}
            for t_s, _, shapes in parts[f"{path}/{name}"].get(what, []):
                if not shapes:
                    continue
                seen[name] += 1
                if name == "cells":
                    part, all_of = (sum(2 * half[1] for half in each) / CELL_M for each in (shapes, at[t_s]))
                    assert part == pytest.approx(share * all_of, abs=12)
                else:
                    side_m = math.dist(*shapes[0][:2]) + 2 * 1.2 * peer
                    assert (side_m / (64 * CELL_M)) ** 2 == pytest.approx(share, abs=1e-3)
    assert min(seen.values()) > 0


def test_a_hatch_covers_exactly_the_cells_of_the_region() -> None:
    """Against every cell's centre, turned and moved by hand; a turned sender's runs lie along its own left."""
    pose, region = (10.0, -20.0, 0.7), (25.0, -10.0, 32.0)
    runs = hatch(region, pose, 1)
    centres = (np.arange(64) - 31.5) * CELL_M
    forward, left = np.meshgrid(centres, centres, indexing="ij")
    x = pose[0] + math.cos(0.7) * forward - math.sin(0.7) * left
    y = pose[1] + math.sin(0.7) * forward + math.cos(0.7) * left
    inside = np.hypot(x - region[0], y - region[1]) <= 32.0
    assert runs[:, 4].sum() == inside.sum() == pytest.approx(math.pi * 32.0**2 / CELL_M**2, rel=0.03)
    assert (runs[:, 2] * 2 / CELL_M).tolist() == pytest.approx(inside.sum(axis=1)[inside.any(axis=1)].tolist())
    middle = [float(np.mean(left[i][inside[i]])) for i in np.flatnonzero(inside.any(axis=1))]
    own = -math.sin(0.7) * (runs[:, 0] - pose[0]) + math.cos(0.7) * (runs[:, 1] - pose[1])
    assert own.tolist() == pytest.approx(middle, abs=1e-9)
    ahead = math.cos(0.7) * (runs[:, 0] - pose[0]) + math.sin(0.7) * (runs[:, 1] - pose[1])
    strip = (1.5 / 4 - 0.5) * CELL_M  # the second of four strips, from the cell's centre
    assert ahead.tolist() == pytest.approx((centres[inside.any(axis=1)] + strip).tolist(), abs=1e-9)


def test_the_matrix_has_what_the_table_of_links_has(rows: Rows, record: SortieRecord) -> None:
    links = record.tables["links"].to_pandas()
    pictures = {
        t_s: np.frombuffer(bytes(v[0]), np.uint8).reshape(5, 5, 4) for t_s, _, v in rows["/links/heard"]["Image:buffer"]
    }
    assert sorted(pictures) == sorted(links.t_s.unique())
    for t_s, now in links.groupby("t_s"):
        share = np.full((5, 5), np.nan)
        share[now.sender, now.receiver] = now.delivered
        assert (pictures[t_s] == palette.share_colours(share)).all()
    assert links[(links.t_s > 5) & (links.sender == 2)].empty  # out of earshot: grey
