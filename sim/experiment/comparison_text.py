"""What is printed of a comparison: in the terminal, a notebook or a Markdown file."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from rich.table import Table
from rich.text import Text

from sortie.radio.transmission import Status
from sortie.scenarios.report_text import number, percent, points, size, table
from sortie.sim.experiment.compare import BLOCK_S, BY_BOTH, Compared, Flown, Gain
from sortie.sim.experiment.conditions import mean_of_known
from sortie.sim.experiment.half_width import Precision
from sortie.sim.results.sentences import turns_in_words
from sortie.sim.results.summary import PLURAL, titled

BEGIN, END = "<!-- compare:begin -->", "<!-- compare:end -->"


class Line(NamedTuple):
    """A line about a policy, or about one figure."""

    name: str
    """What it is about, written in bold; may be empty."""
    text: str
    """What follows the name."""

    def __rich__(self) -> Text:
        return Text.assemble((self.name, "bold"), self.text)


def comparison_table(flown: Flown) -> Table:
    """Policies side by side, a column each; gains are over the first, in AP points with paired 95 % intervals."""
    table = titled(heading(flown), caption=_what_gains_are(flown) or None)
    table.add_column("", style="bold")
    for policy in _by_policy(flown):
        table.add_column(policy, justify="right", overflow="fold")
    for name, cells in side_by_side(flown).items():
        table.add_row(name, *cells)
    return table


def comparison_markdown(flown: Flown, command: str, precision: Precision | None = None) -> str:
    """The same for a Markdown file, between its markers, with why the figures differ."""
    first = flown.sorties[0].outcome
    head = f"`{command}`: {first['duration_s']:g} s, {len(first['battery'])} drones, {_seeds(flown)}"
    if first["ap50"]["scored_fusions"]:
        head += f", accuracy scored at {first['ap50']['sample_rate_hz']:g} Hz by `{first['ap50']['detector']}`"
        head += turns_in_words(first["ap50"])
    what = " ".join(filter(None, [f"{head}.", _what_gains_are(flown)]))
    cells = ((name.strip(), *values) for name, values in side_by_side(flown).items())
    told = [*explanations(flown), *([] if precision is None else precision_lines(precision))]
    lines = [
        BEGIN,
        "",
        what,
        "",
        *table(("", *_by_policy(flown)), cells),
        "",
        *(f"- **{name}**{text}" if name else f"- {text}" for name, text in told),
        "",
        END,
    ]
    return "\n".join(lines)


def compare_command(
    scenario: str,
    policies: str,
    seed: int | None,
    seeds: int | None,
    overrides: Sequence[str],
    *,
    own_fusion: bool,
    half_width: float | None = None,
    metric: str | None = None,
    pilot: int | None = None,
    most_seeds: int | None = None,
) -> str:
    """The command that gives the same comparison again."""
    said = ["sortie", "compare", scenario, "--policies", policies]
    said += [] if seed is None else ["--seed", str(seed)]
    said += [] if seeds is None else ["--seeds", str(seeds)]
    said += [x for override in overrides for x in ("--set", override)]
    said += [] if half_width is None else ["--half-width", f"{half_width:g}"]
    said += [] if metric is None else ["--metric", metric]
    said += [] if pilot is None else ["--pilot", str(pilot)]
    said += [] if most_seeds is None else ["--most-seeds", str(most_seeds)]
    return shlex.join(said + ["--own-fusion"] * own_fusion)


JAMMED = 0.5
"""Of a policy's payloads: where so many miss their deadline, what is compared is a full channel."""


def heading(flown: Flown) -> str:
    """The scenario, and how many sorties the figures are means of."""
    first = flown.sorties[0].outcome
    return f"{first['scenario']} · {_seeds(flown)}{turns_in_words(first['ap50'])}"


