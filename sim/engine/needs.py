"""What a sortie will need of memory and disk, from counts, and of time, from its first seconds.

The counts are of drones, frames, links and the width of the record's rows. Some rows are certain: each drone has a state in each frame. Others depend on what drones hear and send, and have an upper
bound only: each link may carry a payload in each frame. Time cannot be counted beforehand: it depends on the machine, the
policy and what else is running.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import psutil
import pyarrow as pa

from sortie.fleet.coverage import RANGE_M
from sortie.fleet.flight.motion import frame_floats
from sortie.fleet.peers import PeerTable
from sortie.fleet.probes import window_of
from sortie.fleet.standings import ROW
from sortie.perception.scene.scene_model import SceneModel
from sortie.policies.contract import COVERAGE_BYTES
from sortie.radio.channel.large_fleet import EPOCH
from sortie.radio.channel.snr import SQUARE, earshot_m
from sortie.scenarios import scratch
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.world import air_settings
from sortie.sim.folders import RunError
from sortie.sim.results.record import TABLES
from sortie.sim.results.spool import BATCH_BYTES

FLOAT_BYTES = 8
OFFSET_BYTES = 4
"""Before each text and each list in an Arrow column."""
TEXT_BYTES = 8
"""A word, as in a status or a reason."""
LINK_BYTES = 2 * 4 * EPOCH + 3 * 4 * EPOCH
"""Of a link within earshot in a large fleet: gain and shadowing in each frame of a block, and as much again in passing."""
OBJECT_FACTOR = 8
"""Rows as Python objects over the same in Arrow."""
SCORED_FLOATS = 8
"""Of a detection while all of them are sorted by score."""
START_S = 1.0
"""Simulated time that is not measured: links begin silent, so it takes less than any other."""
MEASURED_S, MEASURED_WALL_S = 1.0, 5.0
"""A flight's time is estimated after at least so much simulated and so much wall-clock time. Fast flights are so measured over
some scoring, which comes at intervals."""
LONG_S = 60.0
"""Flights that take longer are told of."""
OUTCOME_BYTES = 16
"""Of a drone in a frame while the mission's figures are computed: whether it flew and looked."""


class Needs(NamedTuple):
    """What a sortie needs, bytes."""

    memory: int
    """What grows with the duration or with the fleet's rows, beside the program itself."""
    least_disk: int
    """Certainly, while it flies and is saved."""
    most_disk: int
    """Where every drone hears all others, every link carries a payload in every frame, and drones leave their planned ways."""


def needs(scenario: Scenario) -> Needs:
    """Count what a sortie will need."""
    n, frames = scenario.fleet.drones, scenario.frames
    width = {name: row_bytes(columns, n) for name, columns in TABLES.items()}
    groups, people = len(scenario.mission.phases_of), len(scenario.perception.people)
    certain = {
        "states": n * frames,
        "descriptors": n * math.ceil(frames / scenario.context.publish_every),
        "receptions": frames,
        "mission": groups * frames,
        "people": people * frames,
        "medium": math.ceil(scenario.duration_s),
    }
    links = n * (n - 1)
    fusions = 0 if scenario.perception.detector == "none" else scenario.scored_drones * len(scenario.scored_frames)
    cars = _cars_in_range(scenario) if fusions else 0
    possible = {
        "ages": links * frames,
        "transmissions": links * frames,
        "fusions": fusions,
        "truths": cars * fusions,
        "detections": 2 * cars * fusions,
    }
    motion = frame_floats(n) * FLOAT_BYTES * frames
    sure = sum(width[name] * rows for name, rows in certain.items())
    more = sum(width[name] * rows for name, rows in possible.items())
    batches = sum(min(BATCH_BYTES, width[name] * rows) for name, rows in (certain | possible).items())
    memory = (
        scratch.TAPE_IN_MEMORY_BYTES
        + OBJECT_FACTOR * batches
        + OUTCOME_BYTES * n * frames
        + SCORED_FLOATS * FLOAT_BYTES * possible["detections"]
        + (PeerTable(1, window_of(scenario.context.detached_after_periods)).pair_bytes + ROW.itemsize) * n * n
        + (LINK_BYTES * n * _neighbours(scenario) if n > SQUARE else 0)
    )
    return Needs(int(memory), int(motion + sure), int(2 * (motion + sure + more)))


def row_bytes(columns: Mapping[str, pa.DataType], drones: int) -> float:
    """The size of a row; a list has an entry for each peer."""
    return sum(_bytes(type_, drones) for type_ in columns.values())


def _bytes(type_: pa.DataType, drones: int) -> float:
    if pa.types.is_list(type_):
        return OFFSET_BYTES + min(drones - 1, LISTED_IDS) * _bytes(type_.value_type, drones)
    if pa.types.is_binary(type_):
        return OFFSET_BYTES + COVERAGE_BYTES
    if pa.types.is_string(type_):
        return OFFSET_BYTES + TEXT_BYTES
    return float(type_.bit_width) / 8


