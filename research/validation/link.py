"""The link, the rates, the medium and what they cost (`make figures FIGURE=link`, and `FIGURE=radio_scale`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import simpy
from scipy import stats

from research.validation import csma
from research.validation.stored import Column, Table
from sortie.radio import Air
from sortie.radio.channel.antenna import antenna_loss_db
from sortie.radio.channel.pathloss import LIGHT_MPS, free_space_loss_db, two_ray_loss_db
from sortie.radio.channel.shadowing import ShadowField
from sortie.radio.channel.snr import Channel, earshot_m, noise_dbm
from sortie.radio.mac.airtime import ACK_S, BLOCK_ACK_S, frames_exchanges, legacy_ppdu_s
from sortie.radio.mac.contention import DIFS_S, SIFS_S, contention, saturation_mbps
from sortie.radio.mac.jobs import AirJob, GroupFrame
from sortie.radio.mac.medium import Link, Medium
from sortie.radio.mac.rate_control import INTERVAL_S, Minstrel
from sortie.radio.rates import STANDARDS, per, rate_table
from sortie.radio.sample import Service
from sortie.radio.settings import AirSettings

CROSS_M = np.array([[0, 0, 60], [20, 0, 60], [-20, 0, 60], [0, 20, 60], [0, -20, 60]], float)
NS3 = {  # FACTS: ns-3's wifi-bianchi reference, 1500 B, no aggregation, N = 5, 10, 20, 50
    "11a, 54 Mb/s": (29.832, 28.152, 26.293, 23.562),
    "HE20, MCS 7": (34.967, 33.074, 30.928, 27.698),
    "HE80, MCS 7": (55.839, 53.936, 51.286, 46.857),
}
SENDERS = (5, 10, 20, 50)
Rows = list[dict[str, Any]]


# --- propagation -------------------------------------------------------------------------------------


def friis() -> Rows:
    """Free-space loss against the values of FACTS, which are rounded to 0.1 dB."""
    facts = {2.437: (40.2, 66.2, 80.2, 89.7), 5.2: (46.8, 72.8, 86.8, 96.3)}
    rows = []
    for ghz, stated in facts.items():
        ours = free_space_loss_db([1.0, 20.0, 100.0, 300.0], ghz)
        rows.append({"GHz": ghz, "largest difference, dB": round(float(np.abs(ours - stated).max()), 3)})
    return rows


def two_rays() -> Rows:
    """The two-ray model against its limits."""
    rows = []
    for h_a, h_b, ghz in ((2.0, 1.5, 2.4), (10.0, 2.0, 5.2)):
        break_m = 4 * h_a * h_b * ghz * 1e9 / LIGHT_MPS
        d = np.linspace(0.5 * break_m, 3 * break_m, 20_001)
        gain = free_space_loss_db(d, ghz) - two_ray_loss_db(d, h_a, h_b, ghz)
        far = two_ray_loss_db(break_m * np.array([50.0, 500.0]), h_a, h_b, ghz)
        limit = 40 * np.log10(500 * break_m) - 20 * np.log10(h_a * h_b)
        rows.append(
            {
                "heights, m": f"{h_a:g}, {h_b:g}",
                "GHz": ghz,
                "break point 4 h h / λ, m": round(break_m),
                "last maximum there, of it": round(float(d[gain.argmax()] / break_m), 3),
                "its gain, dB (6.02)": round(float(gain.max()), 2),
                "slope beyond, dB a decade (40)": round(float(far[1] - far[0]), 2),
                "off 40 log d − 20 log hh, dB": round(float(far[1] - limit), 3),
            }
        )
    return rows


def fades_db(settings: AirSettings, n: int, frames: int, seed: int = 1, per_frame: int = 1) -> np.ndarray:
    """[frames, n, n]: the fades of group frames that stations send one after another, sender by receiver; NaN to itself.

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


