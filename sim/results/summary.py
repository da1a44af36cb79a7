"""What is printed of a run: tables for a terminal, a notebook or plain text."""

from __future__ import annotations

import io
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.jupyter import JupyterMixin
from rich.table import Table
from rich.text import Text

from sortie.scenarios.report_text import number, percent, size
from sortie.sim.results.decisions import decision_rows
from sortie.sim.results.sentences import losses_in_words, turns_in_words
from sortie.sim.terminal import Terminal, harmless

MAX_LINKS = 24
"""Of one row of decisions."""
MAX_CHARGES = 24
"""Drones of a fleet for which the charge left of each is printed."""
PLURAL = {"car": "cars", "truck": "trucks", "person": "people"}
WIDTH = 110
"""Columns of a summary as plain text."""


class Summary(JupyterMixin):
    """Tables and lines in their order.

    A notebook shows it as it is, `rich` prints it with colours, and `str` gives plain text.
    """

    def __init__(self, *parts: RenderableType) -> None:
        self._parts = parts

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        return harmless(console.render(Group(*self._parts), options.update(markup=False)))

    def __str__(self) -> str:
        console = Terminal(file=io.StringIO(), width=WIDTH)
        console.print(self)
        assert isinstance(console.file, io.StringIO)  # noqa: S101
        return console.file.getvalue()


def titled(title: str, **options: Any) -> Table:
    """A table with a title in which brackets are brackets, in any console; `options` as of `rich.table.Table`."""
    return Table(title=Text(title, "table.title"), **options)


def outcome_table(result: dict[str, Any]) -> Table:
    """One sortie: what the fleet saw and what it cost."""
    table = titled(f"{result['scenario']} · {result['policy']} · seed {result['seed']}", show_header=False)
    table.add_column(style="bold")
    table.add_column()
    ap, data, mission = result["ap50"], result["bytes"], result["mission"]
    if mission["flown_share"] < 1.0:
        table.add_row("flown", f"{percent(mission['flown_share'])} of drone-seconds")
    if ap["detector"] != "none":
        model = f"; the surrogate {ap['calibration']}, no network" if ap["calibration"] else f"; {ap['detector']}"
        rate = f"scored at {ap['sample_rate_hz']:g} Hz, {ap['scored_fusions']} fusions{turns_in_words(ap)}{model}"
        table.add_row("AP@0.5", f"{number(ap['full_scene'])} full scene, {number(ap['mission'])} mission ({rate})")
        if mission["flown_share"] < 1.0:
            blind = ap["grounded_blind"]
            table.add_row(
                "  grounded drones blind",
                f"{number(blind['full_scene'])} full scene, {number(blind['mission'])} mission",
            )
        for name, of_class in result["ap_by_class"].items():
            if name != "car" and of_class["full_scene"] is not None:
                table.add_row(
                    f"  AP of {PLURAL[name]}",
                    f"{number(of_class['full_scene'])} full scene, {number(of_class['mission'])} mission",
                )
        for phase in result["phases"]:
            seen = phase["ap50"]
            payload = (
                "" if phase["feature_payload_bytes"] is None else f", {size(phase['feature_payload_bytes'])} a payload"
            )
            table.add_row(
                f"  {phase['phase']} {phase['begin_s']:g}–{phase['end_s']:g} s",
                f"{number(seen['full_scene'])} full, {number(seen['mission'])} mission, "
                f"{phase['data_rate_mbps']:.1f} Mb/s{payload}, {percent(phase['deadline_miss_rate'])} missed",
            )
    if people_known := _people_in_words(result["people"]):
        table.add_row("people", people_known)
    if seen_of_mission := _mission_in_words(mission):
        table.add_row("mission", seen_of_mission)
    table.add_row(
        "context plane",
        f"{size(data['context_sent'])} ({percent(result['context_share'])} of all bytes), "
        f"age {number(result['age_s']['p50'])} s median, {number(result['age_s']['p99'])} s p99",
    )
    losses = losses_in_words(result["context"])
    table.add_row(
        "descriptors lost", f"{percent(result['context']['lost'])} of receptions{f' ({losses})' if losses else ''}"
    )
    fates = ", ".join(
        f"{size(data[f'data_{s}'])} {s.replace('_', ' ')}" for s in ("delivered", "lost", "expired", "in_flight")
    )
    table.add_row("data plane", f"{size(data['data_sent'])} sent: {fates}")
    table.add_row(
        "deadlines",
        f"{percent(result['deadline_miss_rate'])} missed; medium busy {percent(result['medium_busy_fraction'])}",
    )
    energy = result["energy_j"]
    causes = ", ".join(f"{c} {energy[c] / 1e3:.1f}" for c in energy if c != "total" and energy[c] > 0)
    table.add_row("energy", f"{energy['total'] / 1e3:.1f} kJ ({causes})")
    table.add_row("charge left", _charges_in_words(result["drones"]))
    if result["descriptor_drops"]:
        table.add_row("descriptors refused", ", ".join(f"{n} {r}" for r, n in result["descriptor_drops"].items()))
    table.add_row("switches", f"{number(result['switches'], '.2f')} a link-minute")
    table.add_row(
        "decision",
        f"{number(result['policy_eval_us']['p50'], '.0f', 'µs')} median, {number(result['policy_eval_us']['p99'], '.0f', 'µs')} p99",
    )
    speed = result["realtime_factor"]
    speed_form = ".2g" if speed is not None and speed < 1.0 else ".1f"
    table.add_row("wall time", f"{number(result['wall_s'], '.2f', 's')}, {number(speed, speed_form)} × real time")
    if result["disagreement"]["share"] is not None:
        table.add_row("disagreement", disagreement_in_words(result["disagreement"]))
    for name, value in result["metrics"].items():
        table.add_row(f"metrics.{name}", number(value, ".4g"))
    if result["own_files"]:
        table.add_row("own files", ", ".join(" ".join(file) for file in result["own_files"].items()))
    table.add_row("fingerprint", result["fingerprint"][:16])
    return table


