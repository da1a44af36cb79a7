"""What is printed of a comparison: in the terminal, a notebook or a Markdown file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

from rich.table import Table as RichTable
from rich.text import Text

from sortie.radio.transmission import Status
from sortie.scenarios.report_text import number, percent, points, size
from sortie.sim.experiment.compare import BLOCK_S, BY_BOTH, Compared, Flown, Gain
from sortie.sim.experiment.conditions import mean_of_known
from sortie.sim.experiment.half_width import Precision
from sortie.sim.results.blocks import Block, Items, Paragraph, Table, markdown
from sortie.sim.results.outcome import OutcomeDict
from sortie.sim.results.sentences import turns_in_words
from sortie.sim.results.summary import titled

BEGIN, END = "<!-- compare:begin -->", "<!-- compare:end -->"
JAMMED = 0.5
"""Of a policy's payloads: where so many miss their deadline, what is compared is a full channel."""


def _kilojoules(value: float) -> str:
    return f"{value / 1e3:.2f} kJ"


ROWS: tuple[tuple[str, str, Callable[[Any], str] | None], ...] = (
    ("flown", "mission.flown_share", percent),
    ("AP@0.5 full scene", "ap50.full_scene", number),
    ("  gain", "ap50.full_scene", None),
    ("  grounded drones blind", "ap50.grounded_blind.full_scene", number),
    ("    gain", "ap50.grounded_blind.full_scene", None),
    ("AP@0.5 mission", "ap50.mission", number),
    ("  gain ", "ap50.mission", None),
    ("  grounded drones blind ", "ap50.grounded_blind.mission", number),
    ("    gain ", "ap50.grounded_blind.mission", None),
    ("AP of trucks, full scene", "ap_by_class.truck.full_scene", number),
    ("AP of people, full scene", "ap_by_class.person.full_scene", number),
    ("people located", "people.located_share", percent),
    ("data sent", "bytes.data_sent", size),
    ("data delivered", "bytes.data_delivered", size),
    ("  handshakes", "bytes.handshakes_sent", size),
    ("deadlines missed", "deadline_miss_rate", percent),
    ("medium busy", "medium_busy_fraction", percent),
    ("context sent", "bytes.context_sent", size),
    ("descriptors lost", "context.lost", percent),
    ("data age, median", "data_age_s.p50", lambda v: number(v, ".2f", "s")),
    ("energy", "energy_j.total", _kilojoules),
    ("  radio", "energy_j.radio", _kilojoules),
    ("  compute", "energy_j.compute", _kilojoules),
)
"""Name, place in the outcome, and how a mean of it is written; a row without that has the gains."""
IF_GROUNDED, IF_KNOWN = ("mission.flown_share", "ap50.grounded_blind"), ("ap_by_class", "people")
"""Places of rows that are left out where all drones fly to the end, or where no sortie has a value."""


class Line(NamedTuple):
    """A line about a policy, or about one figure."""

    name: str
    """What it is about, written in bold; may be empty."""
    text: str
    """What follows the name."""

    def __rich__(self) -> Text:
        return Text.assemble((self.name, "bold"), self.text)


def comparison_table(flown: Flown) -> RichTable:
    """Policies side by side, a column each; gains are over the first, in AP points with paired 95 % intervals."""
    table = titled(heading(flown), caption=what_gains_are(flown) or None)
    table.add_column("", style="bold")
    for policy in _by_policy(flown):
        table.add_column(policy, justify="right", overflow="fold")
    for name, cells in side_by_side(flown).items():
        table.add_row(name, *cells)
    return table


def comparison_blocks(flown: Flown, precision: Precision | None = None) -> list[Block]:
    """The same for a Markdown file or a page, with why the figures differ."""
    rows = [(name.strip(), *cells) for name, cells in side_by_side(flown).items()]
    told = [*explanations(flown), *([] if precision is None else precision_lines(precision))]
    items = [f"**{name}**{text}" if name else text for name, text in told]
    return [Table(("", *_by_policy(flown)), rows), Items(items)]


def comparison_markdown(flown: Flown, command: str, precision: Precision | None = None) -> str:
    """The section of a Markdown file, between its markers."""
    first = flown.sorties[0].outcome
    head = f"`{command}`: {first['duration_s']:g} s, {len(first['battery'])} drones, {_seeds(flown)}"
    if first["ap50"]["scored_fusions"]:
        head += f", accuracy scored at {first['ap50']['sample_rate_hz']:g} Hz by `{first['ap50']['detector']}`"
        head += turns_in_words(first["ap50"])
    what = Paragraph(f"{head}. {what_gains_are(flown)}".rstrip())
    return f"{BEGIN}\n\n{markdown([what, *comparison_blocks(flown, precision)])}\n{END}"


def heading(flown: Flown) -> str:
    """The scenario, and how many sorties the figures are means of."""
    first = flown.sorties[0].outcome
    return f"{first['scenario']} · {_seeds(flown)}{turns_in_words(first['ap50'])}"


