"""What Sortie costs, on one page (`make bench`): each figure beside its peer's, and beside the last release's.

    python -m research.validation.bench_page [--gradys PYTHON] [--release]

All figures are processor seconds, the least of several runs in one process. A peer runs in the same call, so that their
ratio holds for this machine: ns-3 where its wheel and g++ are installed (`make ns3`), GrADyS-SIM where `gradysim` is
installed here or for the interpreter that `--gradys` names. The last release's seconds lie in `release.json`; they are
scaled by how fast this machine adds numbers. `--release` writes that file.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from research.validation.stored import ROOT, Cell, Column, Table

HERE = Path(__file__).resolve().parent
RELEASE = HERE / "release.json"

RUNS = 3
GRADYS_DRONES, GRADYS_FRAMES = 100, 50


class Item(NamedTuple):
    """One figure."""

    what: str
    run: Callable[[], Any]
    simulated_s: float
    """Simulated seconds of a run; 0 where nothing is simulated."""
    peer: str = ""
    peer_s: Callable[[], float | None] = lambda: None
    """Processor seconds of the peer for the same; None where it is not installed."""


def items(gradys: str | None) -> list[Item]:
    """What is measured.

    Args:
        gradys: a Python that has GrADyS-SIM; None leaves it out.
    """
    sys.path[:0] = [str(ROOT / "tests" / folder) for folder in ("benchmarks", "helpers")]
    from test_bench_radio import _descriptors
    from test_bench_surrogate import moments

    from research.validation.ns3.wifi_compare import LOADS, through_air
    from sortie.perception.network.detector import TorchDetector
    from sortie.perception.scene.scene_model import SceneModel
    from sortie.radio import AirSettings
    from sortie.scenarios.reading.load import load
    from sortie.scenarios.schema import Perception, Scene
    from sortie.sim.engine.sortie import run_sortie

    def sortie(detector: str, drones: int, seconds: float) -> Item:
        sets = [f"perception.detector={detector}", f"fleet.drones={drones}", f"duration_s={seconds}"]
        if drones > 5:
            sets.append("fleet.formation={shape: grid, spacing_m: 20, altitude_m: 60}")
        scenario = load("track_target", [*sets, "mission.phases=[{at_s: 0, phase: search}]"])
        by = "no detector" if detector == "none" else detector
        return Item(f"a sortie of {drones} drones, {seconds:g} s, {by}", lambda: run_sortie(scenario), seconds)

    torch = TorchDetector(SceneModel(Scene(), None, (-50, -50, 50, 50)), Perception(), 1)
    begins = iter(range(1, 10_000, 5))
    radio = [
        Item(f"radio: {c.name}, {c.stop_s:g} s", lambda c=c: through_air(c, 1), c.stop_s, "ns-3", lambda c=c: _ns3(c))  # type: ignore[misc]
        for c in (LOADS[k] for k in (0, 2, 8, 13))
    ]
    frames_s = GRADYS_FRAMES * 0.1
    return [
        Item(
            f"radio: descriptors of {GRADYS_DRONES} drones, {frames_s:g} s",
            lambda: _descriptors(GRADYS_DRONES, GRADYS_FRAMES, AirSettings()), frames_s, "GrADyS-SIM", lambda: _gradys(gradys),
        ),
        *radio,
        sortie("none", 5, 120), sortie("none", 25, 12), sortie("none", 100, 4), sortie("surrogate", 5, 120),
        Item("torch detector: five drones, one moment", lambda: [torch.detect(j) for j in moments(1, next(begins))], 0.0),
    ]  # fmt: skip


def _ns3(case: Any) -> float | None:
    from research.validation.ns3.wifi_compare import through_ns3
    from research.validation.ns3.wifi_ns3 import Ns3Missing

    try:
        return through_ns3(case, 1)["cpu_s"]
    except Ns3Missing:
        return None


def _gradys(python: str | None) -> float | None:
    if python is None:
        return None
    words = [python, str(HERE / "gradys_fleet.py"), f"{GRADYS_DRONES}", f"{GRADYS_FRAMES * 0.1}"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[0])


def measure(items: list[Item], told: Callable[[str], None]) -> dict[str, tuple[float, float | None]]:
    """Least processor seconds of each item and of its peer; `told` hears which one is running."""
    found = {}
    for item in items:
        told(item.what)
        item.run()  # what is compiled or loaded at its first use is no part of it
        times = []
        for _ in range(RUNS):
            begin_s = time.process_time()
            item.run()
            times.append(time.process_time() - begin_s)
        found[item.what] = min(times), item.peer_s()
    return found


def page(
    items: list[Item], found: dict[str, tuple[float, float | None]], release: dict[str, Any], host_s: float
) -> Table:
    """The page.

    Args:
        release: `release.json`; empty for none.
        host_s: seconds that this machine takes for a million additions.
    """
    scale = host_s / release["host_s"] if release else 1.0
    columns = [
        Column("what"), Column("Sortie", ".3f", " s"), Column("times as fast as real time", ".1f"), Column("peer"),
        Column("peer's", ".3f", " s"), Column("times as fast as the peer", ".1f"),
        Column(f"time relative to {release.get('sortie', 'the last release')}", ".2f"),
    ]  # fmt: skip
    rows: list[list[Cell]] = []
    for item in items:
        own_s, peer_s = found[item.what]
        before_s = release.get("seconds", {}).get(item.what)
        rows.append([
            item.what, own_s, item.simulated_s / own_s if item.simulated_s else None, item.peer or None, peer_s,
            peer_s / own_s if peer_s else None, own_s / (before_s * scale) if before_s else None,
        ])  # fmt: skip
    missing = sorted({i.peer for i in items if i.peer and found[i.what][1] is None})
    about = f"Processor seconds, the least of {RUNS} runs; peers ran in the same call."
    if missing:
        about += f" Not installed here: {', '.join(missing)}."
    return Table(columns, rows, about)


def measured(
    gradys: str | None = None, told: Callable[[str], None] = lambda what: None
) -> tuple[Table, dict[str, Any]]:
    """Measure all; returns the page and what `--release` writes."""
    import sortie
    from research.overhead.overhead import host_s

    if gradys is None and importlib.util.find_spec("gradysim"):
        gradys = sys.executable
    every, host = items(gradys), host_s()
    found = measure(every, told)
    host = min(host, host_s())
    before = json.loads(RELEASE.read_text("utf-8")) if RELEASE.exists() else {}
    now = {"sortie": sortie.__version__, "host_s": host, "seconds": {what: own for what, (own, _) in found.items()}}
    return page(every, found, before, host), now


def _told(what: str) -> None:
    sys.stderr.write(f"{what}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gradys", metavar="PYTHON", help="an interpreter that has gradysim")
    parser.add_argument("--release", action="store_true", help="keep the seconds as those of this release")
    asked = parser.parse_args()
    table, now = measured(asked.gradys, _told)
    sys.stdout.write(f"{table.markdown()}\n")
    if asked.release:
        RELEASE.write_text(json.dumps(now, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