def outage(frames: int) -> Rows:
    """Small-scale fading against the Rician outage 1 − Q1(√2K, √(2 (1 + K) g))."""
    rows = []
    for k_db in (6.0, 12.0):
        k = 10 ** (k_db / 10)
        drawn_db = fades_db(AirSettings(rician_k_db=k_db), 5, frames)[:, ~np.eye(5, dtype=bool)].ravel()
        for depth_db in (-3.0, -6.0, -10.0):
            exact = float(stats.ncx2.cdf(2 * (1 + k) * 10 ** (depth_db / 10), 2, 2 * k))  # 1 − Marcum's Q1
            seen = float((drawn_db < depth_db).mean())
            error = float(np.sqrt(exact * (1 - exact) / drawn_db.size))
            rows.append(
                {
                    "K, dB": k_db,
                    "below, dB": depth_db,
                    "exact": exact,
                    "simulated": seen,
                    "standard errors off": round((seen - exact) / error, 2) if error else 0.0,
                }
            )
    return rows


def shadowing(frames: int, fields: int) -> Rows:
    """Autocorrelation in time (each pair its own) and in space (Gudmundson, one end moves)."""
    channel = Channel(AirSettings(), np.broadcast_to(CROSS_M, (frames, 5, 3)), 3, 0, 0.1)
    seen = []
    for _ in range(frames):
        channel.advance()
        seen.append(channel.shadow_db[np.triu_indices(5, 1)])
    x = np.array(seen)
    rows: Rows = [{"what": "σ, dB", "exact": 3.5, "simulated": round(float(x.std()), 3)}]
    for lag_s in (0.5, 1.0, 4.5):
        k = round(lag_s * 10)
        rows.append(
            {
                "what": f"{lag_s:g} s later",
                "exact": round(float(np.exp(-lag_s / 4.5)), 3),
                "simulated": round(float((x[:-k] * x[k:]).mean() / x.var()), 3),
            }
        )
    along_m = np.array([0.0, 10.0, 30.0, 60.0])
    ends = np.concatenate([np.stack([along_m, 0 * along_m, 0 * along_m + 60], axis=1), [[500.0, 400.0, 60.0]]])
    squares = np.array([ShadowField(3.5, 30.0, 4.5, seed, 0).between(ends, 0.0)[:4, 4] for seed in range(fields)])
    for i, moved in enumerate(along_m[1:], start=1):
        rows.append(
            {
                "what": f"one end {moved:g} m off, d = 30 m",
                "exact": round(float(np.exp(-moved / 30)), 3),
                "simulated": round(float(np.corrcoef(squares[:, 0], squares[:, i])[0, 1]), 3),
            }
        )
    return rows


def banking() -> Rows:
    """What a bank toward the peer costs with dipoles, one airframe banking."""
    return [
        {"bank, °": bank, "loss, dB": round(float(antenna_loss_db("dipole", np.sin(np.radians(bank)))), 2)}
        for bank in (5, 10, 20, 30, 45, 60)
    ]


# --- rates -------------------------------------------------------------------------------------------