def _cars_in_range(scenario: Scenario) -> int:
    """The most cars that a drone has about it at a waypoint of the route, at take-off."""
    waypoints = scenario.fleet.route.waypoints_m
    x_m, y_m = zip(*waypoints, strict=True)
    bounds = min(x_m), min(y_m), max(x_m), max(y_m)
    perception, mission = scenario.perception, scenario.mission
    scene = SceneModel(perception.scene, mission.target, bounds, mission.more_targets, perception.people)
    return max(scene.cars_near(0.0, x, y, RANGE_M) for x, y in waypoints)


def _neighbours(scenario: Scenario) -> float:
    """To how many others a drone has a link within earshot, in a formation of the whole fleet."""
    apart = earshot_m(air_settings(scenario)) / scenario.fleet.formation.spacing_m
    return min(scenario.fleet.drones - 1.0, math.pi * apart * apart)


def shortage(need: Needs, run: Path) -> tuple[str, bool]:
    """What is short for a sortie that is saved in the folder `run`: in words, and whether it is certainly so; empty words
    where there is enough of all."""
    free = psutil.virtual_memory().available
    if need.memory > free:
        return f"needs {_text(need.memory)} of memory, {_text(free)} are free", True
    here = next(p for p in (run.absolute(), *run.absolute().parents) if p.exists())
    for folder in dict.fromkeys((scratch.folder(), str(here))):
        free = shutil.disk_usage(folder).free
        if need.least_disk > free:
            return f"needs at least {_text(need.least_disk)} of disk, {_text(free)} are free in {folder}", True
        if need.most_disk > free:
            return f"may need up to {_text(need.most_disk)} of disk, {_text(free)} are free in {folder}", False
    return "", False


def ensure_room(scenario: Scenario, need: Needs, run: Path, *, force: bool = False) -> str:
    """Refuse a sortie that needs more memory or disk than is free.

    Args:
        scenario: what will fly.
        need: what it needs.
        run: the folder that it is saved in.
        force: fly it all the same.

    Returns:
        A warning, or nothing.

    Raises:
        RunError: what is short, and how much is free.
    """
    words, sure = shortage(need, run)
    if words and sure and not force:
        raise RunError(f"{scenario.name}: {words}; make room, set TMPDIR to another disk, or fly it with --force")
    return words


def _text(size: float) -> str:
    """`1.2 GB`"""
    return f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.0f} MB"


class Forecast:
    """Measures the first seconds of a flight, and says how long the whole will take where that is long.

    Called with the simulated time once a simulated second, as the `progress` of `run_sortie`.
    """

    def __init__(
        self,
        scenario: Scenario,
        say: Callable[[str], None],
        progress: Callable[[float], None],
        *,
        memory: int = 0,
        flights: int = 1,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        """Args:
        scenario: what flies.
        say: gets one line, once.
        progress: called with the simulated time as well.
        memory: what it needs, bytes, said in the same line; 0 leaves it out.
        flights: so many fly one after the other, and the time goes on from one to the next.
        clock: the time in seconds.
        """
        self._scenario, self._say, self._progress = scenario, say, progress
        self._memory, self._flights, self._clock = memory, flights, clock
        self._begun_s, self._since = clock(), (0.0, 0.0)
        self.takes_s: float | None = None
        """The estimate, with the time before the first second; None until there is one."""
        self.measured_s: float | None = None
        """The simulated time at which it was made."""

    def __call__(self, t_s: float) -> None:
        self._progress(t_s)
        if self.takes_s is not None:
            return
        now_s, (since_t_s, since_s) = self._clock(), self._since
        if not since_t_s:
            self._since = (t_s if round(t_s) >= START_S else 0.0), now_s
        elif round(t_s - since_t_s) >= MEASURED_S and now_s - since_s >= MEASURED_WALL_S:
            left_s = self._flights * self._scenario.duration_s - t_s
            takes_s = now_s - self._begun_s + left_s * (now_s - since_s) / (t_s - since_t_s)
            self.takes_s, self.measured_s = takes_s, t_s
            if takes_s >= LONG_S and left_s > 0.0:
                self._say(self._words(takes_s, t_s))

    def _words(self, takes_s: float, t_s: float) -> str:
        n, times = self._scenario.fleet.drones, f"{self._flights} × " if self._flights > 1 else ""
        memory = f" and {_text(self._memory)} of memory" if self._memory else ""
        what = f"{n:,} drones for {times}{self._scenario.duration_s:g} s"
        return f"{what}: about {_duration(takes_s)}{memory} on this machine, estimated from the first {t_s:.0f} s"


def _duration(seconds: float) -> str:
    """`10 minutes`, `2.5 hours`"""
    if seconds < 5400.0:
        minutes = round(seconds / 60.0)
        return f"{minutes} minute{'s' if minutes != 1 else ''}"
    return f"{seconds / 3600.0:.1f} hours"
