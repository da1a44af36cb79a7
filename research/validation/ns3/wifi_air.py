"""Runs a plan through `sortie.radio.Air`, with every link at one MCS."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
import simpy

from research.validation.ns3.wifi_plan import FRAGMENT_BYTES, FRAME_S, FloatArray, Plan
from sortie.radio import Air, AirSettings
from sortie.radio.channel.snr import Channel
from sortie.radio.event_loop import EventLoop
from sortie.radio.transmission import Transmission

QUIET: dict[str, Any] = {"shadowing_sigma_db": 0.0, "rician_k_db": 40.0}
FADING: dict[str, Any] = {"shadowing_sigma_db": 3.5, "rician_k_db": 12.0}
_BURST_BYTES = FRAGMENT_BYTES * 64


def pin(air: Air, mcs: int) -> None:
    """Send on every link at one MCS, whatever its SNR."""
    service = air._service
    table, rate = service._table, service._rates[mcs]
    service._table = dataclasses.replace(
        table, mcs=(mcs,) * len(table.mcs), rate_mbps=(rate,) * len(table.mcs), mean_per=table.all_per[mcs]
    )
    service._mbps_at = None


def shadowing_db(positions_m: FloatArray, stop_s: float, seed: int, **settings: Any) -> FloatArray:
    """[frames, N, N]: the shadowing that the Air draws, as dB on the SNR."""
    frames = round(stop_s / FRAME_S) + 1
    at = np.broadcast_to(positions_m, (frames, *positions_m.shape))
    channel = Channel(AirSettings(**settings), at, seed, 0, FRAME_S)
    out = []
    for _ in range(frames):
        channel.advance()
        out.append(np.nan_to_num(channel.shadow_db))
    return np.array(out)


class _Saturated:
    """A flow that always has more to send: two kinds by turns, so that one always waits behind the other."""

    def __init__(self, air: Air, flow: int, sender: int, receiver: int) -> None:
        self._air, self._flow, self._pair = air, flow, (sender, receiver)
        self.bytes = 0.0
        for k in range(2):
            self._again(k)

    def _again(self, k: int, row: Transmission | None = None) -> None:
        if row is not None and row.reason in ("", "fragment_lost"):
            self.bytes += row.payload_bytes * (1.0 - row.fragments_lost / row.fragments)
        self._air.send(
            *self._pair, _BURST_BYTES, kind=f"s{self._flow}.{k}", reliable=False, deadline_s=1e6,
            on_done=lambda row: self._again(k, row),
        )  # fmt: skip


def _feed(env: simpy.Environment, rows: Sequence[tuple[Any, ...]], give: Callable[..., None]) -> None:
    """Hand each row over at its time, which is its first value; rows are in order of time."""
    following = iter(rows)

    def on(event: simpy.Event | None) -> None:
        if event is not None:
            give(*event.value)
        now_s = env.now
        for row in following:
            if row[0] > now_s:
                env.timeout(row[0] - now_s, row).callbacks.append(on)
                return
            give(*row)

    on(None)


def run_air(
    plan: Plan, warm_s: float, stop_s: float, *, mcs: int | None = None, seed: int = 1, **settings: Any
) -> dict[str, Any]:
    """One run; what it returns is as for `wifi_ns3.run_ns3`.

    Args: `mcs` for every link, None is the Air's rate control; `settings` of `AirSettings`.
    """
    frames, n = round(stop_s / FRAME_S) + 1, len(plan.positions_m)
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    env = EventLoop()
    at = np.broadcast_to(plan.positions_m, (frames, n, 3))
    air = Air(env, AirSettings(**settings), at, seed=seed, frame_s=FRAME_S, publish_spread=0.0)
    if mcs is not None:
        pin(air, mcs)
    rows: list[Transmission] = []
    heard: list[tuple[float, int, float, Sequence[int]]] = []
    flows: list[_Saturated] = []
    marks: dict[str, Any] = {}

    descriptors = plan.descriptors[::-1]

    def publish(until_s: float) -> None:
        """Hand over a frame's descriptors, as a fleet does: each waits in its drone until its time."""
        while descriptors and descriptors[-1][0] < until_s:
            t, s, size = descriptors.pop()
            in_s = max(0.0, t - env.now)
            air.broadcast(s, size, lambda ids, t=t, s=s: heard.append((t, s, env.now - t, ids)), in_s)

    def payload(_: float, s: int, r: int, size: int) -> None:
        air.send(s, r, size, kind="features", reliable=False, deadline_s=FRAME_S, on_done=rows.append)

    def clock() -> Iterator[simpy.Event]:
        for k in range(frames - 1):
            air.advance()
            if k == 0:
                flows.extend(_Saturated(air, f, s, r) for f, (s, r) in enumerate(plan.saturated))
                _feed(env, plan.payloads, payload)
            if abs(k * FRAME_S - warm_s) < 1e-9:
                marks.update(bytes=[f.bytes for f in flows], tx=list(air.airtime_s))
            publish((k + 1) * FRAME_S)
            yield env.timeout((k + 1) * FRAME_S - env.now)

    env.process(clock())
    env.run(until=stop_s)
    span_s = stop_s - warm_s
    saturated = [8e-6 * (f.bytes - before) / span_s for f, before in zip(flows, marks["bytes"], strict=True)]
    tx_s = [after - before for before, after in zip(marks["tx"], air.airtime_s, strict=True)]
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    data = pd.DataFrame([row._asdict() for row in [*rows, *air.finish()] if row.kind == "features"])
    if len(data):
        data = data.rename(columns={"t_sent_s": "t", "payload_bytes": "bytes"})
        data["delay"] = data["t_done_s"] - data["t"]
        data["ok"] = data["status"] == "delivered"
    receptions = [
        (t, s, j, delay, j in ids) for t, s, delay, to in heard for ids in [set(to)] for j in range(n) if j != s
    ]
    return {
        "data": data,
        "descriptors": pd.DataFrame(receptions, columns=["t", "sender", "receiver", "delay", "ok"]),
        "sat_mbps": saturated,
        "tx_s": tx_s,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
    }
