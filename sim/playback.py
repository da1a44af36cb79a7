"""Playback in Rerun: a recording of the whole sortie, a viewer that follows it live, and the way to open either.

Saved and streamed sorties go through the same `Playback`; it reads tables and changes none.
Entity paths and colours: `sim.playback_scene`, `sim.playback_charts`; layout: `sim.playback_layout`.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb

from perception.scene import SceneModel
from scenarios.schema import Scenario
from sim.folders import RunError, partial_file
from sim.playback_canvas import Canvas, Floats
from sim.playback_charts import Charts
from sim.playback_comparison import comparison, roots
from sim.playback_layout import blueprint, legend
from sim.playback_scene import Drawing
from sim.record import SortieRecord
from sim.sightings import sightings

APPLICATION = "sortie"
START_TIMEOUT_S = 15.0
"""How long a viewer may take until it listens."""

Sink = Callable[[rr.RecordingStream, Scenario], None]
"""Connects a new recording to where it goes, with the layout for the scenario."""


class Playback:
    """Draws one sortie into a recording, all below `root`, from tables that come whole or second by second."""

    def __init__(self, recording: rr.RecordingStream, scenario: Scenario, scene: SceneModel, root: str = "") -> None:
        canvas = Canvas(recording, scenario.context.rate_hz, root)
        self._scene, self._charts = Drawing(canvas, scenario, scene), Charts(canvas, scenario)
        self._disc_t_s: Floats = np.zeros(0)
        self._discs: Floats = np.zeros((0, 3))
        if not root:
            recording.send_recording_name(f"{scenario.name} · {scenario.policy.name} · seed {scenario.seed}")
        canvas.static("about", legend(scenario))
        self._scene.begin()
        self._charts.begin()

    def add(self, known_s: float, new: Mapping[str, pa.Table]) -> None:
        """Draw new rows of every table; all that happened before `known_s` is in them or came before."""
        mission = new["mission"]
        discs = np.column_stack([mission[f"region_{k}"].to_numpy() for k in ("x_m", "y_m", "radius_m")])
        self._disc_t_s = np.concatenate([self._disc_t_s[-1:], mission["t_s"].to_numpy()])
        self._discs = np.concatenate([self._discs[-1:], discs])
        seen = list(sightings(new, self._disc_t_s, self._discs))
        self._scene.add(known_s, new, seen)
        self._charts.add(known_s, new, seen)


def save_rrd(record: SortieRecord, path: Path) -> None:
    """Save a sortie as a Rerun recording with its layout inside; written to a temporary name, then renamed.

    Raises:
        RunError: the file cannot be written.
    """
    with _new_file(path, blueprint(record.scenario)) as recording:
        Playback(recording, record.scenario, scene_of(record)).add(record.scenario.duration_s, record.tables)


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
    with _new_file(path, comparison(scenario, labels)) as recording:
        recording.send_recording_name(f"{scenario.name} · {' and '.join(labels)} · seed {scenario.seed}")
        for root, (_, record) in zip(roots(labels), flown, strict=True):
            playback = Playback(recording, record.scenario, scene_of(record), root)
            playback.add(record.scenario.duration_s, record.tables)


@contextmanager
def _new_file(path: Path, layout: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """A recording that becomes the file at `path` when all of it is drawn, and nothing where drawing fails."""
    partial = partial_file(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.open("wb").close()  # Rerun would tell of a bad path in a log line only
        recording = rr.RecordingStream(APPLICATION)
        recording.save(partial, default_blueprint=layout)
        yield recording
        recording.flush()
        recording.disconnect()
        partial.rename(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            partial.unlink()


def scene_of(record: SortieRecord) -> SceneModel:
    """The scene that the sortie flew over, made anew from its scenario and where it flew."""
    states, scenario = record.tables["states"], record.scenario
    x, y = states["x_m"].to_numpy(), states["y_m"].to_numpy()
    bounds = (float(x.min()), float(y.min()), float(x.max()), float(y.max()))
    return SceneModel(scenario.perception.scene, scenario.mission.target, bounds)


class LiveViewer:
    """A viewer that follows a sortie while it flies (sim.sortie.Observer).

    Args:
        sink: where the recording goes; left out, a viewer is started for it when the sortie begins.
    """

    def __init__(self, sink: Sink | None = None) -> None:
        self._sink = to_new_viewer if sink is None else sink
        self._recording: rr.RecordingStream | None = None
        self._playback: Playback | None = None

    def begin(self, scenario: Scenario, scene: SceneModel) -> None:
        """Connect, and draw what holds all the time.

        Raises:
            RunError: no viewer can be started.
        """
        self._recording = rr.RecordingStream(APPLICATION)
        self._sink(self._recording, scenario)
        self._playback = Playback(self._recording, scenario, scene)

    def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
        """Draw what is new since the last second."""
        if self._playback is not None:
            self._playback.add(t_s, new)

    def close(self) -> None:
        """Send what is still under way and let go of the recording."""
        if self._recording is not None:
            self._recording.flush()
            self._recording.disconnect()


def open_viewer(path: Path) -> None:
    """Open a recording in the viewer, and come back when it is closed (or has gone to one that was open already).

    Raises:
        RunError: no recording there, no viewer, no display, or a viewer that fails.
    """
    if not path.is_file():
        raise RunError(f"{path}: no recording there")
    command = [viewer_binary(), "--bind", "127.0.0.1", str(path)]
    _need_display(f"open {path} elsewhere, or in a browser: {command[0]} --web-viewer {path}")
    try:
        ended = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False)  # noqa: S603
    except OSError as error:
        raise RunError(f"{command[0]}: the viewer cannot be started: {error.strerror}") from error
    if ended.returncode:
        raise RunError(f"{path}: the viewer failed: {_last_line(ended.stderr)}")


def to_new_viewer(recording: rr.RecordingStream, scenario: Scenario) -> None:
    """Start a viewer on a free port of this machine and stream to it (a `Sink`).

    Raises:
        RunError: no viewer, no display, or one that does not come up.
    """
    binary = viewer_binary()
    _need_display("--live needs one; fly without it and see the recording elsewhere")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [binary, "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"]
    with tempfile.TemporaryFile() as said:
        try:
            viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True)  # noqa: S603
        except OSError as error:
            raise RunError(f"{binary}: the viewer cannot be started: {error.strerror}") from error
        up = listens(port, viewer)
        if viewer.poll() is not None or not up:
            end(viewer)
            said.seek(0)
            raise RunError(f"{binary}: the viewer does not come up: {_last_line(said.read())}")
    recording.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy", default_blueprint=blueprint(scenario, live=True))


def to_file(path: Path) -> Sink:
    """A sink that keeps the stream in a file, with the layout inside."""
    return lambda recording, scenario: recording.save(path, default_blueprint=blueprint(scenario))


def listens(port: int, viewer: subprocess.Popen[bytes]) -> bool:
    """Wait until the viewer takes connections, and half a second more, in which one without a window dies."""
    until = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < until and viewer.poll() is None:
        with socket.socket() as attempt:
            attempt.settimeout(0.2)
            if attempt.connect_ex(("127.0.0.1", port)) == 0:
                time.sleep(0.5)
                return True
        time.sleep(0.1)
    return False


def end(viewer: subprocess.Popen[bytes]) -> None:
    """End a viewer that was started in a session of its own: the `rerun` command is a script, and the viewer its child."""
    with suppress(ProcessLookupError):
        os.killpg(viewer.pid, signal.SIGKILL)
    viewer.wait()


def viewer_binary() -> str:
    """The `rerun` command beside this Python, or else on the path."""
    binary = shutil.which("rerun", path=str(Path(sys.executable).parent)) or shutil.which("rerun")
    if binary is None:
        raise RunError(f"no viewer: there is no rerun command beside {sys.executable} nor on the path")
    return binary


def _need_display(otherwise: str) -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RunError(f"no display to show a viewer on; {otherwise}")


def _last_line(said: bytes) -> str:
    lines = [line.strip() for line in re.sub(r"\x1b\[[0-9;]*m", "", said.decode(errors="replace")).splitlines()]
    return next((line for line in reversed(lines) if line), "it said nothing")
