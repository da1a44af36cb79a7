"""The plots, lanes, logs and the matrix of links of a playback: what was carried, what it cost, and who decided what, and why.

As in `sortie.sim.playback.scene`, tables come whole or by whole seconds; sums over a second (k−1 to k) stand at k.
"""

from __future__ import annotations

import re
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from sortie.perception.metrics.ap import Matched, average_precision
from sortie.scenarios.frames import frame_at, frame_from, frames_at, frames_from, instant
from sortie.scenarios.representation import REPRESENTATION_OF
from sortie.scenarios.schema import Scenario
from sortie.sim.playback.canvas import Canvas, line
from sortie.sim.playback.event_lane import NOTHING, Span, lane_changes, spans_of
from sortie.sim.playback.links import LinkMatrix
from sortie.sim.results import links, palette
from sortie.sim.results.accuracy_table import WINDOW_S
from sortie.sim.results.link_traffic import mean_goodput
from sortie.sim.results.palette import Floats
from sortie.sim.results.record import TABLES
from sortie.sim.results.sentences import decision_in_words, event_in_words
from sortie.sim.results.sightings import Sighting
from sortie.sim.results.traffic import settled
from sortie.sim.results.transitions import transitions

MARKED = ("ap", "battery", "goodput", "traffic", "age", "lost", "medium")
"""Plots in which phase changes and events are marked."""
EVENT_LANE: palette.Rgba = (150, 108, 20, 255)
OVER_COLOUR: palette.Rgba = (0, 0, 0, 255)
RUNGS = ("nothing", *list(REPRESENTATION_OF)[1:])
FATES: dict[str, palette.Rgba] = {"expired": (225, 222, 240, 255), "lost": (255, 50, 70, 255)}
"""Colours of traffic that did not arrive; what arrived has its representation's colour."""


def phase_lane(group: int) -> str:
    """Where a group's phases are shown; 0 are the drones in no group."""
    return f"lanes/phase_{group}" if group else "lanes/phase"


