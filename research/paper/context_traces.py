"""The paper's 120 s context traces as files: what they hold, and how they are made.

    python -m research.paper.context_traces [FOLDER]     writes the four tables of `FILES`

The paper replays traces that hold a mission's phase change, a battery's decay and a drop of link quality; its text
gives when they happen and what policies do then, and its own files are not to be had. These are made from that text;
what it leaves open is chosen here and said in the traces' README. The files are data: they stay as they are.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sortie.scenarios.shipped import TRACES
from sortie.scenarios.streams import stream

PAPER_120S = TRACES / "paper_120s"
DRONES, DURATION_S = 4, 120
STEADY_DRONES = 5
"""Of paper_replay, which flies a whole cross."""
PHASE_CHANGE_S, LINK_DROP_S = 45, 60
TIRED, CUT_OFF = 1, 2
REGION_RADIUS_M = 32.0

TIRED_SOC, TIRED_PER_S = 0.79, 0.0054
"""Through 60 % at 35 s and 30 % at 91 s."""
SOC, PER_S = (0.95, None, 0.92, 0.88), 0.0226 / 60
"""The others, at the 2.26 % a minute of a research drone's logged flight (99 to 38 % in 27 minutes)."""
GOOD_MBPS, DROPPED_MBPS = 400.0, 3.0
"""About what 802.11ax carries alone over 20 m in 80 MHz; and less than the 5 Mb/s below which the paper's policy steps down."""
SPREAD, KEEP = 0.12, 0.8
"""Of the logarithm of goodput; its correlation over a second, as flown shadowing has it."""
START_X_M, LANE_Y_M, SPEED_MPS = -240.0, -1.75, 5.0
"""The car that is tracked: from there, east."""

Row = tuple[float | int | str, ...]


def drone_rows() -> Iterable[Row]:
    """t_s, drone, soc: every ten seconds, linear in between."""
    for t_s in range(0, DURATION_S + 1, 10):
        for drone, soc in enumerate(SOC):
            yield t_s, drone, round(TIRED_SOC - TIRED_PER_S * t_s if soc is None else soc - PER_S * t_s, 4)


def link_rows(seed: int = 1) -> Iterable[Row]:
    """t_s, sender, receiver, goodput_mbps: every second, and the drop within a tenth of one."""
    for i in range(DRONES):
        for j in range(DRONES):
            if i == j:
                continue
            z = stream(seed, 0, (i, j), "context trace").standard_normal(DURATION_S + 1)
            level = z[0]
            for t_s in range(DURATION_S + 1):
                level = z[0] if t_s == 0 else KEEP * level + float(np.sqrt(1 - KEEP**2)) * z[t_s]
                swing = float(np.exp(SPREAD * level))
                if CUT_OFF in (i, j) and t_s == LINK_DROP_S:
                    yield t_s - 0.1, i, j, round(GOOD_MBPS * swing, 1)
                dropped = CUT_OFF in (i, j) and t_s >= LINK_DROP_S
                yield t_s, i, j, round((DROPPED_MBPS if dropped else GOOD_MBPS) * swing, 1)


def steady_link_rows() -> Iterable[Row]:
    """The same of five drones, without swings: a row a link, and two more at the drop."""
    for i in range(STEADY_DRONES):
        for j in range(STEADY_DRONES):
            if CUT_OFF in (i, j) and i != j:
                yield LINK_DROP_S - 0.1, i, j, GOOD_MBPS
                yield LINK_DROP_S, i, j, DROPPED_MBPS
            elif i != j:
                yield 0, i, j, GOOD_MBPS


def mission_rows() -> Iterable[Row]:
    """t_s, phase and the region of responsibility: every second; no region while searching."""
    for t_s in range(DURATION_S + 1):
        if t_s < PHASE_CHANGE_S:
            yield t_s, "search", "", "", ""
        else:
            yield t_s, "track", START_X_M + SPEED_MPS * t_s, LANE_Y_M, REGION_RADIUS_M


FILES = {
    "drones.csv": (("t_s", "drone", "soc"), drone_rows),
    "links.csv": (("t_s", "sender", "receiver", "goodput_mbps"), link_rows),
    "steady_links.csv": (("t_s", "sender", "receiver", "goodput_mbps"), steady_link_rows),
    "mission.csv": (("t_s", "phase", "region_x_m", "region_y_m", "region_radius_m"), mission_rows),
}


def text(name: str) -> str:
    """One file's text."""
    columns, rows = FILES[name]
    lines: list[Sequence[object]] = [columns, *rows()]
    return "".join(",".join(map(str, line)) + "\n" for line in lines)


def main(folder: Path = PAPER_120S) -> None:
    """Write them, each to a temporary name first."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        new = folder / f".{name}.new"
        new.write_text(text(name), "utf-8")
        new.replace(folder / name)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