def rates() -> Rows:
    """Rates from subcarriers, modulation and code; mean PER against the integral over the Rice density."""
    bits = np.array([0.5, 1, 1.5, 2, 3, 4, 4.5, 5, 6, 20 / 3, 7.5, 25 / 3])
    carriers = {"n": {20: 52, 40: 108}, "ac": {20: 52, 40: 108, 80: 234}, "ax": {20: 234, 40: 468, 80: 980}}
    rows: Rows = []
    for name, standard in STANDARDS.items():
        for width, mbps in standard.rates_mbps.items():
            exact = carriers[name][width] * bits[: len(mbps)] / standard.symbol_s * 1e-6
            off = float(np.abs(exact - mbps).max())
            rows.append(
                {"what": f"802.11{name}, {width} MHz: {mbps[0]} … {mbps[-1]} Mb/s, largest off", "value": round(off, 3)}
            )
    worst = 0.0
    r = np.linspace(1e-4, 4.0, 20_001)
    for k_db in (0.0, 12.0):
        k = 10 ** (k_db / 10)
        density = stats.rice(b=np.sqrt(2 * k), scale=np.sqrt(1 / (2 * (k + 1)))).pdf(r)
        table = rate_table(80, k_db, 1494)
        for mcs in (0, 4, 7, 11):
            for snr_db in (0.0, 10.0, 18.0, 25.0, 32.0):
                exact_per = np.trapezoid([per(snr_db + g, mcs, 1494) for g in 20 * np.log10(r)] * density, r)
                worst = max(worst, abs(float(exact_per) - table.all_per[mcs][table.index(snr_db)]))
    rows.append({"what": "mean PER, largest off", "value": float(f"{worst:.1e}")})
    return rows


# --- contention --------------------------------------------------------------------------------------


def bianchi() -> Rows:
    """The analytic model against ns-3's reference."""
    rows = []
    for name, reference in NS3.items():
        if name.startswith("11a"):
            whole = [saturation_mbps(n, 12e3, legacy_ppdu_s(1538, 54.0), ACK_S) for n in SENDERS]
            ppdu_s = 20e-6 + 8 * 1538 / 54e6
            ours = [saturation_mbps(n, 12e3, ppdu_s, ACK_S, goes_on_at_once=True) for n in SENDERS]
            rows.append(_beside(f"{name}, as Bianchi counts", whole, reference))
            rows.append(_beside(f"{name}, winner may go on", ours, reference))
        else:
            one = frames_exchanges(1, 1538, 1538, 86.0 if "20" in name else 360.3, 1, ACK_S)
            rows.append(_beside(name, [12e-3 / one.channel_s(contention(n)) for n in SENDERS], reference))
    return rows


def _beside(name: str, ours: list[float], reference: tuple[float, ...]) -> dict[str, Any]:
    off = max(abs(a / b - 1) for a, b in zip(ours, reference, strict=True))
    return {
        "case": name,
        **{f"N = {n}": round(v, 2) for n, v in zip(SENDERS, ours, strict=True)},
        "largest off": off,
    }


def contended(periods: int) -> Rows:
    """CSMA/CA sender by sender over the analytic throughput."""
    eifs_s = SIFS_S + legacy_ppdu_s(14, 6.0) + DIFS_S
    rows = []
    for name, frames, rate, ack_s in (
        ("HE20 MCS 7, single", 1, 86.0, ACK_S),
        ("HE80 MCS 7, single", 1, 360.3, ACK_S),
        ("HE20 MCS 7, 16 MPDUs", 16, 86.0, BLOCK_ACK_S),
        ("HE80 MCS 7, 64 MPDUs", 64, 360.3, BLOCK_ACK_S),
    ):
        one = frames_exchanges(frames, 1538, 1538, rate, frames, ack_s)
        turn = csma.Turn(one.ppdu_s, ack_s, frames, 12e3)
        for rules, kwargs in (
            ("as the standard counts", {}),
            ("as Bianchi counts", {"goes_on_at_once": False}),
            ("EIFS after collisions", {"collision_tail_s": eifs_s}),
        ):
            row: dict[str, Any] = {"case": name, "run": rules}
            for n in SENDERS:
                ran = csma.run([turn] * n, periods, np.random.default_rng(n), **kwargs)  # type: ignore[arg-type]
                row[f"N = {n}"] = ran.throughput_mbps / (frames * 12e-3 / one.channel_s(contention(n))) - 1
            rows.append(row)
    return rows