class Charts:
    """Plots of one sortie; `begin` once, then `add` with the tables in order of time."""

    def __init__(self, canvas: Canvas, scenario: Scenario) -> None:
        self._canvas, self._scenario, self._n = canvas, scenario, scenario.fleet.drones
        self._links = LinkMatrix(canvas, self._n)
        self._known_s = 0.0
        self._settled: Floats = np.zeros((0, 2))
        self._kinds: list[str] = []
        self._running: set[str] = set()
        self._ages: Floats = np.zeros((0, 2))
        self._received: Floats = np.zeros((0, len(TABLES["receptions"])))
        self._window: deque[Sighting] = deque()
        self._carried: dict[tuple[int, int], str] = {}
        self._up: NDArray[np.bool_] = np.zeros(self._n, bool)
        self._decided: dict[int, str] = {}
        self._lanes: dict[int, str] = {}
        self._lane_colours: dict[int, dict[str, palette.Rgba]] = defaultdict(dict)
        self._phase: dict[int, str] = {}
        self._events_seen: list[Span] = []
        self._event_shown, self._events_until_s = NOTHING, 0.0
        self._over = False

    def begin(self) -> None:
        """Name and colour every plot line that is known beforehand."""
        canvas, drones = self._canvas, range(self._n)
        self._links.begin()
        for i in drones:
            colour = palette.drone_colour(i)
            canvas.static(f"plots/battery/{i}", line(f"drone {i}", colour))
            canvas.static(f"plots/goodput/{i}", line(f"drone {i}", colour))
            canvas.static(f"plots/energy/{i}", line(f"drone {i}", colour))
            canvas.static(f"plots/ap_of/{i}", line(f"drone {i}", colour))
        phases = list(palette.PHASES)
        for group in range(len(self._scenario.mission.phases_of)):
            colours = [*(palette.PHASES[p] for p in phases), OVER_COLOUR]
            states = rr.StateConfiguration(values=[*phases, NOTHING], colors=colours)
            canvas.static(phase_lane(group), states)
        canvas.static("plots/ap/full_scene", line("full scene", (120, 200, 255, 255), width=2.5))
        canvas.static("plots/ap/mission", line("mission disc", palette.MISSION, width=2.5))
        canvas.static("plots/age/p99_ms", line("descriptor age p99, ms", (190, 190, 200, 255)))
        canvas.static("plots/lost/percent", line("descriptors lost, %", (230, 120, 120, 255)))
        canvas.static("plots/medium/busy_percent", line("channel busy, %", (240, 150, 80, 255)))
        for folder in MARKED:
            canvas.static(f"plots/{folder}/marks/event", _mark("event", palette.WARNING, rr.components.MarkerShape.Up))
            canvas.static(
                f"plots/{folder}/marks/phase", _mark("phase change", palette.MISSION, rr.components.MarkerShape.Diamond)
            )

    def add(self, known_s: float, new: Mapping[str, pa.Table], seen: Iterable[Sighting]) -> None:
        """Plot new rows; everything before `known_s` is in by now."""
        seconds = self._seconds(known_s)
        states = new["states"]
        drone, t_s, soc, spent_j = (states[k].to_numpy() for k in ("drone", "t_s", "soc", "spent_j"))
        for i in range(self._n):
            self._canvas.scalars(f"plots/battery/{i}", t_s[drone == i], 100.0 * soc[drone == i])
            self._canvas.scalars(f"plots/energy/{i}", t_s[drone == i], 1e-3 * spent_j[drone == i])
        self._goodput(new["descriptors"])
        self._traffic(seconds, new["transmissions"])
        self._plane(seconds, new["ages"], new["medium"])
        self._losses(seconds, new["receptions"])
        self._accuracy(seconds, seen)
        self._phases(new["mission"])
        self._decisions(new["directives"], states)
        self._events(known_s, new["events"])
        if links.TABLE in new:
            self._links.add(new[links.TABLE])
        if known_s >= self._scenario.duration_s and not self._over:
            self._end_lanes()

    def _seconds(self, known_s: float) -> list[tuple[float, float]]:
        """The seconds (begin, end) that are whole by now; the last one of a sortie may be short."""
        begin_s, seconds = self._known_s, []
        while begin_s < known_s:
            end_s = min(frame_at(begin_s, 1.0) + 1.0, self._scenario.duration_s)
            if instant(end_s) > instant(known_s):
                break
            seconds.append((begin_s, end_s))
            begin_s = end_s
        self._known_s = begin_s
        return seconds

    # --- plots -----------------------------------------------------------------------------------

    def _goodput(self, descriptors: pa.Table) -> None:
        """The mean goodput of each drone's links that were tried lately; a gap while there are none."""
        drone, t_s = descriptors["drone"].to_numpy(), descriptors["t_s"].to_numpy()
        if self._n < 2:
            return
        mean = mean_goodput(descriptors)
        for i in range(self._n):
            self._canvas.scalars(f"plots/goodput/{i}", t_s[drone == i], mean[drone == i])

    def _traffic(self, seconds: Sequence[tuple[float, float]], transmissions: pa.Table) -> None:
        """Mb/s by representation and fate, each line from the second in which it first carries anything."""
        new_kinds, new = settled(transmissions)
        self._kinds, self._settled = self._kinds + new_kinds, np.concatenate([self._settled, new])
        kinds, t_s = np.array(self._kinds, dtype=object), self._settled[:, 0]
        if not seconds:
            return
        edges = np.array([seconds[0][0], *(end for _, end in seconds)])
        now = t_s < edges[-1]
        for name in sorted(set(self._kinds) | self._running):
            size, _ = np.histogram(t_s[now & (kinds == name)], edges, weights=self._settled[now & (kinds == name), 1])
            mbps = size * 8e-6 / np.diff(edges)
            path = f"plots/traffic/{name.replace(' ', '_')}"
            begin = 0
            if name not in self._running:
                if not mbps.any():
                    continue
                begin = int(np.argmax(mbps > 0))
                self._running.add(name)
                representation, fate = name.split(" ")
                colour = FATES.get(fate) or palette.SENT[representation]
                self._canvas.static(path, line(name, colour))
            self._canvas.scalars(path, edges[1:][begin:], mbps[begin:])
        later = t_s >= edges[-1]  # what is still in flight has no time, and is dropped here
        self._settled, self._kinds = self._settled[later], kinds[later].tolist()

    def _plane(self, seconds: Sequence[tuple[float, float]], ages: pa.Table, medium: pa.Table) -> None:
        rows = np.column_stack([ages["t_s"].to_numpy(), ages["age_s"].to_numpy()])
        self._ages = np.concatenate([self._ages, rows])
        points = []
        for begin_s, end_s in seconds:
            first, last = np.searchsorted(self._ages[:, 0], (begin_s, end_s))  # rows come in order of time
            if last > first:
                points.append((end_s, 1e3 * float(np.percentile(self._ages[first:last, 1], 99))))
        if points:
            self._canvas.scalars("plots/age/p99_ms", *np.array(points).T)
        if seconds:
            self._ages = self._ages[self._ages[:, 0] >= seconds[-1][1]]
        busy = 100.0 * medium["busy_fraction"].to_numpy()
        self._canvas.scalars("plots/medium/busy_percent", medium["t_s"].to_numpy(), busy)

    def _losses(self, seconds: Sequence[tuple[float, float]], receptions: pa.Table) -> None:
        """Share of descriptor receptions lost in each second with any."""
        rows = np.column_stack([column.to_numpy().astype(float) for column in receptions.columns])
        self._received = np.concatenate([self._received, rows])
        points = []
        for begin_s, end_s in seconds:
            first, last = np.searchsorted(
                frames_at(self._received[:, 0], self._scenario.frame_s),
                frames_from((begin_s, end_s), self._scenario.frame_s),
            )
            heard, *lost = self._received[first:last, 1:].sum(axis=0).tolist()
            if heard + sum(lost) > 0:
                points.append((end_s, 100.0 * sum(lost) / (heard + sum(lost))))
        if points:
            self._canvas.scalars("plots/lost/percent", *np.array(points).T)
        if seconds:
            self._received = self._received[
                frames_at(self._received[:, 0], self._scenario.frame_s)
                >= frame_from(seconds[-1][1], self._scenario.frame_s)
            ]

    def _accuracy(self, seconds: Sequence[tuple[float, float]], seen: Iterable[Sighting]) -> None:
        """AP@0.5 over the last seconds, all egos pooled, and of each ego in the full scene."""
        self._window.extend(seen)
        points: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for _, end_s in seconds:
            while self._window and self._window[0].t_s < end_s - WINDOW_S:
                self._window.popleft()
            within = [s for s in self._window if s.t_s < end_s]
            frames: dict[str, list[Matched]] = defaultdict(list)
            for seen_by in within:
                frames["ap/full_scene"].append(seen_by.full)
                frames[f"ap_of/{seen_by.drone}"].append(seen_by.full)
                if seen_by.mission is not None:
                    frames["ap/mission"].append(seen_by.mission)
            for name, matches in frames.items():
                points[name].append((end_s, average_precision(matches)))
        for name, several in points.items():
            rows = np.array(several).reshape(-1, 2)
            self._canvas.scalars(f"plots/{name}", rows[:, 0], rows[:, 1])

    # --- lanes and logs --------------------------------------------------------------------------

    def _phases(self, mission: pa.Table) -> None:
        for t_s, group, phase in zip(*(mission[k].to_pylist() for k in ("t_s", "group", "phase")), strict=True):
            before = self._phase.get(group)
            if phase != before:
                if before is not None:
                    self._marks("phase", [t_s])
                self._phase[group] = phase
                self._state(phase_lane(group), t_s, phase)

    def _decisions(self, directives: pa.Table, states: pa.Table) -> None:
        """Log each change of what a link carries, in words; a drone's lane shows the highest rung of its links."""
        changes, decided = [], []
        for change in transitions(directives, self._carried):
            changes.append(change)
            decided.append((change["t_s"], change["drone"], self._best(change["drone"])))
        if changes:
            columns = rr.TextLog.columns(
                text=[decision_in_words(x) for x in changes],
                level=["INFO"] * len(changes),
                color=[palette.drone_colour(x["drone"]) for x in changes],
            )
            self._canvas.columns("log/decisions", np.array([x["t_s"] for x in changes]), columns)
        self._drone_lanes(decided, states)

    def _best(self, drone: int) -> str:
        """What the drone was last to send on its best link."""
        levels = [level for (sender, _), level in self._carried.items() if sender == drone]
        return max(levels, key=_height)

    def _drone_lanes(self, decided: list[tuple[float, int, str]], states: pa.Table) -> None:
        """Show what each drone decided to send on its best link, and "nothing" while it is down."""
        up = states["airborne"].to_numpy().reshape(-1, self._n)
        frames, drones = np.nonzero(np.diff(up, axis=0, prepend=self._up[None]))
        t_s = states["t_s"].to_numpy()[:: self._n]
        turns = zip(t_s[frames].tolist(), drones.tolist(), up[frames, drones].tolist(), strict=True)
        for at_s, drone, change in sorted([*turns, *decided], key=lambda row: row[0]):
            if isinstance(change, str):
                self._decided[drone] = change
            else:
                self._up[drone] = change
            if drone in self._decided:
                self._show(at_s, drone, self._decided[drone] if self._up[drone] else "nothing")

    def _show(self, t_s: float, drone: int, level: str) -> None:
        """Let a drone's lane show a level from now on."""
        if self._lanes.get(drone) == level:
            return
        self._lanes[drone] = level
        path, colours = f"lanes/drone_{drone}", self._lane_colours[drone]
        if level not in colours:
            colours[level] = _level_colour(level)
            self._canvas.static(path, rr.StateConfiguration(values=list(colours), colors=list(colours.values())))
        self._state(path, t_s, level)

    def _end_lanes(self) -> None:
        """Let every lane end with the sortie."""
        self._over, end_s = True, self._scenario.duration_s
        for drone in self._lanes:
            colours = {**self._lane_colours[drone], NOTHING: OVER_COLOUR}
            lane = rr.StateConfiguration(values=list(colours), colors=list(colours.values()))
            self._canvas.static(f"lanes/drone_{drone}", lane)
            self._state(f"lanes/drone_{drone}", end_s, NOTHING)
        for group in self._phase:
            self._state(phase_lane(group), end_s, NOTHING)
        if self._events_seen:
            self._state("lanes/events", end_s, NOTHING)

    def _state(self, path: str, t_s: float, state: str) -> None:
        self._canvas.columns(path, np.array([t_s]), rr.StateChange.columns(state=[state]))

    def _events(self, known_s: float, events: pa.Table) -> None:
        """Log events, mark them, and let the lane show each while it lasts."""
        rows = events.to_pylist()
        if rows:
            texts = [event_in_words(r) for r in rows]
            columns = rr.TextLog.columns(text=texts, level=["WARN"] * len(rows), color=[palette.WARNING] * len(rows))
            t_s = [r["t_s"] for r in rows]
            self._canvas.columns("log/events", np.array(t_s), columns)
            self._marks("event", t_s)
            self._events_seen += spans_of(rows, self._scenario)
            known = list(dict.fromkeys(span.text for span in self._events_seen))
            colours = [*[EVENT_LANE] * len(known), OVER_COLOUR]
            self._canvas.static("lanes/events", rr.StateConfiguration(values=[*known, NOTHING], colors=colours))
        for at_s, text in lane_changes(self._events_seen, self._event_shown, self._events_until_s, known_s):
            self._event_shown = text
            self._state("lanes/events", at_s, text)
        self._events_until_s = known_s

    def _marks(self, kind: str, t_s: list[float]) -> None:
        """Mark moments on the floor of the plots."""
        for folder in MARKED:
            self._canvas.scalars(f"plots/{folder}/marks/{kind}", np.array(t_s), np.zeros(len(t_s)))


def _mark(name: str, colour: palette.Rgba, shape: rr.components.MarkerShape) -> rr.SeriesPoints:
    return rr.SeriesPoints(colors=[colour], markers=[shape], names=[name], marker_sizes=[4.0])


def _height(level: str) -> tuple[int, float]:
    """The rung of a level, and of levels on the same rung what they send a second: ρ times the rate."""
    return RUNGS.index(level.split(" ")[0]), _after("ρ=", level, 1.0) * _after("at ", level, 0.0)


def _level_colour(level: str) -> palette.Rgba:
    """The representation's colour, darker at lower rates."""
    light = 0.55 + 0.45 * min(1.0, _after("at ", level, 10.0) / 10.0)
    r, g, b = (round(light * part) for part in palette.SENT[level.split(" ")[0]][:3])
    return r, g, b, 255


def _after(word: str, level: str, otherwise: float) -> float:
    """The number after a word of a level."""
    found = re.search(rf"{word}(\S+)", level)
    return float(found[1]) if found else otherwise
