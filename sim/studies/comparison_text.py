"""What is printed of a comparison: in the terminal, a notebook or a Markdown file."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence

from rich.table import Table

from sortie.scenarios.report_text import number, percent, points, size, table
from sortie.sim.studies.compare import Compared

BEGIN, END = "<!-- compare:begin -->", "<!-- compare:end -->"


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
    return "\n".join([BEGIN, "", *lines, "", *(f"- {line}" for line in why), "", END])


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