def unequal() -> Rows:
    """Two senders, one eight times as slow: shares of delivered bits in the medium and in CSMA/CA."""
    slow, fast = csma.Turn(4e-3, BLOCK_ACK_S, 16, 12e3), csma.Turn(0.5e-3, BLOCK_ACK_S, 16, 12e3)
    ran = csma.run([slow, fast], 20_000, np.random.default_rng(3))
    return [
        {"model": "CSMA/CA", "fast over slow, bits": round(float(ran.delivered_bits[1] / ran.delivered_bits[0]), 2)},
        {"model": "the medium", "fast over slow, bits": round(_in_the_medium((4e-3, 0.5e-3)), 2)},
    ]


def _in_the_medium(ppdus_s: tuple[float, float], seconds: float = 60.0) -> float:
    """Frames of the second of two saturated senders over the first's, with 16 frames in A-MPDUs of these lengths."""
    env = simpy.Environment()
    medium = Medium[AirJob, GroupFrame](
        env, AirSettings(rician_k_db=40.0), 2, 1, 0, -88.0, lambda *_: None, lambda *_: None, lambda *_: None
    )
    medium.set_links(np.array([0, 2, 4]), np.array([0, 1, 0, 1]), np.full(4, 1e4), frame=0)
    for sender, ppdu_s in enumerate(ppdus_s):
        job = AirJob(sender, sender, float("inf"))
        job.flow, job.frames, job.full_bytes, job.last_bytes = medium.flow(sender, 1 - sender), 10**7, 1494, 1494
        medium.tune(job.flow, Link(7, rate_mbps=16 * 1500 * 8e-6 / (ppdu_s - 44e-6), frames=16))
        medium.submit(job)
    env.run(until=seconds)
    done = [job.arrived_frames for i in range(2) if (job := medium.in_service(i)) is not None]
    return done[1] / done[0]


# --- rate control and goodput ------------------------------------------------------------------------


def rate_control(seconds: float) -> Rows:
    """Minstrel's goodput over the ideal rate's, by channel, with 122 frames every 0.1 s."""
    intervals = round(seconds / INTERVAL_S)
    table, rates_mbps = rate_table(80, 12.0, 1494), STANDARDS["ax"].rates_mbps[80]
    rng = np.random.default_rng(0)
    keep = np.exp(-INTERVAL_S / 4.5)
    drift = np.zeros(intervals)
    for k in range(1, intervals):
        drift[k] = keep * drift[k - 1] + np.sqrt(1 - keep**2) * 3.5 * rng.standard_normal()
    step = np.where(np.arange(intervals) % 100 < 50, 30.0, 18.0)
    rows = []
    for name, snr in (
        ("still, 20 dB", np.full(intervals, 20.0)),
        ("shadowing, 20 ± 3.5 dB", 20 + drift),
        ("12 dB down and up every 5 s", step),
    ):
        control, share, late, turn = Minstrel(rates_mbps), [], [], 0
        known = snr[0]
        for k, now_db in enumerate(snr):
            pers = [row[table.index(now_db)] for row in table.all_per]
            mcs = control.mcs(0, 1, k * INTERVAL_S)
            sent = [0] * len(pers)
            sent[mcs] = 110
            for _ in range(12):  # the others by turns
                sent[turn % len(sent)] += 1
                turn += 1
            counts = [(n, n - int(rng.binomial(n, min(1.0, per)))) for n, per in zip(sent, pers, strict=True)]
            control.sent(0, 1, k * INTERVAL_S, counts)
            best = max(r * (1 - p) for r, p in zip(rates_mbps, pers, strict=True))
            share.append(rates_mbps[mcs] * (1 - pers[mcs]) / best)
            at = table.mcs[table.index(known)]
            late.append(rates_mbps[at] * (1 - pers[at]) / best)
            known = now_db
        s = np.array(share[20:])
        row: dict[str, Any] = {
            "channel": name,
            "Minstrel-like": float(s.mean()),
            "ideal, a frame late": float(np.mean(late[20:])),
        }
        if name.startswith("12"):
            edges = range(50, intervals - 50, 50)
            lag = [next(j for j in range(51) if share[k + j : k + j + 1] and share[k + j] > 0.9) for k in edges]
            row["back within 10 % after, s"] = f"{np.mean(lag[0::2]) / 10:.1f} down, {np.mean(lag[1::2]) / 10:.1f} up"
        rows.append(row)
    return rows