def explanations(flown: Flown) -> Iterator[Line]:
    """Why the figures differ, a line a policy, from the records of all its sorties."""
    for policy, sorties in _by_policy(flown).items():
        fates: dict[str, int] = {}
        for s in sorties:
            for fate, n in s.outcome["payload_fates"].items():
                fates[fate] = fates.get(fate, 0) + n
        total, in_all = sum(fates.values()), " in all sorties" * (len(sorties) > 1)
        if not total:
            yield Line(policy, ": sent nothing; every drone saw with its own eyes only")
            continue
        parts = ", ".join(f"{percent(n / total)} {fate}" for fate, n in sorted(fates.items(), key=lambda f: -f[1]))
        age = mean_of_known(s.outcome["data_age_s"]["p50"] for s in sorties)
        fused = "nothing fused" if age is None else f"fused data {age:.2f} s old at the median"
        yield Line(policy, f": {total} payloads{in_all}, {parts}; {fused}")
        late = sum(n for fate, n in fates.items() if fate.startswith(Status.EXPIRED))
        if late >= JAMMED * total:
            cure = f"compare it with a smaller budget as well, {policy}(received_budget=0.1) for one"
            yield Line(
                policy, f": the channel is full, {percent(late / total)} of its payloads miss their deadline; {cure}"
            )


def precision_lines(found: Precision) -> Iterator[Line]:
    """What a comparison to a half-width flew, and what it cost."""
    name = found.detector
    widest = max((c.half_width for c in found.contrasts if c.metric == found.metric), default=math.nan)
    verdict = "reached" if found.reached else "not reached, as the seeds were used up: --most-seeds allows more"
    width = f"{100 * widest:.2f} AP points" if widest else f"none, as the gains are all equal in {found.paired} seeds"
    yield Line(
        "half-width",
        f" of {found.metric}: {width}, {100 * found.asked:g} asked, {verdict}; "
        "intervals are widened for stopping there",
    )
    further = f", and {found.further} further seeds by the surrogate" if found.further else ""
    correlate = f"gains in the surrogate's scores correlate with those in {name}'s:"
    yield Line("flown", f": {found.paired} seeds by {name}{further}; {correlate}")
    for c in found.contrasts:
        used = f"coefficient {c.coefficient:.2f}" if found.control else "not used"
        known = f"correlation {number(c.correlation)}, predicted variance {percent(c.explained)}, {used}"
        yield Line("", f"  {c.policy}, {c.metric}: {known}")
    if not found.control:
        yield Line(
            f"{name} alone",
            f": the surrogate was not used, because {name} alone reaches the half-width about as "
            "cheaply. Gains are plain means over the seeds",
        )
    yield Line(
        "cost",
        f": {found.seconds[0]:.1f} s of processor time for a seed by {name}, {found.seconds[1]:.1f} s by the surrogate; in all "
        f"{number(found.cost_ratio, '.2f')} of what {name} alone is predicted to take",
    )


def _by_policy(flown: Flown) -> dict[str, list[Compared]]:
    found: dict[str, list[Compared]] = {}
    for s in flown.sorties:
        found.setdefault(s.policy, []).append(s)
    return found


def _seeds(flown: Flown) -> str:
    """What was flown, and so how far the figures reach."""
    seeds = list(dict.fromkeys(s.seed for s in flown.sorties))
    if len(seeds) == 1:
        return f"seed {seeds[0]}, in this town, this flight"
    listed = (
        f"{seeds[0]} to {seeds[-1]}" if seeds == list(range(seeds[0], seeds[-1] + 1)) else ", ".join(map(str, seeds))
    )
    return f"means of {len(seeds)} sorties, seeds {listed}, each with a town and random draws of its own"


def _what_gains_are(flown: Flown) -> str:
    if not flown.gains:
        return ""
    covers = {
        "sorties": "the mean over sorties of each sortie's difference in AP, over the fusions that both policies made, with Student's 95 % interval over sorties",
        BY_BOTH: "the mean over sorties of each sortie's difference in AP, over the fusions that both policies made, corrected by the surrogate's sorties as control variates, with a 95 % interval over sorties",
        "blocks of one sortie": f"with a descriptive 95 % interval over blocks of {BLOCK_S:g} s of this one flight in this one town, which says nothing of others",
    }[flown.gains[0].over]
    return f"Gains are in AP points over {flown.sorties[0].policy}, paired: {covers}."


