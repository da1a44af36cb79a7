"""The terminal tables of the command line."""

from __future__ import annotations

import cProfile
import pstats
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from sortie.scenarios.report_text import number, percent, points, size, table
from sortie.sim.check.expectations import Verdict
from sortie.sim.studies.compare import Compared

ROOMS = ("sim", "fleet", "radio", "policies", "perception", "scenarios")
MAX_TRANSITIONS = 24
COMPARE_BEGIN, COMPARE_END = "<!-- compare:begin -->", "<!-- compare:end -->"


def outcome_table(result: dict[str, Any]) -> Table:
    """One sortie: what the fleet saw and what it cost."""
    table = Table(title=f"{result['scenario']} · {result['policy']} · seed {result['seed']}", show_header=False)
    table.add_column(style="bold")
    table.add_column()
    ap, data, mission = result["ap50"], result["bytes"], result["mission"]
    if mission["flown_share"] < 1.0:
        table.add_row("flown", f"{percent(mission['flown_share'])} of drone-seconds")
    if ap["detector"] != "none":
        model = f"; the surrogate {ap['calibration']}, no network" if ap["calibration"] else f"; {ap['detector']}"
        rate = f"scored at {ap['sample_rate_hz']:g} Hz, {ap['scored_fusions']} fusions{model}"
        table.add_row("AP@0.5", f"{number(ap['full_scene'])} full scene, {number(ap['mission'])} mission ({rate})")
        if mission["flown_share"] < 1.0:
            blind = ap["grounded_blind"]
            table.add_row(
                "  grounded drones blind",
                f"{number(blind['full_scene'])} full scene, {number(blind['mission'])} mission",
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
    if seen_of_mission := _mission_in_words(mission):
        table.add_row("mission", seen_of_mission)
    table.add_row(
        "context plane",
        f"{size(data['context_sent'])} ({percent(result['context_share'])} of all bytes), "
        f"age {number(result['age_s']['p50'])} s median, {number(result['age_s']['p99'])} s p99",
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
    left = "  ".join(f"{i}: {percent(b['soc'])}{'' if b['airborne'] else ' down'}" for i, b in result["drones"].items())
    table.add_row("charge left", left)
    if result["descriptor_drops"]:
        table.add_row("descriptors refused", ", ".join(f"{n} {r}" for r, n in result["descriptor_drops"].items()))
    table.add_row("switches", f"{number(result['switches'], '.2f')} a link-minute")
    table.add_row(
        "decision",
        f"{number(result['policy_eval_us']['p50'], '.0f', 'µs')} median, {number(result['policy_eval_us']['p99'], '.0f', 'µs')} p99",
    )
    table.add_row(
        "wall time", f"{number(result['wall_s'], '.2f', 's')}, {number(result['realtime_factor'], '.1f')} × real time"
    )
    if result["own_files"]:
        table.add_row("own files", escape(", ".join(" ".join(file) for file in result["own_files"].items())))
    table.add_row("fingerprint", result["fingerprint"][:16])
    return table


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


def transitions_table(result: dict[str, Any]) -> Table:
    """What the gates switched, when and why, drones that do alike in one row; events among them."""
    frame_s = result["frame_s"]
    alike: dict[tuple[int, str, str], tuple[float, list[str]]] = {}
    for t in result["transitions"]:
        key = (int(t["t_s"] / frame_s + 1e-6), f"{t['from']} → {t['to']}", t["reason"])
        alike.setdefault(key, (t["t_s"], []))[1].append(f"{t['drone']}→{','.join(map(str, t['peers']))}")
    rows = [(t_s, "  ".join(sorted(who)), what, why) for (_, what, why), (t_s, who) in alike.items()]
    rows += [
        (e["t_s"], "fleet" if e["drone"] < 0 else str(e["drone"]), f"[yellow]{e['kind']}[/yellow]", e["text"])
        for e in result["events"]
    ]
    rows.sort(key=lambda row: row[0])
    more = len(rows) - MAX_TRANSITIONS
    table = Table(title="decisions and events", caption=f"and {more} more in outcome.json" if more > 0 else None)
    for column in ("t (s)", "who", "what", "why"):
        table.add_column(column, justify="right" if column == "t (s)" else "left")
    for t_s, who, what, why in rows[:MAX_TRANSITIONS]:
        table.add_row(f"{t_s:.2f}", who, what, escape(why))  # a policy's own words, in which brackets are brackets
    return table


def comparison_table(rows: Sequence[Compared]) -> Table:
    """Policies side by side, a column each; gains are over the first, in AP points with paired 95 % intervals."""
    first = rows[0].outcome
    table = Table(title=f"{first['scenario']} · seed {first['seed']} · gains over {rows[0].policy}, AP points, 95 %")
    table.add_column("", style="bold")
    for row in rows:
        table.add_column(row.policy, justify="right")
    for name, cells in _side_by_side(rows).items():
        table.add_row(name, *cells)
    return table


def comparison_markdown(rows: Sequence[Compared], command: str) -> str:
    """The same for a README, between its markers, with why the figures differ."""
    first = rows[0].outcome
    head = f"`{command}`: {first['duration_s']:g} s, {len(first['battery'])} drones, seed {first['seed']}"
    if first["ap50"]["scored_fusions"]:
        rate_hz = first["ap50"]["sample_rate_hz"]
        head += f", accuracy scored at {rate_hz:g} Hz, gains over {rows[0].policy} in AP points, paired, 95 %"
    cells = ((name.strip(), *values) for name, values in _side_by_side(rows).items())
    lines = [f"{head}.", "", *table(("", *(r.policy for r in rows)), cells)]
    why = [line.replace("[bold]", "**").replace("[/bold]", "**") for line in explanations(rows)]
    return "\n".join([COMPARE_BEGIN, "", *lines, "", *(f"- {line}" for line in why), "", COMPARE_END])


def compare_command(
    scenario: str, policies: str, seed: int | None, overrides: Sequence[str], *, own_fusion: bool
) -> str:
    """The command that gives the same comparison again."""
    said = ["sortie", "compare", scenario, "--policies", policies]
    said += [] if seed is None else ["--seed", str(seed)]
    said += [x for override in overrides for x in ("--set", override)]
    return shlex.join(said + ["--own-fusion"] * own_fusion)


def _side_by_side(rows: Sequence[Compared]) -> dict[str, list[str]]:
    """What is compared, a row each: its name and a cell a policy."""
    figures: dict[str, Callable[[Compared], str]] = {
        "AP@0.5 full scene": lambda r: number(r.outcome["ap50"]["full_scene"]),
        "  gain": lambda r: _gain(r.gain["full_scene"]),
        "AP@0.5 mission": lambda r: number(r.outcome["ap50"]["mission"]),
        "  gain ": lambda r: _gain(r.gain["mission"]),
        "data sent": lambda r: size(r.outcome["bytes"]["data_sent"]),
        "data delivered": lambda r: size(r.outcome["bytes"]["data_delivered"]),
        "  handshakes": lambda r: size(r.outcome["bytes"]["handshakes_sent"]),
        "deadlines missed": lambda r: percent(r.outcome["deadline_miss_rate"]),
        "medium busy": lambda r: percent(r.outcome["medium_busy_fraction"]),
        "context sent": lambda r: size(r.outcome["bytes"]["context_sent"]),
        "data age, median": lambda r: number(r.outcome["data_age_s"]["p50"], ".2f", "s"),
        "energy": lambda r: f"{r.outcome['energy_j']['total'] / 1e3:.2f} kJ",
        "  radio": lambda r: f"{r.outcome['energy_j']['radio'] / 1e3:.2f} kJ",
        "  compute": lambda r: f"{r.outcome['energy_j']['compute'] / 1e3:.2f} kJ",
        "charge left, least": lambda r: percent(min(r.outcome["battery"].values(), default=None)),
    }
    if any(r.outcome["mission"]["flown_share"] < 1.0 for r in rows):
        figures = {"flown": lambda r: percent(r.outcome["mission"]["flown_share"])} | _with_blind(figures)
    return {name: [figure(r) for r in rows] for name, figure in figures.items()}


def _with_blind(figures: dict[str, Callable[[Compared], str]]) -> dict[str, Callable[[Compared], str]]:
    """The rows, with the AP that counts grounded drones as blind below each AP."""
    blind = {
        "AP@0.5 full scene": ("  grounded drones blind", "full_scene"),
        "AP@0.5 mission": ("  grounded drones blind ", "mission"),
    }
    out: dict[str, Callable[[Compared], str]] = {}
    for name, figure in figures.items():
        out[name] = figure
        if name in blind:
            row, area = blind[name]
            out[row] = lambda r, area=area: number(r.outcome["ap50"]["grounded_blind"][area])  # type: ignore[misc]
    return out


def _gain(gain: tuple[float, float, float] | None) -> str:
    return "" if gain is None else points(gain, "+.1f")


def explanations(rows: Sequence[Compared]) -> Iterator[str]:
    """Why the figures differ, a line a policy, from the record."""
    for r in rows:
        fates = r.outcome["payload_fates"]
        total = sum(fates.values())
        if not total:
            yield f"[bold]{r.policy}[/bold]: sent nothing; every drone saw with its own eyes only"
            continue
        parts = ", ".join(f"{percent(n / total)} {fate}" for fate, n in sorted(fates.items(), key=lambda f: -f[1]))
        age = r.outcome["data_age_s"]["p50"]
        fused = "nothing fused" if age is None else f"fused data {age:.2f} s old at the median"
        yield f"[bold]{r.policy}[/bold]: {total} payloads, {parts}; {fused}"


def verdict_table(name: str, verdicts: Sequence[Verdict]) -> Table:
    """A scenario's expectations, held or not."""
    table = Table(title=name, caption=None if verdicts else "this scenario expects nothing")
    for column in ("", "expected", "got", "because"):
        table.add_column(column)
    for v in verdicts:
        because = escape(v.because) + (f"\n[dim]the record: {escape(v.explanation)}[/dim]" if v.explanation else "")
        verdict = "[green]ok[/green]" if v.holds else "[red]FAILED[/red]"
        table.add_row(verdict, escape(v.expected), escape(v.got), because)
    return table


def training_table(result: Any) -> Table:
    """The result of a training run."""
    table = Table(title="training", show_header=False)
    for name in result.__slots__ if hasattr(result, "__slots__") else vars(result):
        table.add_row(name, str(getattr(result, name)))
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