def _fly(
    config: AirSettings, seconds: float, tick: Callable[[Air, int], None], loss_db: Callable[[float], float]
) -> Air:
    """Two drones at 20 m; `tick` once a frame, after the links have moved on."""
    env = simpy.Environment()
    frames = round(seconds * 10)
    air = Air(env, config, np.broadcast_to(CROSS_M[:2], (frames, 2, 3)), seed=1, frame_s=0.1)

    def run() -> simpy.events.ProcessGenerator:
        for k in range(frames):
            air.advance(np.full((2, 2), loss_db(k / 10)))
            tick(air, k)
            yield env.timeout(0.1)

    env.process(run())
    env.run(until=seconds)
    return air


def goodput(seconds: float) -> Rows:
    """The sender's estimate against the true rate of the link alone, read once a frame before it sends."""
    rows = []
    for payload in (150, 13_120, 163_840):
        for name, config, loss in (
            ("still", AirSettings(shadowing_sigma_db=0.0), lambda t: 12.0),
            ("shadowing 3.5 dB", AirSettings(), lambda t: 12.0),
        ):
            service = Service(config, noise_dbm(config.bandwidth_mhz, config.noise_figure_db))
            read: list[float] = []
            true: list[float] = []

            def tick(
                air: Air,
                k: int,
                payload: int = payload,
                service: Service = service,
                read: list[float] = read,
                true: list[float] = true,
            ) -> None:
                if k > 20:
                    read.append(air.goodput_mbps(0)[0])
                    true.append(float(service.link_mbps(air.channel.now.square_db)[0, 1]))
                air.send(0, 1, payload, kind="f", reliable=False, deadline_s=0.09, on_done=lambda row: None)

            _fly(config, seconds, tick, loss)
            r, t = np.array(read), np.array(true)
            rows.append(
                {
                    "sample, B": payload,
                    "channel": name,
                    "mean reading over mean truth": float(r.mean() / t.mean()),
                    "RMS error over truth": float(np.sqrt(((r - t) ** 2).mean()) / t.mean()),
                    "lag of best correlation, frames": _lag(r, t) if name != "still" else None,
                }
            )
    return rows


def _lag(read: np.ndarray, true: np.ndarray) -> int:
    return int(np.argmax([np.corrcoef(read[k:], true[: len(true) - k])[0, 1] for k in range(15)]))


def goodput_step() -> Rows:
    """How soon the estimate follows a change of the link by 12 dB, 10 samples a second."""
    rows = []
    for payload in (150, 13_120, 163_840):
        read: list[float] = []
        _fly(
            AirSettings(shadowing_sigma_db=0.0), 30.0,
            lambda air, k, p=payload, read=read: (  # type: ignore[misc]
                read.append(air.goodput_mbps(0)[0]),
                air.send(0, 1, p, kind="f", reliable=False, deadline_s=0.09, on_done=lambda row: None),
            ),
            lambda t: 24.0 if 10.0 <= t < 20.0 else 12.0,
        )  # fmt: skip
        r = np.array(read)
        high, low = r[90], r[190]
        down = int(np.flatnonzero(r[100:] <= 1.1 * low)[0])
        up = int(np.flatnonzero(r[200:] >= low + 0.9 * (high - low))[0])
        rows.append(
            {
                "sample, B": payload,
                "before, Mb/s": round(high, 1),
                "after, Mb/s": round(low, 1),
                "down, s": down / 10,
                "90 % back up, s": up / 10,
            }
        )
    return rows


# --- scale -------------------------------------------------------------------------------------------


