"""The figures of a page of results, as SVG; matplotlib is the optional extra `report`."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sortie.perception.metrics.ap import average_precision
from sortie.perception.scene.traffic import TargetPath
from sortie.scenarios.frames import frame_from
from sortie.scenarios.representation import REPRESENTATION_OF
from sortie.scenarios.schema import Jammer
from sortie.sim.folders import RunError
from sortie.sim.results import links
from sortie.sim.results.accuracy import matched
from sortie.sim.results.accuracy_table import WINDOW_S, accuracy_table
from sortie.sim.results.link_traffic import mean_goodput
from sortie.sim.results.record import HANDSHAKE, SortieRecord
from sortie.sim.results.sentences import event_in_words
from sortie.sim.results.traffic import settled
from sortie.sim.results.transitions import transitions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Drawer = Callable[["Axes", SortieRecord], None]

DRONES = ("#2f6fd0", "#d9780f", "#8a4fd0", "#0f9a8b", "#d0407a", "#9a8a12", "#4f88b8", "#b5603c", "#6a9a3a", "#85756d")
"""Colours of drones, on white."""
SENT = {
    "features": "#3f9a52",
    "codes": "#2a8a9a",
    "detections": "#d08a1d",
    "uncertain_boxes": "#c05a2a",
    "tracks": "#4f7fd0",
    "raw": "#b04fb0",
    "nothing": "#d5d7db",
}
HANDSHAKES = "#a89a3c"
FATES = {"lost": "#d02f45", "expired": "#8a90a0"}
MISSION, EVENT, JAMMER = "#d02fae", "#8a6a00", "#c8201f"
MOST_NAMED = 40
"""A legend has room for so many names."""
DISCS = 6
"""A mission region that moves is drawn on the map at so many times."""
MOST_LINKS = 42
"""The matrix of links has a row for each of so many; of larger fleets a row for each sender."""


def colour(drone: int) -> str:
    """The drone's colour, the same in every figure."""
    return DRONES[drone % len(DRONES)]


def figures(record: SortieRecord) -> dict[str, str]:
    """Every figure of a run by its caption, as SVG text.

    Raises:
        RunError: matplotlib is not installed.
    """
    plots: list[tuple[str, float, Drawer]] = [
        (
            "What each drone was to send on its best link (upper bar), and the best that arrived each second (lower bar)",
            max(2.0, 0.6 + 0.45 * _drones(record)),  # the legend beside it needs so much
            _lanes,
        ),
        ("Accuracy of all drones over the last five seconds, AP@0.5", 2.6, _accuracy),
        ("Accuracy of each drone over its last five seconds, full scene, AP@0.5", 2.6, _accuracy_of_each),
        ("Traffic by representation and fate, Mb/s", 2.6, _traffic),
        ("Goodput, mean of each drone's links measured lately and of each second, Mb/s", 2.6, _goodput),
        (
            "Links over time: share of the sender's descriptors that the receiver heard; white where it was out of earshot",
            max(2.2, 0.9 + 0.16 * len(_matrix_rows(_drones(record)))),
            _links,
        ),
        ("Battery, %", 2.4, _battery),
        ("Energy spent, kJ", 2.4, _energy),
        ("Age of descriptors when a policy read them, 99th percentile, ms", 2.2, _age),
        ("The way over the ground, m: drones, targets, mission regions and jammers", 5.2, _map),
    ]
    left_out = [_accuracy, _accuracy_of_each] if record.detector == "none" else []
    if _drones(record) < 2 or links.TABLE not in record.tables:  # runs of 0.2.0 have no links
        left_out.append(_links)
    plots = [plot for plot in plots if plot[2] not in left_out]

    def over_time(draw: Drawer) -> Callable[[Axes], None]:
        def both(axes: Axes) -> None:
            draw(axes, record)
            if draw is not _map:
                mark_moments(axes, record)

        return both

    return drawn([(caption, height_in, over_time(draw)) for caption, height_in, draw in plots])


