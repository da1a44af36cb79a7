"""The Rerun viewer: started on a recording, or on a sortie while it flies."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import pyarrow as pa
import rerun as rr

from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.schema import Scenario
from sortie.sim.folders import RunError
from sortie.sim.playback.layout import blueprint
from sortie.sim.playback.recording import APPLICATION, Playback

Sink = Callable[[rr.RecordingStream, Scenario], None]
"""Connects a new recording to where it goes, with the layout for the scenario."""
START_TIMEOUT_S = 300.0
"""How long a viewer may take until it listens: a busy machine takes minutes."""


class LiveViewer:
    """A viewer that follows a sortie while it flies (sortie.sim.engine.sortie.Observer).

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
    _need_display(f"open {path} elsewhere, or in a browser: {command[0]} --web-viewer --bind 127.0.0.1 {path}")
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
    command = [binary, "--bind", "127.0.0.1", "--port", "0", "--hide-welcome-screen"]
    with tempfile.TemporaryFile() as said:
        try:
            viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True)  # noqa: S603
        except OSError as error:
            raise RunError(f"{binary}: the viewer cannot be started: {error.strerror}") from error
        port = port_of(viewer)
        if viewer.poll() is not None or port is None:
            end(viewer)
            said.seek(0)
            raise RunError(f"{binary}: the viewer does not come up: {_last_line(said.read())}")
    recording.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy", default_blueprint=blueprint(scenario, live=True))


def to_file(path: Path) -> Sink:
    """A sink that keeps the stream in a file, with the layout inside."""
    return lambda recording, scenario: recording.save(path, default_blueprint=blueprint(scenario))


def port_of(viewer: subprocess.Popen[bytes]) -> int | None:
    """The port that the system gave a viewer, once it listens; None if it ends before.

    It waits half a second more, in which a viewer without a window dies.
    """
    until = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < until and viewer.poll() is None:
        for found in psutil.net_connections("tcp4"):
            # the command is a script, and the viewer its child in the same session
            if found.status == psutil.CONN_LISTEN and found.pid is not None and _session_of(found.pid) == viewer.pid:
                time.sleep(0.5)
                return int(found.laddr.port)
        time.sleep(0.1)
    return None


def _session_of(pid: int) -> int | None:
    try:
        return os.getsid(pid)
    except ProcessLookupError:
        return None


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
