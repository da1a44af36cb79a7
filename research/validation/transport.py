"""What the data plane does on bad links: transport, bursts, age and relay (`make figures FIGURE=transport`).

Accuracy is the surrogate's, but for a few frames with the network (`framing_network`).
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import simpy

from research.validation.age import Chain, mean_age_s, share_older
from research.validation.stored import Column, Table
from sortie.radio import Air, Status
from sortie.radio.settings import AirSettings
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

TABLE_Q, TABLE_K = 1e-3, (488, 122, 10, 1)
LOSSES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
FLEET = """
name: transport
duration_s: 20
fleet: {route: {waypoints_m: [[-240, 0], [80, 0]]}}
mission:
  target: {waypoints_m: [[-240, -1.75], [80, -1.75]]}
  phases: [{at_s: 0, phase: search}]
policy: {name: all-4, params: {received_budget: 0.1}, dwell_s: 0}
"""
FLOWN = (0.05, 0.28)
"""Good to bad and bad to good over steps of 1 s, of a real flight's states (FACTS: 0.044–0.059, 0.19–0.38)."""


def fleet(*settings: str) -> Scenario:
    """Five drones at 20 m that share a tenth of their cells with all."""
    return loads(FLEET, overrides=settings)


# --- (1 − q)^k -------------------------------------------------------------------------------------


def arrivals(k: int, samples: int, q: float, seed: int = 1) -> float:
    """Share of best-effort samples of k fragments that arrive over a link that loses frames with probability q."""
    with tempfile.TemporaryDirectory() as folder:
        links = Path(folder) / "links.csv"
        links.write_text(f"t_s,sender,receiver,loss,goodput_mbps\n0,0,1,{q},400\n")
        env, rows = simpy.Environment(), []
        at = np.broadcast_to(np.array([[0.0, 0, 60], [20, 0, 60]]), (samples, 2, 3))
        air = Air(env, AirSettings(trace=str(links), retry_limit=0), at, seed=seed, frame_s=0.1)

    def send() -> Any:
        for _ in range(samples):
            air.advance()
            air.send(0, 1, k * 1344, kind="f", reliable=False, deadline_s=0.09, on_done=rows.append)
            yield env.timeout(0.1)

    env.process(send())
    env.run()
    return sum(r.status is Status.DELIVERED for r in rows) / len(rows)


def fragments_table(samples: int, seeds: tuple[int, ...] = (1, 2, 3, 4)) -> list[dict[str, float]]:
    """The published table, and what the air makes of it: so many samples with each seed."""
    found = []
    for k in TABLE_K:
        expected = (1 - TABLE_Q) ** k
        error = 1.96 * float(np.sqrt(expected * (1 - expected) / (samples * len(seeds))))
        flown = float(np.mean([arrivals(k, samples, TABLE_Q, seed) for seed in seeds]))
        found.append({"k": k, "closed": expected, "interval": error, "flown": flown})
    return found


# --- sample and tile framing -----------------------------------------------------------------------


def shared(scenario: Scenario, seeds: tuple[int, ...]) -> dict[str, float]:
    """AP@0.5, feature cells at the receivers and goodput, over the seeds."""
    return means([outcome(run_sortie(scenario, seed=seed)) for seed in seeds], scenario)


def means(results: list[dict[str, Any]], scenario: Scenario) -> dict[str, float]:
    """The same of outcomes."""
    ap = [r["ap50"]["full_scene"] for r in results]
    delivered = [r["bytes"]["data_delivered"] for r in results]
    sent = [r["bytes"]["data_sent"] for r in results]
    return {
        "ap50": float(np.mean(ap)),
        "ap50_spread": float(np.std(ap, ddof=1)) if len(ap) > 1 else None,
        "goodput_mbps": float(np.mean(delivered)) * 8e-6 / scenario.duration_s,
        "arrived": float(np.sum(delivered) / np.sum(sent)),
    }