def drawn(plots: Sequence[tuple[str, float, Callable[[Axes], None]]]) -> dict[str, str]:
    """Figures of one pair of axes each, by caption, as SVG text; letters stay readable at half the size.

    Args:
        plots: caption, height in inches (all are 9 wide), and what draws it.

    Raises:
        RunError: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RunError("matplotlib is missing: pip install 'sortie-sim[report]'") from error
    style: dict[Any, Any] = {
        "svg.hashsalt": "sortie",
        "svg.fonttype": "none",
        "text.parse_math": False,
        "font.family": "sans-serif",
        "font.size": 12.0,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": "#888888",
        "axes.grid": True,
        "grid.color": "#e6e6e6",
        "axes.axisbelow": True,
        "legend.frameon": False,
        "legend.fontsize": 12.0,
        "legend.handlelength": 1.2,
        "legend.borderaxespad": 0.2,
        "legend.labelspacing": 0.3,
    }
    made = {}
    with mpl.rc_context(style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # a browser draws the letters, with fonts of its own
        for caption, height_in, draw in plots:
            figure = Figure(figsize=(9.0, height_in), layout="constrained")
            draw(figure.add_subplot())
            made[caption] = _svg(figure)
    return made


def legend_beside(axes: Axes) -> None:
    """A legend to the right of the axes, where it hides no curve; none where nobody could read it."""
    if 0 < len(axes.get_legend_handles_labels()[1]) <= MOST_NAMED:
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))


def _svg(figure: Figure) -> str:
    """The figure as an SVG element alone; the same figure gives the same text."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    whole = text.getvalue()
    return whole[whole.index("<svg") :]


def _drones(record: SortieRecord) -> int:
    return record.scenario.fleet.drones


def moments(record: SortieRecord) -> list[tuple[float, list[str]]]:
    """What happened to the fleet: times, each with its events in words; the k-th is marked k + 1 in every figure."""
    at: dict[float, list[str]] = {}
    for row in record.tables["events"].to_pylist():
        at.setdefault(row["t_s"], []).append(event_in_words(row))
    return sorted(at.items())


