"""The figures of a page of results, as SVG; matplotlib is the optional extra `report`."""

from __future__ import annotations

import io
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sortie.perception.metrics.ap import average_precision
from sortie.perception.scene.traffic import TargetPath
from sortie.scenarios.link_state import is_tried
from sortie.scenarios.representation import REPRESENTATION_OF
from sortie.sim.folders import RunError
from sortie.sim.results.accuracy import matched
from sortie.sim.results.outcome import transitions
from sortie.sim.results.record import HANDSHAKE, SortieRecord

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

DRONES = ("#2f6fd0", "#d9780f", "#8a4fd0", "#0f9a8b", "#d0407a", "#9a8a12", "#4f88b8", "#b5603c", "#6a9a3a", "#85756d")
"""Colours of drones, on white."""
SENT = {
    "features": "#3f9a52", "codes": "#2a8a9a", "detections": "#d08a1d", "uncertain_boxes": "#c05a2a", "tracks": "#4f7fd0",
    "raw": "#b04fb0", "nothing": "#d5d7db",
}  # fmt: skip
HANDSHAKES = "#a89a3c"
FATES = {"lost": "#d02f45", "expired": "#8a90a0"}
MISSION, EVENT = "#d02fae", "#a8830d"
WINDOW_S = 5.0
"""Accuracy is drawn over this long before each second, as in the playback."""


def colour(drone: int) -> str:
    """The drone's colour, the same in every figure."""
    return DRONES[drone % len(DRONES)]


def figures(record: SortieRecord) -> dict[str, str]:
    """Every figure of a run by its caption, as SVG text.

    Raises:
        RunError: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RunError("matplotlib is missing: pip install 'sortie-sim[report]'") from error
    plots: list[tuple[str, float, Any]] = [
        ("What each drone sent on its best link, and when it changed", 0.4 + 0.34 * (_drones(record) + 1), _lanes),
        ("Accuracy of all drones over the last five seconds, AP@0.5", 2.2, _accuracy),
        ("Traffic by representation and fate, Mb/s", 2.2, _traffic),
        ("Goodput, mean of each drone's links measured lately, Mb/s", 2.2, _goodput),
        ("Battery, %", 2.0, _battery),
        ("Age of descriptors when a policy read them, 99th percentile, ms", 1.8, _age),
        ("The way over the ground, m: drones, and the target with its mission disc", 4.2, _map),
    ]
    if record.detector == "none":
        del plots[1]
    style: dict[Any, Any] = {
        "svg.hashsalt": "sortie", "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9.0,
        "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": "#888888", "axes.grid": True,
        "grid.color": "#e6e6e6", "axes.axisbelow": True, "legend.frameon": False, "legend.fontsize": 8.0,
    }  # fmt: skip
    drawn = {}
    with mpl.rc_context(style):
        for caption, height_in, draw in plots:
            figure = Figure(figsize=(9.0, height_in), layout="constrained")
            axes = figure.add_subplot()
            draw(axes, record)
            if draw is not _map:
                _moments(axes, record)
            drawn[caption] = _svg(figure)
    return drawn


def _svg(figure: Figure) -> str:
    """The figure as an SVG element alone; the same figure gives the same text."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    whole = text.getvalue()
    return whole[whole.index("<svg") :]


def _drones(record: SortieRecord) -> int:
    return record.scenario.fleet.drones


def _moments(axes: Axes, record: SortieRecord) -> None:
    """Phase changes and events as lines through the figure; time runs along the whole sortie."""
    for phase in chain(*record.scenario.mission.phases_of):
        if 0 < phase.at_s < record.scenario.duration_s:
            axes.axvline(phase.at_s, color=MISSION, linewidth=1.0, linestyle="--")
    for t_s in record.tables["events"]["t_s"].to_pylist():
        axes.axvline(t_s, color=EVENT, linewidth=1.0, linestyle=":")
    axes.set_xlim(0.0, record.scenario.duration_s)
    axes.set_xlabel("s", loc="right")


def _column(table: pa.Table, name: str) -> Floats:
    return np.asarray(table[name].to_numpy(), dtype=float)


def _lanes(axes: Axes, record: SortieRecord) -> None:
    end_s, n = record.scenario.duration_s, _drones(record)
    rungs = list(SENT)[::-1]  # lowest first

    def best(carried: dict[tuple[int, int], str], drone: int) -> str:
        kinds = {level.split(" ")[0] for (sender, _), level in carried.items() if sender == drone}
        return max(kinds | {"nothing"}, key=["nothing", *list(REPRESENTATION_OF)[1:]].index)

    since = dict.fromkeys(range(n), (0.0, "nothing"))
    carried: dict[tuple[int, int], str] = {}

    def close(drone: int, t_s: float) -> None:
        begin_s, kind = since[drone]
        axes.broken_barh(
            [(begin_s, t_s - begin_s)], (drone - 0.38, 0.76), facecolor=SENT[kind], edgecolor="white", linewidth=0.5
        )

    for change in transitions(record.tables["directives"], {}):
        carried |= {(change["drone"], peer): change["to"] for peer in change["peers"]}
        kind = best(carried, change["drone"])
        if kind != since[change["drone"]][1]:
            close(change["drone"], change["t_s"])
            since[change["drone"]] = (change["t_s"], kind)
    down = _down_s(record)
    for drone in range(n):
        if drone in down:  # who is down sends nothing, whatever was last decided
            close(drone, down[drone])
            since[drone] = (down[drone], "nothing")
        close(drone, end_s)
    axes.set_yticks(range(n), [f"drone {i}" for i in range(n)])
    axes.set_ylim(n - 0.4, -1.3)
    axes.grid(visible=False)
    for kind in rungs:
        axes.plot([], [], color=SENT[kind], linewidth=6, label=kind)
    axes.legend(ncols=len(rungs), loc="upper right")


