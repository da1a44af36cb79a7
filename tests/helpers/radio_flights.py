"""A fleet that hovers, to fly the air with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import simpy
from radio_examples import CROSS_M, still

from sortie.radio import Air, Transmission
from sortie.radio.settings import AirSettings


class Hover:
    """Drones that stand still; `tick` is called in every frame after the links have moved on."""

    def __init__(
        self,
        config: AirSettings,
        positions_m: np.ndarray | None = None,
        *,
        n: int = 2,
        seed: int = 1,
        spread: float = 0.8,
        replication: int = 0,
    ) -> None:
        at = CROSS_M[:n] if positions_m is None else positions_m
        self.n = len(at)
        self.env = simpy.Environment()
        self.air = Air(
            self.env, config, still(at, 400_000), seed=seed, replication=replication, frame_s=0.1, publish_spread=spread
        )
        self.rows: list[Transmission] = []
        self.heard: list[tuple[float, int, tuple[int, ...]]] = []
        self.extra: np.ndarray | None = None

    def send(self, sender: int, receiver: int, payload: int, **how) -> int:  # type: ignore[no-untyped-def]
        how = {"kind": "f", "reliable": False, "deadline_s": 0.09} | how
        return self.air.send(sender, receiver, payload, on_done=self.rows.append, **how)

    def publish(self, sender: int) -> None:
        self.air.broadcast(sender, 208, lambda ids: self.heard.append((self.env.now, sender, tuple(ids))))

    def fly(self, duration_s: float, tick: Callable[[int], object] = lambda frame: None) -> Hover:
        def frames() -> simpy.events.ProcessGenerator:
            for k in range(round(duration_s * 10)):
                if k:
                    yield self.env.timeout(k / 10 - self.env.now)
                self.air.advance(self.extra)
                tick(k)

        self.env.process(frames())
        self.env.run(until=duration_s)
        return self


def trace(folder: Path, *rows: str, columns: str = "t_s,sender,receiver,snr_db,loss,goodput_mbps") -> str:
    """A link trace's file."""
    path = folder / "links.csv"
    path.write_text("\n".join([columns, *rows]) + "\n")
    return str(path)