def mark_moments(axes: Axes, record: SortieRecord) -> None:
    """Phase changes by name and events by number, as lines through the figure; time runs along the whole sortie."""
    end_s = record.scenario.duration_s
    labels: dict[float, list[tuple[str, str]]] = {}
    for k, (t_s, _) in enumerate(moments(record), start=1):
        axes.axvline(t_s, color=EVENT, linewidth=1.2, linestyle=":")
        labels.setdefault(t_s, []).append((str(k), EVENT))
    for phase in chain(*record.scenario.mission.phases_of):
        if 0 < phase.at_s < end_s:
            axes.axvline(phase.at_s, color=MISSION, linewidth=1.2, linestyle="--")
            labels.setdefault(phase.at_s, []).append((phase.phase, MISSION))
    free_s = -end_s
    for t_s, said in sorted(labels.items()):
        label = " ".join(text for text, _ in said)
        if t_s >= free_s:  # a label that would lie on the one before is left out
            axes.annotate(
                label,
                (t_s, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(0, 2),
                textcoords="offset points",
                ha="center",
                va="bottom",
                color=said[-1][1],
                fontsize=11,
            )
            free_s = t_s + (0.012 + 0.012 * len(label)) * end_s
    axes.set_xlim(0.0, end_s)
    axes.set_xlabel("s", loc="right", labelpad=-2)


def _column(table: pa.Table, name: str) -> Floats:
    return np.asarray(table[name].to_numpy(), dtype=float)


def _lanes(axes: Axes, record: SortieRecord) -> None:
    end_s, n = record.scenario.duration_s, _drones(record)

    ladder = ["nothing", *list(REPRESENTATION_OF)[1:]]
    since = dict.fromkeys(range(n), (0.0, "nothing"))
    carried: list[dict[int, str]] = [{} for _ in range(n)]  # representation by drone and peer
    down: set[int] = set()
    occurs: set[str] = set()

    def close(drone: int, t_s: float) -> None:
        begin_s, kind = since[drone]
        occurs.add(kind)
        axes.broken_barh(
            [(begin_s, t_s - begin_s)], (drone - 0.42, 0.5), facecolor=SENT[kind], edgecolor="white", linewidth=0.5
        )

    for drone, begin_s, until_s, kind in arrived(record):
        occurs.add(kind)
        axes.broken_barh([(begin_s, until_s - begin_s)], (drone + 0.11, 0.26), facecolor=SENT[kind])
    changes = [*landings(record), *transitions(record.tables["directives"], {})]
    for change in sorted(changes, key=lambda change: change["t_s"]):
        drone, t_s = change["drone"], change["t_s"]
        if "airborne" in change:
            (down.discard if change["airborne"] else down.add)(drone)
        else:
            carried[drone] |= dict.fromkeys(change["peers"], change["to"].split(" ")[0])
        # who is down sends nothing, whatever was last decided
        kind = max({"nothing"}.union(() if drone in down else carried[drone].values()), key=ladder.index)
        if kind != since[drone][1]:
            close(drone, t_s)
            since[drone] = (t_s, kind)
    for drone in range(n):
        close(drone, end_s)
    axes.set_yticks(range(n), [f"drone {i}" for i in range(n)])
    axes.set_ylim(n - 0.5, -0.5)
    axes.grid(visible=False)
    for kind, ink in SENT.items():
        if kind in occurs:
            axes.plot([], [], color=ink, linewidth=6, label=kind)
    legend_beside(axes)


def arrived(record: SortieRecord) -> list[tuple[int, float, float, str]]:
    """Drone, begin and end in s, and the richest representation of its payloads that reached any peer in that second.

    Seconds that are alike are joined; those in which nothing arrived are left out.
    """
    sent = record.tables["transmissions"]
    came = pc.is_in(sent["status"], pa.array(["delivered", "partial"]))
    came = pc.and_(came, pc.not_equal(sent["representation"], HANDSHAKE))
    rows = sent.filter(came)
    edges, ladder = _edges(record), list(REPRESENTATION_OF)
    best: dict[tuple[int, int], int] = {}
    seconds = np.searchsorted(edges, _column(rows, "t_done_s"), side="right") - 1
    for drone, second, kind in zip(
        rows["drone"].to_pylist(), seconds.tolist(), rows["representation"].to_pylist(), strict=True
    ):
        best[drone, second] = max(best.get((drone, second), 0), ladder.index(kind))
    spans: list[tuple[int, float, float, str]] = []
    for (drone, second), level in sorted(best.items()):
        begin_s, until_s, kind = float(edges[second]), float(edges[min(second + 1, len(edges) - 1)]), ladder[level]
        if spans and spans[-1][0] == drone and spans[-1][2] == begin_s and spans[-1][3] == kind:
            begin_s = spans.pop()[1]
        spans.append((drone, begin_s, until_s, kind))
    return spans


def landings(record: SortieRecord) -> list[dict[str, Any]]:
    """When each drone left the air or came back: `t_s`, `drone`, `airborne`; at the begin, those on the ground."""
    states, n = record.tables["states"], _drones(record)
    flying = states["airborne"].to_numpy().reshape(-1, n)
    before = np.concatenate([np.ones((1, n), bool), flying[:-1]])
    t_s = _column(states, "t_s")[::n]
    return [
        {"t_s": float(t_s[k]), "drone": drone, "airborne": bool(flying[k, drone])}
        for k, drone in np.argwhere(flying != before).tolist()
    ]


def _edges(record: SortieRecord) -> Floats:
    """Begin and end of every second; the last one ends with the sortie."""
    end_s = record.scenario.duration_s
    return np.append(np.arange(frame_from(end_s, 1.0), dtype=float), end_s)


def accuracy_points(record: SortieRecord, *, mission: bool) -> Floats:
    """Second and AP@0.5 of all drones over the `WINDOW_S` before it, [K, 2]; seconds without a fusion are left out."""
    fusions = matched(record, mission=mission)
    t_s = np.array([t for t, _ in fusions])
    frames = list(fusions.values())
    points = []
    for end_s in _edges(record)[1:]:
        within = [frames[k] for k in np.flatnonzero((t_s >= end_s - WINDOW_S) & (t_s < end_s))]
        if within:
            points.append((end_s, average_precision(within)))
    return np.array(points).reshape(-1, 2)


def _accuracy(axes: Axes, record: SortieRecord) -> None:
    for mission, label, ink in ((False, "full scene", "#2f6fd0"), (True, "mission disc", MISSION)):
        points = accuracy_points(record, mission=mission)
        if len(points):
            axes.plot(*points.T, color=ink, label=label, linewidth=2.0)
    axes.set_ylim(0.0, 1.0)
    legend_beside(axes)


def _accuracy_of_each(axes: Axes, record: SortieRecord) -> None:
    table = accuracy_table(record)
    drone, t_s, ap50 = table["drone"].to_numpy(), _column(table, "t_s"), _column(table, "ap50")
    for i in np.unique(drone).tolist():
        axes.plot(t_s[drone == i], ap50[drone == i], color=colour(i), linewidth=1.4, label=f"drone {i}")
    axes.set_ylim(0.0, 1.0)
    legend_beside(axes)


def _matrix_rows(drones: int) -> list[tuple[int, int | None]]:
    """The rows of the matrix of links: sender and receiver, or a sender alone."""
    pairs = [(i, j) for i in range(drones) for j in range(drones) if i != j]
    return [*pairs] if len(pairs) <= MOST_LINKS else [(i, None) for i in range(drones)]


def _links(axes: Axes, record: SortieRecord) -> None:
    table = record.tables[links.TABLE]
    t_s, sender, receiver, delivered = (_column(table, name) for name in ("t_s", "sender", "receiver", "delivered"))
    edges_s, rows = np.unique(np.append(t_s, record.scenario.duration_s)), _matrix_rows(_drones(record))
    share = np.full((len(rows), len(edges_s) - 1), np.nan)
    for k, (i, j) in enumerate(rows):
        own = (sender == i) & (True if j is None else receiver == j) & ~np.isnan(delivered)
        second = np.searchsorted(edges_s, t_s[own]) - 1  # a row tells of the time before it
        count = np.bincount(second[second >= 0], minlength=share.shape[1])
        total = np.bincount(second[second >= 0], delivered[own][second >= 0], share.shape[1])
        share[k] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    drawn_in = axes.pcolormesh(
        edges_s, np.arange(len(rows) + 1), share, cmap="RdYlGn", vmin=0.0, vmax=1.0, rasterized=True
    )
    axes.figure.colorbar(drawn_in, ax=axes, pad=0.01)
    each = max(1, len(rows) // 20)
    names = [f"{i}" if j is None else f"{i} → {j}" for i, j in rows]
    axes.set_yticks(np.arange(len(rows))[::each] + 0.5, names[::each], fontsize=9)
    axes.set_ylim(len(rows), 0)
    axes.grid(visible=False)


def delivered_mbps(record: SortieRecord) -> Floats:
    """Second and payload that arrived in it, Mb/s, [K, 2]; of payloads that came in part, that part."""
    sent, edges = record.tables["transmissions"], _edges(record)
    megabits, _ = np.histogram(_column(sent, "t_done_s"), edges, weights=8e-6 * _column(sent, "arrived_bytes"))
    return np.column_stack([edges[1:], megabits / np.diff(edges)])


def draw_lanes(axes: Axes, record: SortieRecord) -> None:
    """What each drone was to send and what arrived, with the moments of the sortie."""
    _lanes(axes, record)
    mark_moments(axes, record)


def _traffic(axes: Axes, record: SortieRecord) -> None:
    names, rows = settled(record.tables["transmissions"])
    kinds, (done, size) = np.array(names), rows.T
    edges = _edges(record)
    for kind in sorted(set(names)):
        representation, fate = kind.split(" ")
        if fate == "in_flight":
            continue
        megabits, _ = np.histogram(done[kinds == kind], edges, weights=8e-6 * size[kinds == kind])
        ink = FATES.get(fate) or {**SENT, HANDSHAKE: HANDSHAKES}[representation]
        axes.plot(edges[1:], megabits / np.diff(edges), color=ink, label=kind, linewidth=1.8)
    legend_beside(axes)
    axes.set_ylim(bottom=0.0)


def _goodput(axes: Axes, record: SortieRecord) -> None:
    table = record.tables["descriptors"]
    if _drones(record) < 2:
        return
    drone, t_s = table["drone"].to_numpy(), _column(table, "t_s")
    mean = mean_goodput(table)
    edges = _edges(record)
    for i in range(_drones(record)):
        own = (drone == i) & ~np.isnan(mean)
        total, _ = np.histogram(t_s[own], edges, weights=mean[own])
        count, _ = np.histogram(t_s[own], edges)
        each = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        axes.plot(edges[1:], each, color=colour(i), linewidth=1.6, label=f"drone {i}")
    axes.set_ylim(bottom=0.0)
    legend_beside(axes)


def _battery(axes: Axes, record: SortieRecord) -> None:
    table = record.tables["states"]
    drone, t_s, soc = table["drone"].to_numpy(), _column(table, "t_s"), _column(table, "soc")
    each = max(1, round(record.scenario.context.rate_hz))  # a point a second is enough
    for i in range(_drones(record)):
        axes.plot(
            t_s[drone == i][::each], 100.0 * soc[drone == i][::each], color=colour(i), linewidth=1.6, label=f"drone {i}"
        )
    lowest = float(soc.min()) if len(soc) else 0.0
    axes.set_ylim(max(0.0, 100.0 * np.floor(20.0 * lowest - 0.5) / 20.0), 100.0)
    legend_beside(axes)


def _energy(axes: Axes, record: SortieRecord) -> None:
    table = record.tables["states"]
    drone, t_s, spent_j = table["drone"].to_numpy(), _column(table, "t_s"), _column(table, "spent_j")
    each = max(1, round(record.scenario.context.rate_hz))
    for i in range(_drones(record)):
        own = drone == i
        axes.plot(t_s[own][::each], 1e-3 * spent_j[own][::each], color=colour(i), linewidth=1.6, label=f"drone {i}")
    axes.set_ylim(bottom=0.0)
    legend_beside(axes)


def _age(axes: Axes, record: SortieRecord) -> None:
    table = record.tables["ages"]
    t_s, age_s = _column(table, "t_s"), _column(table, "age_s")
    edges = _edges(record)
    second = np.searchsorted(edges, t_s, side="right") - 1
    points = [(edges[s + 1], 1e3 * np.percentile(age_s[second == s], 99)) for s in np.unique(second)]
    if points:
        axes.plot(*np.array(points).T, color="#555555", linewidth=1.4)
    axes.set_ylim(bottom=0.0)


def _map(axes: Axes, record: SortieRecord) -> None:
    states, mission = record.tables["states"], record.tables["mission"]
    drone, x, y = states["drone"].to_numpy(), _column(states, "x_m"), _column(states, "y_m")
    each = max(1, round(record.scenario.context.rate_hz / 2))
    for i in range(_drones(record)):
        own = (x[drone == i], y[drone == i])
        standing = record.scenario.fleet.station(i) is not None
        name, marker = (f"station {i}", "^") if standing else (f"drone {i}", "o")
        axes.plot(own[0][::each], own[1][::each], color=colour(i), linewidth=1.6, label=name)
        axes.plot(own[0][-1:], own[1][-1:], marker, color=colour(i), markersize=7)
    t_s = np.unique(_column(mission, "t_s"))[::each]
    for k, target in enumerate(record.scenario.mission.targets):
        way = np.array([TargetPath.of(target).pose(t)[:2] for t in t_s.tolist()])
        axes.plot(*way.T, ":", color=MISSION, linewidth=2.5, zorder=4, label="target" if k == 0 else "")
    for rows in (mission.filter(pc.equal(mission["group"], g)) for g in pc.unique(mission["group"]).to_pylist()):
        _discs(axes, rows)
    jammers = [event for event in record.scenario.events if isinstance(event, Jammer)]
    for k, jam in enumerate(jammers):
        x_m, y_m, _ = jam.position_m
        axes.plot([x_m], [y_m], "X", color=JAMMER, markersize=11, label="jammer" if k == 0 else "")
        until = "" if jam.until_s is None else f"–{jam.until_s:g}"
        axes.annotate(
            f"{jam.at_s:g}{until} s", (x_m, y_m), xytext=(8, 6), textcoords="offset points", color=JAMMER, fontsize=11
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east")
    axes.set_ylabel("north")
    legend_beside(axes)


def _discs(axes: Axes, rows: pa.Table) -> None:
    """A group's mission region over time: faint where it was, strong where it was last."""
    from matplotlib.patches import Circle

    there = np.flatnonzero(~np.isnan(_column(rows, "region_radius_m")))
    if not len(there):
        return
    shown = np.unique(there[np.linspace(0, len(there) - 1, DISCS).astype(int)])
    for k in shown.tolist():
        x_m, y_m, radius_m = (_column(rows, f"region_{c}")[k] for c in ("x_m", "y_m", "radius_m"))
        last = k == shown[-1]
        axes.add_patch(Circle((x_m, y_m), radius_m, fill=True, facecolor=MISSION, edgecolor="none", alpha=0.06))
        axes.add_patch(
            Circle((x_m, y_m), radius_m, fill=False, edgecolor=MISSION, linewidth=1.8, alpha=1.0 if last else 0.35)
        )
    if "mission region" not in axes.get_legend_handles_labels()[1]:
        axes.plot([], [], "o", mfc="none", color=MISSION, markersize=11, label="mission region")
    axes.autoscale_view()