def side_by_side(flown: Flown) -> dict[str, list[str]]:
    """What is compared, a row each: its name and a cell a policy. Figures are means over the policy's sorties."""
    gains = {(g.policy, g.metric): g for g in flown.gains}
    sorties = {s.seed for s in flown.sorties}

    def mean(*path: str, text: Callable[[Any], str]) -> list[str]:
        values = [[_at(s.outcome, path) for s in of] for of in _by_policy(flown).values()]
        return [text(mean_of_known(of)) + _some(sum(v is not None for v in of), len(sorties)) for of in values]

    def gain(metric: str) -> list[str]:
        return [_gain(gains.get((policy, metric)), len(sorties)) for policy in _by_policy(flown)]

    grounded = any(s.outcome["mission"]["flown_share"] < 1.0 for s in flown.sorties)
    blind = {
        area: mean("ap50", "grounded_blind", area, text=number) if grounded else []
        for area in ("full_scene", "mission")
    }
    rows = {
        "flown": mean("mission", "flown_share", text=percent) if grounded else [],
        "AP@0.5 full scene": mean("ap50", "full_scene", text=number),
        "  gain": gain("ap50.full_scene"),
        "  grounded drones blind": blind["full_scene"],
        "    gain": gain("ap50.grounded_blind.full_scene") if grounded else [],
        "AP@0.5 mission": mean("ap50", "mission", text=number),
        "  gain ": gain("ap50.mission"),
        "  grounded drones blind ": blind["mission"],
        "    gain ": gain("ap50.grounded_blind.mission") if grounded else [],
        **_of_classes(flown, mean),
        "data sent": mean("bytes", "data_sent", text=size),
        "data delivered": mean("bytes", "data_delivered", text=size),
        "  handshakes": mean("bytes", "handshakes_sent", text=size),
        "deadlines missed": mean("deadline_miss_rate", text=percent),
        "medium busy": mean("medium_busy_fraction", text=percent),
        "context sent": mean("bytes", "context_sent", text=size),
        "descriptors lost": mean("context", "lost", text=percent),
        "data age, median": mean("data_age_s", "p50", text=lambda v: number(v, ".2f", "s")),
        "energy": mean("energy_j", "total", text=_kilojoules),
        "  radio": mean("energy_j", "radio", text=_kilojoules),
        "  compute": mean("energy_j", "compute", text=_kilojoules),
    }
    least = [[min(s.outcome["battery"].values(), default=None) for s in of] for of in _by_policy(flown).values()]
    rows["charge left, least"] = [percent(mean_of_known(values)) for values in least]
    own = dict.fromkeys(name for s in flown.sorties for name in s.outcome["metrics"])
    rows |= {f"metrics.{name}": mean("metrics", name, text=lambda v: number(v, ".4g")) for name in own}
    return {name: cells for name, cells in rows.items() if cells}


def _of_classes(flown: Flown, mean: Callable[..., list[str]]) -> dict[str, list[str]]:
    """Rows of trucks and people, where a sortie has a figure of them."""

    def known(*path: str) -> bool:
        return any(_at(s.outcome, path) is not None for s in flown.sorties)

    of = [name for name in PLURAL if name != "car" and known("ap_by_class", name, "full_scene")]
    rows = {f"AP of {PLURAL[name]}, full scene": mean("ap_by_class", name, "full_scene", text=number) for name in of}
    if known("people", "located_share"):
        rows["people located"] = mean("people", "located_share", text=percent)
    return rows


def _at(result: Any, path: Sequence[str]) -> float | None:
    for part in path:
        result = result[part]
    return None if result is None else float(result)


def _kilojoules(value: float) -> str:
    return f"{value / 1e3:.2f} kJ"


def _gain(gain: Gain | None, sorties: int) -> str:
    if gain is None:
        return ""
    some = _some(gain.count, sorties) if gain.over in ("sorties", BY_BOTH) else ""
    return points((gain.gain, gain.low, gain.high), "+.1f") + some


def _some(count: int, sorties: int) -> str:
    """How many of the sorties a mean is over, where it is not over all of them."""
    return f" ({count} of {sorties})" if 0 < count < sorties else ""
