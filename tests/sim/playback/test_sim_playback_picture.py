"""The real viewer, without a screen: it draws a recording without complaint, and the picture is not blank."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.playback import picture
from sortie.sim.playback.picture import take_picture
from sortie.sim.playback.recording import save_comparison, save_rrd

DRIVERS = list(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))
needs_vulkan = pytest.mark.skipif(not DRIVERS, reason="no software Vulkan driver (Debian: mesa-vulkan-drivers)")


@needs_vulkan
@pytest.mark.slow
def test_the_viewer_draws_a_sortie_and_a_comparison_without_complaint(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    scenario = example("duration_s=5", "events=[{kind: link_drop, at_s: 3.5, drone: 2, loss_db: 60}]")
    one, other = run_sortie(scenario), run_sortie(scenario, "silence")
    save_rrd(one, tmp_path / "one.rrd")
    save_comparison([("worked", one), ("silence", other)], tmp_path / "both.rrd")
    for name in ("one", "both"):
        picture = tmp_path / f"{name}.png"
        assert take_picture(tmp_path / f"{name}.rrd", picture, 4.5, size=(640, 400)) == []
        seen = np.asarray(image.open(picture).convert("RGB"), np.int64)
        assert seen.shape == (400, 640, 3)
        scene = seen[40:200, 20:280].reshape(-1, 3)
        assert len(np.unique(scene // 16, axis=0)) > 30  # a town, not an empty panel
        assert ((scene[:, 1] > scene[:, 0] + 8) & (scene[:, 1] > scene[:, 2] + 8)).mean() > 0.03  # its lawns and trees


def test_no_viewer_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command is a script that starts the viewer: both have to go."""
    (tmp_path / "there.rrd").touch()
    fake, pid = tmp_path / "rerun", tmp_path / "pid"
    fake.write_text(f"#!/bin/sh\nsleep 600 &\necho $! > {pid}.part\nmv {pid}.part {pid}\nwait\n")
    fake.chmod(0o755)
    monkeypatch.setattr(picture, "viewer_binary", lambda: str(fake))

    def never(viewer: subprocess.Popen[bytes]) -> None:
        while not pid.exists():
            time.sleep(0.01)

    monkeypatch.setattr(picture, "port_of", never)
    with pytest.raises(RunError, match=r"it does not come up; .* mesa-vulkan-drivers\)$"):
        take_picture(tmp_path / "there.rrd", tmp_path / "p.png", 0.0)
    until_s = time.monotonic() + 600.0  # killed at once, but somebody has to collect it
    while alive(int(pid.read_text())):
        assert time.monotonic() < until_s
        time.sleep(0.01)


def alive(pid: int) -> bool:
    """Whether a process runs; one that is dead and not collected does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_what_cannot_be_pictured_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RunError, match=r"gone\.rrd: no recording there$"):
        take_picture(tmp_path / "gone.rrd", tmp_path / "p.png", 0.0)
    (tmp_path / "there.rrd").touch()
    with pytest.raises(RunError, match=r"nowhere/p\.png: its folder does not exist$"):
        take_picture(tmp_path / "there.rrd", tmp_path / "nowhere" / "p.png", 0.0)
    fake = tmp_path / "rerun"
    fake.write_text("#!/bin/sh\necho 'wgpu: no suitable graphics adapter' >&2\nexit 3\n")
    fake.chmod(0o755)
    monkeypatch.setattr(picture, "viewer_binary", lambda: str(fake))
    with pytest.raises(RunError, match=r"there\.rrd: no Vulkan driver; .*apt install mesa-vulkan-drivers\)$"):
        take_picture(tmp_path / "there.rrd", tmp_path / "p.png", 0.0)
    assert not (tmp_path / "p.png").exists()
