"""A picture of a recording as the real viewer shows it, without a screen: the viewer renders in software and is asked for it.

Needs a Vulkan driver that renders on the CPU (Debian: `mesa-vulkan-drivers`). Chunks of a recording load while the
viewer paints, and pixels differ from run to run: two pictures in a row that are alike are taken for a finished one.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from sortie.sim.folders import RunError
from sortie.sim.playback.canvas import SIM_TIME
from sortie.sim.playback.viewer import end, port_of, viewer_binary

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

SIZE = (1920, 1080)
_DRIVER = "it needs a Vulkan driver that renders on the CPU (Debian, Ubuntu: apt install mesa-vulkan-drivers)"
PATIENCE_S = 600.0
"""How long the viewer may take to load the recording and to paint it."""


def take_picture(recording: Path, picture: Path, at_s: float, *, size: tuple[int, int] = SIZE) -> list[str]:
    """Show a recording at a simulated time in a viewer without a window, and save what it shows as PNG.

    Returns:
        What views had to complain about; empty where all is drawn.

    Raises:
        RunError: no recording, no viewer, no driver to render with, or a picture that does not come.
    """
    if not recording.is_file():
        raise RunError(f"{recording}: no recording there")
    if not picture.absolute().parent.is_dir():
        raise RunError(f"{picture}: its folder does not exist")
    command = [
        viewer_binary(),
        "--headless",
        "--bind",
        "127.0.0.1",
        "--port",
        "0",
        "--window-size",
        f"{size[0]}x{size[1]}",
        str(recording.absolute()),
    ]
    with tempfile.TemporaryFile() as said:
        viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True)  # noqa: S603
        try:
            port = port_of(viewer)
            if port is None:
                raise RuntimeError(f"it does not come up; {_DRIVER}")
            return _ask(port, picture, at_s)
        except (RuntimeError, TimeoutError, ConnectionError) as error:
            said.seek(0)
            raise RunError(f"the viewer gives no picture of {recording}: {_why(said.read()) or error}") from error
        finally:
            end(viewer)


def _ask(port: int, picture: Path, at_s: float) -> list[str]:
    """Go to the time, wait until all is painted, and save it."""
    from rerun.experimental import ViewerClient

    viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
    until_s = time.monotonic() + PATIENCE_S
    while not _loaded(viewer):
        if time.monotonic() > until_s:
            raise RuntimeError("the recording does not load")
        time.sleep(0.2)
    viewer.run_command("ui.toggle_top_panel")  # its menu says nothing of the sortie
    viewer.set_time(SIM_TIME, duration=at_s, play_state="paused")
    before = now = b""
    with tempfile.TemporaryDirectory() as folder:
        attempt = Path(folder) / "picture.png"
        while time.monotonic() < until_s and (not now or now != before):
            time.sleep(0.5)
            with suppress(TimeoutError):  # a slow machine may need longer than the viewer waits for itself
                viewer.save_screenshot(str(attempt))
                before, now = now, attempt.read_bytes()
    if not now:
        raise RuntimeError(f"it does not paint; {_DRIVER}")
    picture.write_bytes(now)
    return [f"{view.name}: {report}" for view in viewer.get_state().views for report in view.reports]


def _loaded(viewer: ViewerClient) -> bool:
    """Whether the viewer shows a recording and waits for none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an interface that may change
        state = viewer.get_state()
    return bool(state.active_recording and state.views and not state.loading)


def _why(said: bytes) -> str:
    """What a viewer that died gave as its reason, if it can render nothing at all."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", said.decode(errors="replace"))
    if (
        re.search(r"no (suitable|compatible)? ?(graphics|gpu|adapter)|adapter", text, re.IGNORECASE)
        and "llvmpipe" not in text
    ):
        return f"no Vulkan driver; {_DRIVER}"
    return ""
