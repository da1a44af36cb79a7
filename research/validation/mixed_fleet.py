"""What two networks in one fleet cost, and what a policy that knows of them saves (scenario `two_makes`)."""

from __future__ import annotations

from collections.abc import Sequence

from research.validation.stored import Cell, Column, Table
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, FleetView
from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.engine.transport import OTHER_SPACE
from sortie.sim.results.outcome import outcome

SCENARIO = "two_makes"
RHO = 0.25


def knows(view: FleetView) -> Sequence[Directive]:
    """The worked policy as the scenario has it."""
    return worked(view, rho=RHO)


def knows_nothing(view: FleetView) -> Sequence[Directive]:
    """The same, without the feature spaces in its view."""
    plain = {i: d._replace(feature_space="") for i, d in view.descriptors.items()}
    return worked(view._replace(descriptors=plain), rho=RHO)


ARMS = (
    ("`worked`, one network for all", True, knows),
    ("`silence`", False, "silence"),
    ("`worked`, without reading feature spaces", False, knows_nothing),
    ("`worked`", False, knows),
)


def fleet(seed: int, one_network: bool) -> Scenario:
    """The scenario over a town of its own."""
    changes = [f"seed={seed}", f"perception.scene.seed={seed}"]
    return load(SCENARIO, [*changes, *(["fleet.makes.0.feature_space="] if one_network else [])])


def tables(seeds: Sequence[int]) -> dict[str, Table]:
    """Each arm's data and accuracy, and its gain over the policy that does not know, sortie by sortie."""
    found: dict[str, list[list[float]]] = {}
    for name, one_network, policy in ARMS:
        for seed in seeds:
            record = run_sortie(fleet(seed, one_network), policy)
            result = outcome(record)
            rows = record.tables["transmissions"].to_pylist()
            refused = sum(r["payload_bytes"] for r in rows if r["reason"] == OTHER_SPACE)
            seconds = result["duration_s"]
            found.setdefault(name, []).append(
                [
                    result["bytes"]["data_sent"] / seconds / 1e6, refused / seconds / 1e6,
                    result["ap50"]["full_scene"], result["ap50"]["mission"],
                ]
            )  # fmt: skip
    naive = found[ARMS[2][0]]
    shown: list[list[Cell]] = []
    for name, each in found.items():
        means = [mean_interval([one[k] for one in each]).mean for k in range(4)]
        gains: list[Cell] = [None, None]
        if name != ARMS[2][0]:
            gains = []
            for k in (2, 3):
                gain = mean_interval([a[k] - b[k] for a, b in zip(each, naive, strict=True)])
                gains.append((gain.mean, gain.low, gain.high))
        shown.append([name, *means, *gains])
    columns = [
        Column("policy"), Column("data sent", ".2f", " MB/s"), Column("refused", ".2f", " MB/s"),
        Column("AP, full scene", ".3f"), Column("AP, mission", ".3f"),
        Column("gain, full scene", "+.1f", factor=100), Column("gain, mission", "+.1f", factor=100),
    ]  # fmt: skip
    about = (
        f"`{SCENARIO}`, {len(seeds)} sorties for each row, each over a town of its own. Gains are in points of AP over "
        "`worked` without reading feature spaces, with Student's interval over sorties."
    )
    return {"mixed_fleet": Table(columns, shown, about)}
