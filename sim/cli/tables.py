"""Tables of `sortie check` and `sortie fly --profile` for the terminal."""

from __future__ import annotations

import cProfile
import pstats
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from sortie.sim.check.expectations import Verdict

ROOMS = ("sim", "fleet", "radio", "policies", "perception", "scenarios")


def verdict_table(name: str, verdicts: Sequence[Verdict]) -> Table:
    """A scenario's expectations, held or not."""
    table = Table(title=name, caption=None if verdicts else "this scenario expects nothing")
    for column in ("", "expected", "got", "because"):
        table.add_column(column, overflow="fold")
    for v in verdicts:
        because = Text(v.because).append(f"\nthe record: {v.explanation}" if v.explanation else "", "dim")
        verdict = Text("ok", "green") if v.holds else Text("FAILED", "red")
        table.add_row(verdict, v.expected, v.got, because)
    return table


def profile_table(profiler: cProfile.Profile, result: dict[str, Any]) -> Table:
    """Share of the wall time spent in each room's own code and in libraries, profiler's overhead included."""
    root = Path(__file__).parents[2]
    spent: dict[str, float] = {}
    for (file, _, _), (_, _, own_s, _, _) in pstats.Stats(profiler).stats.items():  # type: ignore[attr-defined]
        path = Path(file)
        room = path.relative_to(root).parts[0] if path.is_absolute() and path.is_relative_to(root) else ""
        if room not in ROOMS:
            room = next((p for p in ("simpy", "torch", "numpy", "scipy", "pyarrow") if p in file), "other libraries")
        spent[room] = spent.get(room, 0.0) + own_s
    total = sum(spent.values())
    table = Table(title=f"where {result['wall_s']:.2f} s went (profiled: about twice the plain time)")
    table.add_column("code")
    table.add_column("own time", justify="right")
    table.add_column("share", justify="right")
    for room, own_s in sorted(spent.items(), key=lambda s: -s[1]):
        table.add_row(room, f"{own_s:.2f} s", f"{100 * own_s / total:.1f} %")
    return table