def disagreement_in_words(figures: Mapping[str, Any]) -> str:
    """How often drones' views lead to different choices, how long that lasts, and why."""
    told = f"{percent(figures['share'])} of link-time, {percent(figures['sends_share'])} about whether to send"
    if not figures["episodes"]:
        return told
    causes = {cause: share for cause, share in figures["causes"].items() if share}
    why = ", ".join(f"{cause} {percent(share)}" for cause, share in sorted(causes.items(), key=lambda c: -c[1]))
    lasts = f"mean {figures['mean_s']:.2f} s, p99 {figures['p99_s']:.2f} s, longest {figures['longest_s']:.1f} s"
    return f"{told}; {figures['episodes']} episodes, {lasts}; by cause: {why}"


def _charges_in_words(drones: Mapping[str, Any]) -> str:
    """Charge left of each drone; of a large fleet the lowest, the median and how many are down."""
    if len(drones) <= MAX_CHARGES:
        return "  ".join(f"{i}: {percent(d['soc'])}{'' if d['airborne'] else ' down'}" for i, d in drones.items())
    lowest = min(drones, key=lambda i: drones[i]["soc"])
    middle = statistics.median(d["soc"] for d in drones.values())
    down = sum(not d["airborne"] for d in drones.values())
    least = f"lowest {percent(drones[lowest]['soc'])} (drone {lowest}), median {percent(middle)}"
    return f"{least}; {down} of {len(drones)} drones down"


def _mission_in_words(mission: dict[str, Any]) -> str:
    """What the fleet saw of its region and its target; empty where it has neither."""
    told = []
    if mission["region_observed_share"] is not None:
        told.append(f"{percent(mission['region_observed_share'])} of the region in view")
    for what, share, gap in (("in view", "in_view", "out_of_view"), ("detected", "detected", "undetected")):
        if mission[f"target_{share}_share"] is not None:
            gap_s = mission[f"target_longest_{gap}_s"]
            told.append(
                f"target {what} {percent(mission[f'target_{share}_share'])} of the time, longest gap {gap_s:.1f} s"
            )
    return "; ".join(told)


def _people_in_words(people: dict[str, Any]) -> str:
    """How well drones knew where the people in their regions were; empty where nobody was there, or nothing was scored."""
    if people["located_share"] is None:
        return ""
    alone = percent(people["located_alone_share"])
    return f"{percent(people['located_share'])} of those in a drone's region located, {alone} by the drone's own camera"


def _links_in_words(links: Sequence[tuple[int, int]]) -> str:
    """Links by their drone; the first of many, and how many more there are."""
    by_drone: dict[int, list[str]] = {}
    for drone, peer in sorted(links)[:MAX_LINKS]:
        by_drone.setdefault(drone, []).append(str(peer))
    told = "  ".join(f"{drone}→{','.join(peers)}" for drone, peers in by_drone.items())
    more = len(links) - MAX_LINKS
    return f"{told}  and {more} more" if more > 0 else told


def transitions_table(result: dict[str, Any]) -> Table:
    """Phases, events and decisions in order of time, 25 rows at most (`sortie.sim.results.decisions`)."""
    rows, more = decision_rows(result)
    table = Table(title="decisions and events", caption=f"and {more} more in outcome.json" if more else None)
    for column in ("t (s)", "who", "what", "why"):
        table.add_column(column, justify="right" if column == "t (s)" else "left")
    for row in rows:
        who = "fleet" if row.fleet else _links_in_words(row.links) if row.links else str(row.drone)
        what: str | Text = row.what if row.links else Text(row.what, "yellow")
        table.add_row(f"{row.t_s:.2f}", who, what, row.why)
    return table