def explanations(flown: Flown) -> Iterator[Line]:
    """Why the figures differ, a line a policy, from the records of all its sorties."""
    for policy, sorties in _by_policy(flown).items():
        fates: Counter[str] = Counter()
        for s in sorties:
            fates.update(s.outcome["payload_fates"])
        total, in_all = sum(fates.values()), " in all sorties" * (len(sorties) > 1)
        if not total:
            yield Line(policy, ": sent nothing; every drone saw with its own eyes only")
            continue
        parts = ", ".join(f"{percent(n / total)} {fate}" for fate, n in fates.most_common())
        age = mean_of_known(s.outcome["data_age_s"]["p50"] for s in sorties)
        fused = "nothing fused" if age is None else f"fused data {age:.2f} s old at the median"
        yield Line(policy, f": {total} payloads{in_all}, {parts}; {fused}")
        late = sum(n for fate, n in fates.items() if fate.startswith(Status.EXPIRED))
        if late >= JAMMED * total:
            cure = f"compare it with a smaller budget as well, {policy}(received_budget=0.1) for one"
            missed = f"{percent(late / total)} of its payloads miss their deadline"
            yield Line(policy, f": the channel is full, {missed}; {cure}")


def precision_lines(found: Precision) -> Iterator[Line]:
    """What a comparison to a half-width flew, and what it cost."""
    name = found.detector
    widest = max((c.half_width for c in found.contrasts if c.metric == found.metric), default=math.nan)
    verdict = "reached" if found.reached else "not reached, as the seeds were used up: --most-seeds allows more"
    width = f"{100 * widest:.2f} AP points" if widest else f"none, as the gains are all equal in {found.paired} seeds"
    asked = f"{100 * found.asked:g} asked, {verdict}; intervals are widened for stopping there"
    yield Line("half-width", f" of {found.metric}: {width}, {asked}")
    further = f", and {found.further} further seeds by the surrogate" if found.further else ""
    correlate = f"gains in the surrogate's scores correlate with those in {name}'s:"
    yield Line("flown", f": {found.paired} seeds by {name}{further}; {correlate}")
    for c in found.contrasts:
        used = f"coefficient {c.coefficient:.2f}" if found.control else "not used"
        known = f"correlation {number(c.correlation)}, predicted variance {percent(c.explained)}, {used}"
        yield Line("", f"  {c.policy}, {c.metric}: {known}")
    if not found.control:
        why = f"the surrogate was not used, because {name} alone reaches the half-width about as cheaply"
        yield Line(f"{name} alone", f": {why}. Gains are plain means over the seeds")
    each = "{:.1f} s of processor time for a seed by {}, {:.1f} s by the surrogate"
    in_all = f"in all {number(found.cost_ratio, '.2f')} of what {name} alone is predicted to take"
    yield Line("cost", f": {each.format(found.seconds[0], name, found.seconds[1])}; {in_all}")


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
    in_a_row = seeds == list(range(seeds[0], seeds[-1] + 1))
    which = f"{seeds[0]} to {seeds[-1]}" if in_a_row else ", ".join(map(str, seeds))
    return f"means of {len(seeds)} sorties, seeds {which}, each with a town and random draws of its own"


def what_gains_are(flown: Flown) -> str:
    """What the gains are over, and what their intervals cover."""
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
    policies, sorties = _by_policy(flown), len({s.seed for s in flown.sorties})
    gains = {(g.policy, g.metric): g for g in flown.gains}

    def means(value: Callable[[Any], float | None], text: Callable[[Any], str]) -> list[str]:
        values = [[value(s.outcome) for s in of] for of in policies.values()]
        return [text(mean_of_known(of)) + _some(sum(v is not None for v in of), sorties) for of in values]

    rows = {}
    for name, place, text in ROWS:
        value = partial(OutcomeDict.number, name=place)
        if place.startswith(IF_GROUNDED) and all(s.outcome["mission"]["flown_share"] == 1.0 for s in flown.sorties):
            continue
        if place.startswith(IF_KNOWN) and all(value(s.outcome) is None for s in flown.sorties):
            continue
        gain = [_gain(gains.get((policy, place)), sorties) for policy in policies]
        rows[name] = gain if text is None else means(value, text)
    rows["charge left, least"] = means(lambda outcome: min(outcome["battery"].values(), default=None), percent)
    for own in dict.fromkeys(name for s in flown.sorties for name in s.outcome["metrics"]):
        rows[f"metrics.{own}"] = means(partial(OutcomeDict.number, name=f"metrics.{own}"), lambda v: number(v, ".4g"))
    return rows


def _gain(gain: Gain | None, sorties: int) -> str:
    if gain is None:
        return ""
    some = _some(gain.count, sorties) if gain.over in ("sorties", BY_BOTH) else ""
    return points((gain.gain, gain.low, gain.high), "+.1f") + some


def _some(count: int, sorties: int) -> str:
    """How many of the sorties a mean is over, where it is not over all of them."""
    return f" ({count} of {sorties})" if 0 < count < sorties else ""
