"""Stations on a medium, each link of a given power, to test channel access with."""

from __future__ import annotations

from math import inf

import numpy as np
import simpy

from sortie.radio.mac.airtime import ppdu_s
from sortie.radio.mac.contention import SIFS_S, SLOT_S
from sortie.radio.mac.jobs import AirJob, End, GroupFrame
from sortie.radio.mac.medium import Link, Medium
from sortie.radio.settings import AirSettings

NOISE_DBM = -88.0
FRAME = 1494
GROUP_S = 472e-6


AIFS_S = {"voice": SIFS_S + 2 * SLOT_S, "best_effort": SIFS_S + 3 * SLOT_S}


class Bench:
    """Stations with a given power at one another, dBm; every link at one MCS."""

    def __init__(
        self, power_dbm: np.ndarray | float, n: int = 3, *, mcs: int = 7, seed: int = 1, **knobs: object
    ) -> None:
        self.env = simpy.Environment()
        power = np.full((n, n), power_dbm) if np.isscalar(power_dbm) else np.asarray(power_dbm, float)
        self.n = n = len(power)
        config = AirSettings(**{"rician_k_db": 40.0, **knobs})
        self.medium = Medium[AirJob, GroupFrame](
            self.env, config, n, seed, 0, NOISE_DBM, lambda job, now: None, self._end, self._group_end
        )
        gain = 10.0 ** ((power - NOISE_DBM) / 10.0)
        self.medium.set_links(np.arange(n + 1) * n, np.tile(np.arange(n), n), gain.ravel(), frame=0)
        self.mcs, self.jobs = mcs, 0
        self.log: list[tuple[float, int, End]] = []
        self.heard: list[tuple[float, int, tuple[int, ...]]] = []
        self.again: set[int] = set()
        self.to: dict[int, int] = {}
        self.arrived = np.zeros(n)

    def _end(self, job: AirJob, how: End, now_s: float) -> None:
        self.log.append((now_s, job.number, how))
        self.arrived[job.sender] += job.arrived_frames
        if job.sender in self.again:
            self.submit(job.sender, job.frames)

    def _group_end(self, frame: GroupFrame, receivers: np.ndarray, fates: bytes) -> None:
        assert receivers.tolist() == list(range(self.n))
        self.heard.append((self.env.now, frame.sender, tuple(f for j, f in enumerate(fates) if j != frame.sender)))

    def job(self, sender: int, frames: int = 4, deadline_s: float = inf, to: int | None = None) -> AirJob:
        job = AirJob(self.jobs, sender, self.env.now + deadline_s)
        self.jobs += 1
        self.to[sender] = self.to.get(sender, (sender + 1) % self.n) if to is None else to
        job.flow = self.medium.flow(sender, self.to[sender])
        self.medium.tune(job.flow, Link(self.mcs))
        job.frames, job.full_bytes, job.last_bytes = frames, FRAME, FRAME
        return job

    def submit(self, sender: int, frames: int = 4, deadline_s: float = inf, to: int | None = None) -> AirJob:
        job = self.job(sender, frames, deadline_s, to)
        self.medium.submit(job)
        return job

    def announce(self, sender: int, in_s: float = 0.0, length: int = 334) -> None:
        self.medium.announce(GroupFrame(sender, GROUP_S, length), in_s)

    def saturate(self, senders: int, frames: int, until: float) -> float:
        """Mb/s of fragments at their receivers, of senders that always have more."""
        self.again = set(range(senders))
        for i in range(senders):
            self.submit(i, frames)
        self.env.run(until=until)
        held = sum(self.medium.in_service(i).arrived_frames for i in range(senders))
        return float(self.arrived.sum() + held) * 1344 * 8e-6 / until

    def run(self, until: float = 10.0) -> None:
        self.env.run(until=until)


def exchange_s(frames: int, mcs: int = 7) -> float:
    """The frame alone, without its answer."""
    rate = (36.0, 72.1, 108.1, 144.1, 216.2, 288.2, 324.3, 360.3)[mcs]
    return ppdu_s(frames * (FRAME + 6), rate)
