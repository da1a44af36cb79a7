"""Fusions that two arms of recorded sorties both scored, side by side."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sortie.perception.metrics.ap import Matched
from sortie.sim.experiment.compare import BLOCK_S
from sortie.sim.results.accuracy import matched
from sortie.sim.results.record import SortieRecord


def pair_up(
    a: Sequence[SortieRecord],
    b: Sequence[SortieRecord],
    *,
    mission: bool,
    begin_s: float = 0.0,
    leaving_out: Collection[int] = (),
) -> tuple[list[Matched], list[Matched], list[int]]:
    """Fusions that two arms of sorties both scored, and the block of `BLOCK_S` of its sortie that each is in.

    Args:
        a, b: records in pairs.
        mission, begin_s: as for `matched`.
        leaving_out: drones that are not counted.
    """
    first: list[Matched] = []
    second: list[Matched] = []
    groups: list[int] = []
    blocks: dict[tuple[int, float], int] = {}
    for k, (one, other) in enumerate(zip(a, b, strict=True)):
        ours, theirs = (matched(r, mission=mission, begin_s=begin_s) for r in (one, other))
        for t_s, drone in ours:
            if (t_s, drone) in theirs and drone not in leaving_out:
                first.append(ours[t_s, drone])
                second.append(theirs[t_s, drone])
                groups.append(blocks.setdefault((k, t_s // BLOCK_S), len(blocks)))
    return first, second, groups