def _down_s(record: SortieRecord) -> dict[int, float]:
    """When each drone that came down did."""
    states = record.tables["states"]
    down = ~states["airborne"].to_numpy()
    drones, first = np.unique(states["drone"].to_numpy()[down], return_index=True)
    return dict(zip(drones.tolist(), _column(states, "t_s")[down][first].tolist(), strict=True))


def _edges(record: SortieRecord) -> Floats:
    """Begin and end of every second; the last one ends with the sortie."""
    end_s = record.scenario.duration_s
    return np.append(np.arange(0.0, end_s - 1e-9), end_s)


def _accuracy(axes: Axes, record: SortieRecord) -> None:
    for mission, label, ink in ((False, "full scene", "#2f6fd0"), (True, "mission disc", MISSION)):
        fusions = matched(record, mission=mission)
        t_s = np.array([t for t, _ in fusions])
        frames = list(fusions.values())
        points = []
        for end_s in _edges(record)[1:]:
            within = [frames[k] for k in np.flatnonzero((t_s >= end_s - WINDOW_S) & (t_s < end_s))]
            if within:
                points.append((end_s, average_precision(within)))
        if points:
            axes.plot(*np.array(points).T, color=ink, label=label, linewidth=1.6)
    axes.set_ylim(0.0, 1.0)
    if axes.get_lines():
        axes.legend(loc="upper left", ncols=2)


def _traffic(axes: Axes, record: SortieRecord) -> None:
    sent = record.tables["transmissions"]
    done, size = _column(sent, "t_done_s"), _column(sent, "payload_bytes")
    kinds = np.array(
        [f"{r} {s}" for r, s in zip(sent["representation"].to_pylist(), sent["status"].to_pylist(), strict=True)]
    )
    edges = _edges(record)
    for kind in sorted(set(kinds.tolist())):
        representation, fate = kind.split(" ")
        if fate == "in_flight":
            continue
        megabits, _ = np.histogram(done[kinds == kind], edges, weights=8e-6 * size[kinds == kind])
        ink = FATES.get(fate) or {**SENT, HANDSHAKE: HANDSHAKES}[representation]
        axes.plot(edges[1:], megabits / np.diff(edges), color=ink, label=kind, linewidth=1.4)
    if axes.get_lines():
        axes.legend(loc="upper right", ncols=3)
    axes.set_ylim(bottom=0.0)


def _goodput(axes: Axes, record: SortieRecord) -> None:
    table = record.tables["descriptors"]
    if _drones(record) < 2:
        return
    drone, t_s = table["drone"].to_numpy(), _column(table, "t_s")
    links = table["goodput_mbps"].combine_chunks().flatten().to_numpy().reshape(len(t_s), _drones(record) - 1)
    known = is_tried(links)
    mean = np.where(
        known.any(axis=1), np.where(known, links, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1), np.nan
    )
    for i in range(_drones(record)):
        axes.plot(t_s[drone == i], mean[drone == i], color=colour(i), linewidth=1.0, label=f"drone {i}")
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper right", ncols=5)


def _battery(axes: Axes, record: SortieRecord) -> None:
    table = record.tables["states"]
    drone, t_s, soc = table["drone"].to_numpy(), _column(table, "t_s"), _column(table, "soc")
    each = max(1, round(record.scenario.context.rate_hz))  # a point a second is enough
    for i in range(_drones(record)):
        axes.plot(
            t_s[drone == i][::each], 100.0 * soc[drone == i][::each], color=colour(i), linewidth=1.4, label=f"drone {i}"
        )
    axes.set_ylim(0.0, 100.0)
    axes.legend(loc="lower left", ncols=5)


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
        axes.plot(own[0][::each], own[1][::each], color=colour(i), linewidth=1.0, label=name)
        axes.plot(own[0][-1:], own[1][-1:], marker, color=colour(i), markersize=4)
    t_s = np.unique(_column(mission, "t_s"))[::each]
    for k, target in enumerate(record.scenario.mission.targets):
        way = np.array([TargetPath.of(target).pose(t)[:2] for t in t_s.tolist()])
        axes.plot(*way.T, ":", color=MISSION, label="target" if k == 0 else "")
    for rows in (mission.filter(pc.equal(mission["group"], g)) for g in pc.unique(mission["group"]).to_pylist()):
        there = np.flatnonzero(~np.isnan(_column(rows, "region_radius_m")))
        if len(there):
            from matplotlib.patches import Circle

            x_m, y_m, radius_m = (_column(rows, f"region_{c}")[there[-1]] for c in ("x_m", "y_m", "radius_m"))
            axes.add_patch(Circle((x_m, y_m), radius_m, fill=False, edgecolor=MISSION))
    axes.set_aspect("equal")
    axes.legend(loc="best", ncols=3)