def framings(losses: tuple[float, ...], seeds: tuple[int, ...], detector: str, *more: str) -> list[dict[str, Any]]:
    """Both framings over the probability that a frame is lost, retries off."""
    found = []
    for loss in losses:
        for framing in ("sample", "tiles"):
            scenario = fleet(
                f"perception.detector={detector}",
                f"radio.bursts.loss_good={loss}",
                "radio.retry_limit=0",
                f"radio.framing={framing}",
                *more,
            )
            found.append({"loss": loss, "framing": framing, **shared(scenario, seeds)})
    return found


def crowded(seeds: tuple[int, ...]) -> list[dict[str, Any]]:
    """Both framings where the channel, not the link, is what is short: a quarter and all of the cells to all."""
    found = []
    for budget in (0.1, 0.25, 1.0):
        for framing in ("sample", "tiles"):
            scenario = fleet(
                "perception.detector=surrogate",
                f"policy.params={{received_budget: {budget}}}",
                f"radio.framing={framing}",
            )
            found.append({"budget": budget, "framing": framing, **shared(scenario, seeds)})
    return found


# --- bursts ----------------------------------------------------------------------------------------


def staleness(seeds: tuple[int, ...], duration_s: int) -> list[dict[str, Any]]:
    """Ages of descriptors as policies read them, with bursts as flown and with independent losses of the same mean."""
    chain = Chain(*FLOWN, 0.0, 1.0)
    cases = {
        "no loss": (),
        "independent": (f"radio.bursts.loss_good={chain.mean_loss}",),
        "bursts, steps of 0.1 s": _bursts(0.1),
        "bursts, steps of 1 s": _bursts(1.0),
    }
    found = []
    for name, settings in cases.items():
        scenario = fleet(
            "perception.detector=none", f"duration_s={duration_s}", "policy.params={received_budget: 0.02}", *settings
        )
        ages, mean_s, states = [], [], {"degraded": 0, "detached": 0}
        for seed in seeds:
            record = run_sortie(scenario, seed=seed)
            rows = record.tables["ages"]
            ages.append(rows.filter(pc.greater(rows["t_s"], 1.0))["age_s"].to_numpy())
            mean_s.append(float(ages[-1].mean()))
            changes = record.tables["directives"]
            for state in states:
                states[state] += int(pc.sum(pc.equal(changes["link"], state)).as_py() or 0)
        age = np.concatenate(ages)
        minutes = len(seeds) * duration_s / 60.0
        found.append(
            {
                "case": name,
                "mean_age_s": float(np.mean(mean_s)),
                "degraded_share": float((age > 0.3).mean()),
                "detached_share": float((age > 1.0).mean()),
                **{f"{state}_changes_per_link_minute": n / (20 * minutes) for state, n in states.items()},
            }
        )
    return found


def _bursts(step_s: float) -> tuple[str, ...]:
    p, r = FLOWN
    return (f"radio.bursts.good_to_bad={p}", f"radio.bursts.bad_to_good={r}", f"radio.bursts.step_s={step_s}")


def closed_ages() -> list[dict[str, Any]]:
    """The same in closed form, without what collisions and publishing add."""
    per_frame = Chain(*FLOWN, 0.0, 1.0)
    found = []
    for name, loss in (("independent", per_frame.mean_loss), ("bursts, steps of 0.1 s", per_frame)):
        found.append(
            {
                "case": name,
                "mean_age_s": mean_age_s(0.1, loss),
                "degraded_share": share_older(3, loss),
                "detached_share": share_older(10, loss),
            }
        )
    return found


# --- relay -----------------------------------------------------------------------------------------


