"""Where drones are, and the fades of their links, to test the radio with."""

from __future__ import annotations

import numpy as np
import simpy
from numpy.typing import NDArray

from sortie.radio.mac.jobs import AirJob, GroupFrame
from sortie.radio.mac.medium import Medium
from sortie.radio.settings import AirSettings

CROSS_M = np.array([[0, 0, 60], [20, 0, 60], [-20, 0, 60], [0, 20, 60], [0, -20, 60], [40, 0, 60]], float)
"""[6, 3] ENU: five in a cross of 20 m, and one further out."""


def still(positions_m: NDArray[np.float64], frames: int = 20_000) -> NDArray[np.float64]:
    """A flight [frames, N, 3] in which nobody moves."""
    return np.broadcast_to(positions_m, (frames, *positions_m.shape))


def tilting(frames: int, n: int) -> NDArray[np.float64]:
    """[frames, n, 3]: every drone's own axis, another in every frame."""
    k, i = np.arange(frames)[:, None], np.arange(n)
    tilt, turn = 0.2 + 0.5 * np.sin(0.05 * k + i) ** 2, 0.11 * k + 2.0 * i
    return np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=-1)


def moving(frames: int, n: int) -> NDArray[np.float64]:
    """[frames, n, 3]: a row that spreads, at several heights."""
    k, i = np.arange(frames)[:, None], np.arange(n)
    return np.stack([i * 30.0 + 0.03 * k * i, 5.0 * np.sin(0.02 * k + i), 40.0 + 7.0 * i + 0.0 * k], axis=-1)


def fades_db(settings: AirSettings, n: int, frames: int, seed: int = 1, per_frame: int = 1) -> np.ndarray:
    """[frames, n, n]: fades of group frames that stations send in turn, by sender and receiver; NaN to itself.

    Args: `per_frame`: how many a station sends within one frame of the flight.
    """
    env = simpy.Environment()
    gain = 1e6
    found: list[list[np.ndarray]] = [[] for _ in range(n)]

    def end(frame: GroupFrame, receivers: np.ndarray, fates: bytes) -> None:
        power = medium._settled.arrays[3].reshape(n, n)[frame.sender]  # as the kernel has it of the last frame
        found[frame.sender].append(10.0 * np.log10(np.where(np.arange(n) == frame.sender, np.nan, power / gain)))

    medium = Medium[AirJob, GroupFrame](env, settings, n, seed, 0, -88.0, lambda *_: None, lambda *_: None, end)
    begin, receiver = np.arange(n + 1) * n, np.tile(np.arange(n), n)
    for k in range(frames):
        medium.set_links(begin, receiver, np.full(n * n, gain), frame=k // per_frame)
        for sender in range(n):
            medium.announce(GroupFrame(sender, 1e-4, 334), 1e-3 * sender)
        env.run(until=(k + 1) * 1e-3 * n)
    return np.array(found).swapaxes(0, 1)