def moving_fleet(n: int, frames: int, spacing_m: float = 20.0) -> np.ndarray:
    """[frames, n, 3]: a square of drones that flies east at 5 m/s, each with a swing of its own."""
    side = int(np.ceil(np.sqrt(n)))
    slot = np.array([[spacing_m * (i % side), spacing_m * (i // side), 60.0] for i in range(n)])
    t = np.arange(frames)[:, None] * 0.1
    swing = np.sin(t * 0.7 + np.arange(n)[None, :])
    return slot[None] + np.stack([5.0 * t + swing, 2.0 * swing, 0.5 * swing], axis=-1)


def broadcast_all(n: int, seconds: float, config: AirSettings) -> tuple[Air, float, int]:
    """Every drone a 208 B descriptor at 10 Hz; the air, CPU seconds, and events of the clock."""
    frames = round(seconds * 10)
    positions = moving_fleet(n, frames)

    def heard(_: Any) -> None:
        return None

    begin_s = time.process_time()
    env = simpy.Environment()
    air = Air(env, config, positions, seed=1, frame_s=0.1)

    def run() -> simpy.events.ProcessGenerator:
        for k in range(frames):
            if k:
                yield env.timeout(k / 10 - env.now)
            air.advance()
            for i in range(n):
                air.broadcast(i, 208, heard)

    env.process(run())
    env.run(until=seconds)
    return air, time.process_time() - begin_s, next(env._eid)


WEAK = AirSettings(tx_power_dbm=-12.0, path_loss_exponent=3.0)


def scale(seconds: float, sizes: tuple[int, ...]) -> Rows:
    """CPU time, best of three, of 120 s or what was asked for."""
    rows = []
    for name, config in (("default radio", AirSettings()), (f"earshot {earshot_m(WEAK):.0f} m", WEAK)):
        for n in sizes:
            runs = [broadcast_all(n, seconds, config) for _ in range(3 if n <= 100 else 1)]
            air, _, events = runs[0]
            cpu_s = min(r[1] for r in runs)
            c = air.counters
            near = len(air.channel.links.sender) / n if n > 32 else n - 1
            rows.append(
                {
                    "radio": name,
                    "N": n,
                    "neighbours worked out": round(near, 1),
                    "CPU, s": round(cpu_s, 2),
                    "µs a broadcast": round(cpu_s / c.broadcasts * 1e6, 1),
                    "ns a broadcast and neighbour": round(cpu_s / c.broadcasts / max(near, 1) * 1e9),
                    "events a broadcast": round(events / c.broadcasts, 2),
                    "collided": c.collided / c.broadcasts,
                }
            )
    return rows


# --- telling -----------------------------------------------------------------------------------------


COLUMNS = {
    "exact": Column("exact", ".3e"),
    "simulated": Column("simulated", ".3e"),
    "largest off": Column("largest off", ".3f", " %", 100),
    "Minstrel-like": Column("Minstrel-like", ".1f", " %", 100),
    "ideal, a frame late": Column("ideal, a frame late", ".1f", " %", 100),
    "mean reading over mean truth": Column("mean reading over mean truth", ".3f"),
    "RMS error over truth": Column("RMS error over truth", ".3f"),
    "collided": Column("collided", ".1f", " %", 100),
}
SHARES = {f"N = {n}": Column(f"N = {n}", "+.1f", " %", 100) for n in SENDERS}


def told(rows: Rows, about: str = "", columns: Mapping[str, Column] = COLUMNS) -> Table:
    """Rows with their numbers as people read them."""
    return Table.of(rows, about, columns)


def tables() -> dict[str, Table]:
    """Everything but what times the host."""
    return {
        "link_free_space": Table.of(friis()),
        "link_two_rays": Table.of(two_rays()),
        "link_outage": told(outage(20_000)),
        "link_shadowing": Table.of(shadowing(24_000, 3000)),
        "link_banking": Table.of(banking()),
        "link_rates": Table.of(rates()),
        "link_bianchi": told(bianchi(), "Throughput in Mb/s; the last column is against ns-3's reference."),
        "link_contended": told(contended(12_000), "CSMA/CA run over the analytic throughput, less one.", SHARES),
        "link_unequal": Table.of(unequal()),
        "link_rate_control": told(rate_control(600), "Goodput over the best rate's."),
        "link_goodput": told(goodput(300)),
        "link_goodput_step": Table.of(goodput_step(), "After a step of 12 dB."),
    }


def scale_tables() -> dict[str, Table]:
    """Processor time of the radio by the size of the fleet."""
    about = (
        "Every drone sends a descriptor of 208 B at 10 Hz for 120 s; the best of three runs, of one with 400 drones."
    )
    return {"radio_scale": told(scale(120, (5, 25, 100, 400)), about)}


def draw(path: Path) -> None:
    """Path loss, outage and autocorrelation, PER curves, contention."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, ((a, b), (c, d)) = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    distance = np.geomspace(5, 5000, 4000)
    a.semilogx(distance, two_ray_loss_db(distance, 2.0, 1.5, 2.4), lw=0.8, label="two rays, 2 m and 1.5 m")
    a.semilogx(distance, free_space_loss_db(distance, 2.4), "k--", label="free space")
    a.axvline(4 * 2 * 1.5 * 2.4e9 / LIGHT_MPS, color="grey", ls=":", label="4 h h / λ")
    a.set(xlabel="distance, m", ylabel="loss at 2.4 GHz, dB")
    a.invert_yaxis()
    fades = np.geomspace(1e-3, 2, 200)
    for k_db, colour in ((6.0, "C0"), (12.0, "C1")):
        drawn_db = fades_db(AirSettings(rician_k_db=k_db), 5, 3000)[:, ~np.eye(5, dtype=bool)]
        k = 10 ** (k_db / 10)
        b.loglog(fades, stats.ncx2.cdf(2 * (1 + k) * fades, 2, 2 * k), colour, label=f"Marcum Q, K = {k_db:g} dB")
        seen = np.sort(10 ** (drawn_db.ravel() / 10))
        b.loglog(seen[::97], (np.arange(len(seen)) + 1)[::97] / len(seen), colour + ".", ms=3)
    b.set(xlabel="power gain", ylabel="probability below", ylim=(1e-5, 1))
    snr = np.linspace(-5, 35, 400)
    for mcs in (0, 4, 7, 11):
        table = rate_table(80, 12.0)
        c.semilogy(snr, [per(x, mcs) for x in snr], f"C{mcs % 10}--", lw=0.8)
        c.semilogy(snr, [table.all_per[mcs][table.index(x)] for x in snr], f"C{mcs % 10}", label=f"MCS {mcs}")
    c.set(xlabel="mean SNR, dB (dashed: no fading)", ylabel="PER, 1458 B", ylim=(1e-4, 1.1))
    many = np.arange(1, 61)
    for frames, rate, ack_s, colour in ((1, 360.3, ACK_S, "C0"), (64, 360.3, BLOCK_ACK_S, "C1")):
        one = frames_exchanges(frames, 1538, 1538, rate, frames, ack_s)
        d.semilogy(
            many,
            [frames * 12e-3 / one.channel_s(contention(int(n))) for n in many],
            colour,
            label=f"HE80 MCS 7, {frames} MPDU",
        )
        turn = csma.Turn(one.ppdu_s, ack_s, frames, 12e3)
        ran = [csma.run([turn] * n, 4000, np.random.default_rng(n)).throughput_mbps for n in (1, 2, *SENDERS)]
        d.semilogy((1, 2, *SENDERS), ran, colour + "o", ms=4)
    d.set(xlabel="senders (dots: CSMA/CA run)", ylabel="throughput, Mb/s")
    for axes in (a, b, c, d):
        axes.legend(fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)