def relayed(seeds: tuple[int, ...]) -> list[dict[str, Any]]:
    """A line of five, 120 m apart at 15 dBm, in which each sends a fiftieth of its cells to all: hops allowed, and what came."""
    found = []
    for hops in (1, 2, 4):
        scenario = fleet(
            "perception.detector=surrogate", "fleet.formation={shape: line, spacing_m: 120}", "radio.tx_power_dbm=15",
            "policy.params={received_budget: 0.02}", f"radio.relay_max_hops={hops}", "context.detached_after_periods=100",
            "context.degraded_after_periods=50",
        )  # fmt: skip
        records = [run_sortie(scenario, seed=seed) for seed in seeds]
        row: dict[str, Any] = {"hops": hops, **means([outcome(r) for r in records], scenario)}
        moved = [r.tables["transmissions"] for r in records]
        airtime_s = sum(float(pc.sum(m["airtime_s"]).as_py()) for m in moved)
        row["airtime_share"] = airtime_s / scenario.duration_s / len(seeds)
        row["over_others"] = float(np.mean(np.concatenate([m["hops"].to_numpy() for m in moved]) > 1))
        whole = [r.tables["topology"] for r in records]
        if whole[0].num_rows:
            row["connected_share"] = float(np.mean([pc.mean(t["connected"]).as_py() for t in whole]))
            row["bottleneck_mbps"] = float(np.nanmedian([t["bottleneck_mbps"].to_numpy() for t in whole]))
        found.append(row)
    return found


# --- out -------------------------------------------------------------------------------------------


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """AP and goodput of both framings over the loss of frames."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    panels = (("ap50", "AP@0.5, full scene"), ("goodput_mbps", "goodput of the fleet, Mb/s"))
    drawn, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
    for axis, (name, label) in zip(axes, panels, strict=True):
        for framing, mark in (("sample", "o"), ("tiles", "s")):
            of = [r for r in rows if r["framing"] == framing]
            axis.plot([max(r["loss"], 3e-4) for r in of], [r[name] for r in of], marker=mark, label=framing)
        axis.set_xscale("log")
        axis.set_xlabel("probability that a frame is lost (leftmost: none)")
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
        axis.legend(frameon=False)
    drawn.savefig(path, dpi=150)
    plt.close(drawn)


PERCENT = {"form": ".3g", "unit": " %", "factor": 100}
COLUMNS = {
    "closed": Column("(1 − q)^k", ".4f"),
    "interval": Column("half of its 95 % interval", ".4f"),
    "flown": Column("arrived", ".4f"),
    "loss": Column("loss", "g"),
    "budget": Column("received budget", "g"),
    "ap50": Column("AP@0.5", ".3f"),
    "ap50_spread": Column("its standard deviation over seeds", ".3f"),
    "goodput_mbps": Column("goodput", ".3g", " Mb/s"),
    "arrived": Column("bytes that arrived", **PERCENT),
    "mean_age_s": Column("mean age", ".3f", " s"),
    "degraded_share": Column("degraded", **PERCENT),
    "detached_share": Column("detached", **PERCENT),
    "degraded_changes_per_link_minute": Column("changes to degraded, a link and minute", ".1f"),
    "detached_changes_per_link_minute": Column("changes to detached", ".1f"),
    "airtime_share": Column("airtime", **PERCENT),
    "over_others": Column("payloads over others", **PERCENT),
    "connected_share": Column("time connected", **PERCENT),
    "bottleneck_mbps": Column("bottleneck", ".3g", " Mb/s"),
}


def told(rows: list[dict[str, Any]], about: str) -> Table:
    """Rows with the columns' names in words."""
    return Table.of(rows, about, COLUMNS)


def tables(picture: Path, seeds: tuple[int, ...] = (1, 2, 3)) -> dict[str, Table]:
    """Every part; `picture` shows the framings over the loss of frames."""
    lossy = framings(LOSSES, seeds, "surrogate")
    draw(lossy, picture)
    return {
        "fragments": told(fragments_table(20_000), f"q = {TABLE_Q:g}; 20,000 samples with each of four seeds."),
        "framing_loss": told(lossy, f"{len(seeds)} seeds; retries are off."),
        "framing_crowded": told(crowded(seeds), f"{len(seeds)} seeds; retries are on."),
        "framing_network": told(
            framings((0.0, 0.01, 0.1), seeds[:1], "torch", "duration_s=3"), "The torch detector, six scored frames."
        ),
        "ages_flown": told(staleness(seeds, 120), f"{len(seeds)} seeds of 120 s."),
        "ages_closed": told(closed_ages(), "Ages count from the moment of hearing."),
        "relay": told(relayed(seeds), f"{len(seeds)} seeds."),
    }
