"""A sortie drawn into a Rerun recording, and recordings as files.

Saved and streamed sorties (`sortie.sim.playback.viewer`) go through the same `Playback`; it reads tables and changes none.
Entity paths and colours: `sortie.sim.playback.scene`, `sortie.sim.playback.charts`; layout: `sortie.sim.playback.layout`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb

from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.schema import Scenario
from sortie.sim.folders import writing
from sortie.sim.playback.canvas import Canvas
from sortie.sim.playback.charts import Charts
from sortie.sim.playback.comparison import comparison, roots
from sortie.sim.playback.layout import blueprint, legend
from sortie.sim.playback.scene import Drawing
from sortie.sim.results import links
from sortie.sim.results.flown_scene import scene_of, vehicles
from sortie.sim.results.record import Recorder, SortieRecord
from sortie.sim.results.regions import Regions
from sortie.sim.results.sightings import sightings
from sortie.sim.results.spool import InTime, batches

APPLICATION = "sortie"
DRAWN = (
    "states",
    "people",
    "mission",
    "descriptors",
    "directives",
    "transmissions",
    "fusions",
    "detections",
    "truths",
    "ages",
    "medium",
    "receptions",
    "events",
)
"""The tables that a playback shows."""
BLOCK_DRONE_S = 600.0
"""So many drones times seconds are drawn at once, which takes some 100 MB."""


class Playback:
    """Draws one sortie into a recording, all below `root`, from tables that come whole or second by second."""

    def __init__(
        self, recording: rr.RecordingStream, scenario: Scenario, scene: SceneModel, root: str = "", name: str = ""
    ) -> None:
        """Args: `name` is the recording's; a sortie that still flies has its scenario's."""
        canvas = Canvas(recording, scenario.context.rate_hz, root)
        self._scene, self._charts = Drawing(canvas, scenario, scene), Charts(canvas, scenario)
        self._mission, self._groups = scenario.mission, len(scenario.mission.phases_of)
        self._missions = Recorder().take_new()["mission"]
        if not root:
            recording.send_recording_name(name or f"{scenario.name} · {scenario.policy.name}")
        canvas.static("about", legend(scenario))
        self._scene.begin()
        self._charts.begin()

    def add(self, known_s: float, new: Mapping[str, pa.Table]) -> None:
        """Draw new rows of every table; all that happened before `known_s` is in them or came before."""
        self._missions = pa.concat_tables(
            [self._missions.slice(max(0, len(self._missions) - self._groups)), new["mission"]]
        )
        seen = list(sightings(new, Regions(self._missions, self._mission)))
        self._scene.add(known_s, new, seen)
        self._charts.add(known_s, new, seen)


def save_rrd(record: SortieRecord, path: Path) -> None:
    """Save a sortie as a Rerun recording with its layout inside; written to a temporary name, then renamed.

    Raises:
        RunError: the file cannot be written.
    """
    scene = scene_of(record)
    x0, y0, x1, y1 = scene.rect
    layout = blueprint(record.scenario, spread_m=spread_m(record), town_m=(x1 - x0, y1 - y0))
    with new_file(path, layout) as recording:
        name = f"{record.scenario.name} · {record.policy} · seed {record.seed}"
        playback = Playback(recording, record.scenario, scene, name=name)
        for known_s, new in _in_blocks(record):
            playback.add(known_s, new)
            recording.flush()  # else what waits for the disk fills the memory


def save_comparison(flown: Sequence[tuple[str, SortieRecord]], path: Path) -> None:
    """Save sorties of one scenario side by side in one recording, each below its label's root (`roots`).

    Args:
        flown: each policy's label and its sortie; alike but for the policy.
        path: the recording.

    Raises:
        RunError: the file cannot be written.
    """
    labels = [label for label, _ in flown]
    scenario = flown[0][1].scenario
    with new_file(path, comparison(scenario, labels)) as recording:
        recording.send_recording_name(f"{scenario.name} · {' and '.join(labels)} · seed {flown[0][1].seed}")
        for root, (_, record) in zip(roots(labels), flown, strict=True):
            playback = Playback(recording, record.scenario, scene_of(record), root)
            for known_s, new in _in_blocks(record):
                playback.add(known_s, new)
                recording.flush()


def _in_blocks(record: SortieRecord) -> Iterator[tuple[float, dict[str, pa.Table]]]:
    """The rows that a playback draws, in blocks of whole seconds, and what is known by then."""
    end_s = record.scenario.duration_s
    block_s = max(1.0, BLOCK_DRONE_S // record.scenario.fleet.drones)
    drawn = [*DRAWN, *([links.TABLE] if links.TABLE in record.tables else [])]  # not in runs of 0.2.0
    rows = {name: InTime(record.tables, name, "t_done_s" if name == "transmissions" else "t_s") for name in drawn}
    known_s = 0.0
    while known_s < end_s:
        known_s = min(known_s + block_s, end_s)
        until_s = known_s if known_s < end_s else float("inf")
        yield known_s, {name: each.before(until_s) for name, each in rows.items()}


@contextmanager
def new_file(path: Path, layout: rrb.Blueprint, application: str = APPLICATION) -> Iterator[rr.RecordingStream]:
    """A recording that becomes the file at `path` when all of it is drawn, and nothing where drawing fails.

    Raises:
        RunError: the file cannot be written.
    """
    with writing(path) as partial:
        partial.open("wb").close()  # Rerun would tell of a bad path in a log line only
        recording = rr.RecordingStream(application)
        recording.save(partial, default_blueprint=layout)
        yield recording
        recording.flush()
        recording.disconnect()


def spread_m(record: SortieRecord) -> float:
    """How far the farthest drone flies from the middle of those in the air, in 19 of 20 frames."""
    n, flying = record.scenario.fleet.drones, vehicles(record.scenario.fleet)
    farthest = []
    for batch in batches(record.tables, "states", ["x_m", "y_m", "airborne"]):
        x, y, up = (column.to_numpy(zero_copy_only=False).reshape(-1, n)[:, flying] for column in batch.columns)
        xy = np.where(up[..., None], np.stack([x, y], axis=-1), np.nan)[up.any(axis=1)]
        if xy.size:
            away = np.linalg.norm(xy - np.nanmean(xy, axis=1, keepdims=True), axis=-1)
            farthest.append(np.nanmax(away, axis=1))
    return float(np.quantile(np.concatenate(farthest), 0.95)) if farthest else 0.0
