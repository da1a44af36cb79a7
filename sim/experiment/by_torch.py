"""A campaign's first units flown by the torch detector as well, and means by torch with the surrogate as control variate.

The surrogate flies all units of a campaign. The torch detector flies the first of them again, with equal draws and seeds, as a
campaign of its own in the folder `by_torch`. Both together estimate what the torch detector alone would find
(`sortie.scenarios.control_variates`): without bias whatever the surrogate's error, and the more precisely the better the two
go together from unit to unit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sortie.scenarios.control_variates import controlled_mean
from sortie.scenarios.intervals import Estimate, mean_interval
from sortie.scenarios.reading.campaign import Study
from sortie.sim.experiment.plan import CampaignPlan, make_plan
from sortie.sim.experiment.rows import CampaignRows, read_rows
from sortie.sim.experiment.store import FILE, CampaignTable
from sortie.sim.folders import RunError

FOLDER = "by_torch"
_DECIDES_DETECTOR = re.compile(
    r"perception|perception\.(detector|detector_params(\..*)?|weights)|fleet|fleet\.makes(\.\d+(\.(detector|weights))?)?"
)
"""Varied fields that may set another detector than the plan's, or what belongs to one detector alone."""


def plan_by_torch(study: Study, units: int, plan: CampaignPlan) -> CampaignPlan:
    """The same campaign by the torch detector, of which the first `units` are flown.

    Args:
        plan: the campaign's own.

    Raises:
        RunError: its base is not scored by the surrogate, its draws are not independent, or it has fewer units.
        PolicyError: as `make_plan`.
    """
    perception, campaign = study.base.perception, study.campaign
    if perception.detector != "surrogate":
        raise RunError(f"--by-torch: perception.detector is {perception.detector}, must be surrogate")
    if varied := [name for name in campaign.vary if _DECIDES_DETECTOR.fullmatch(name)]:
        raise RunError(f"--by-torch: {varied[0]} is varied; both detectors must fly the same fleet")
    for make in study.base.fleet.makes:
        if make.detector not in (None, "none") or make.weights is not None:
            raise RunError(
                f"--by-torch: make {make.name} has a detector or weights of its own; both must fly the same fleet"
            )
    if not campaign.sample.independent:
        raise RunError(f"--by-torch: sample.method is {campaign.sample.method}, whose means have no intervals")
    if not 2 <= units <= plan.units:
        raise RunError(f"--by-torch: {units}, must be from 2 to the campaign's {plan.units} {plan.unit}s")
    by_torch = perception.model_copy(update={"detector": "torch", "weights": None, "detector_params": {}})
    base = study.base.model_copy(update={"perception": by_torch})
    whole = campaign.model_copy(update={"stop_when": None})
    return make_plan(replace(study, base=base, campaign=whole), by_torch=True)


class Answer(NamedTuple):
    """One mean by the torch detector, or one difference of two policies."""

    metric: str
    policy: str
    alone: Estimate
    """Over the units that torch flew."""
    with_surrogate: Estimate
    correlation: float
    """Of torch and the surrogate from unit to unit; NaN where either does not vary."""

    @property
    def worth(self) -> float:
        """How many times as many units torch alone would need for the interval with the surrogate; NaN without intervals."""
        return (self.alone.half_width / w) ** 2 if (w := self.with_surrogate.half_width) > 0 else math.nan


def read_torch(folder: Path, rows: CampaignRows) -> CampaignRows | None:
    """The torch detector's rows of a campaign; None where it has flown no whole unit.

    Raises:
        RunError: rows there are broken, or of another campaign or other code.
    """
    if not (folder / FOLDER / FILE).is_file():
        return None
    with closing(CampaignTable(folder / FOLDER)) as store:  # a part is a unit
        if all(store.part(n) is None for n in range(store.parts)):
            return None
    torch = read_rows(folder / FOLDER)
    ours, its = ({**r.plan.spec["campaign"], "stop_when": None} for r in (rows, torch))
    if ours != its or rows.plan.spec["policies"] != torch.plan.spec["policies"]:
        raise RunError(f"{folder / FOLDER}: holds results of another campaign")
    codes = {r.plan.code.partition(" torch ")[0] for r in (rows, torch)}
    if len(codes) > 1:
        raise RunError(
            f"{folder / FOLDER}: holds results of Sortie {torch.plan.code}, the campaign is of {rows.plan.code}"
        )
    return torch


def answers(rows: CampaignRows, torch: CampaignRows, metric: str, *, differences: bool) -> list[Answer]:
    """Means of a metric by policy, or each policy's differences from the first one."""
    cheap, dear = (r.every_unit(metric) for r in (rows, torch))
    units = max(len(cheap), len(dear))
    cheap, dear = (np.pad(m, ((0, units - len(m)), (0, 0)), constant_values=math.nan) for m in (cheap, dear))
    if differences:
        cheap, dear = (m - m[:, :1] for m in (cheap, dear))
    out = []
    for p, label in enumerate(rows.plan.policies):
        if p == 0 and differences:
            continue
        flown = ~np.isnan(dear[:, p])
        if flown.any():
            found = controlled_mean(dear[flown, p], cheap[flown, p], cheap[~flown, p])
            out.append(Answer(metric, label, mean_interval(dear[flown, p]), found.estimate, found.correlation))
    return out


def depends_on_detector(rows: CampaignRows, torch: CampaignRows) -> Iterator[str]:
    """The metrics that differ between the two detectors on units that both flew."""
    for metric in rows.plan.campaign.metrics:
        cheap, dear = (r.every_unit(metric) for r in (rows, torch))
        both = min(len(cheap), len(dear))
        if not np.array_equal(cheap[:both], dear[:both], equal_nan=True):
            yield metric
