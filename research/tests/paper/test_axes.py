"""What methods read and decide, observed while they run, is the paper's table."""

from __future__ import annotations

from typing import Any

from policies_examples import fleet_of

from research.paper.axes import FIELDS, Axis, decisions_of, method_table, observe
from sortie.policies.catalogue.deputies import deputies
from sortie.policies.catalogue.prior import METHODS
from sortie.policies.catalogue.prior.where2comm import where2comm
from sortie.policies.contract import (
    Descriptor,
    Directive,
    Disc,
    FleetView,
    Representation,
)
from sortie.policies.verification.kit.views import draw_views

PAPER = """\
| method | Mis. | Scene | Plat. | Geom. | decides |
|---|---|---|---|---|---|
| Where2comm | – | ● | – | – | ROI |
| When2com | – | ● | – | – | topology |
| Who2com | – | ● | – | – | topology |
| V2VNet | – | – | – | – | fusion wts |
| DiscoNet | – | – | – | – | fusion wts |
| SyncNet | – | – | ● | – | fusion wts |
| HydraCollab | – | ● | – | – | fidelity + ROI |
| Fixed compression | – | – | – | – | fidelity |
| Context plane | ● | ● | ● | ● | all six |
"""
"""The paper's table of methods, its columns read and decided (what a method ignores is the rest)."""

VIEWS = list(draw_views(0, 200))


# --- the table -----------------------------------------------------------------------------------


def test_the_generated_table_is_the_papers() -> None:
    """The paper's rows are the published methods'; ours are named as they fly."""
    expected = PAPER
    for method in METHODS.values():
        expected = expected.replace(f"| {method.title} |", f"| {method.name} |")
    assert method_table(VIEWS, [deputies]) == expected


def test_the_watch_sees_a_policy_that_reads_more() -> None:
    def nosy(view: FleetView) -> list[Directive]:
        me = view.me
        if me is None or me.battery_soc < 0.5:
            return []
        return where2comm(view)

    assert observe(nosy, VIEWS).axes == {Axis.SCENE, Axis.PLATFORM}


def test_every_field_of_a_descriptor_belongs_somewhere() -> None:
    assert set(Descriptor._fields) <= set(FIELDS)
    assert {a for a in FIELDS.values() if a} == set(Axis)


def test_a_decision_is_what_differs_from_full_sharing() -> None:
    full = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0)
    assert decisions_of(full) == set()
    assert decisions_of(full._replace(duty_percent=90)) == {"duty"}
    assert decisions_of(full._replace(representation=Representation.NONE, rho=0.0)) == {"topology"}
    assert decisions_of(full._replace(rho=0.5)) == {"fidelity"}
    assert decisions_of(full._replace(roi=Disc(0, 0, 1))) == {"ROI"}
    assert decisions_of(full._replace(deadline_s=1.0)) == {"rate"}
    assert decisions_of(full._replace(fusion_weight=0.5)) == {"fusion wts"}


# --- views by hand ------------------------------------------------------------------------------------

VIEW = fleet_of(3)._replace(period_s=0.2, age_s={0: 0.0, 1: 0.5, 2: 1.5})


# --- what is kept, and what is outside -------------------------------------------------------------------


def test_decisions_differ_from_full_sharing_each_in_its_own_fields() -> None:
    full = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0)
    changes: list[tuple[dict[str, Any], set[str]]] = [
        ({}, set()),
        ({"rho": 0.5}, {"fidelity"}),
        ({"representation": Representation.CODES}, {"fidelity"}),
        ({"rate_hz": 5.0}, {"rate"}),
        ({"rate_hz": 0.0}, {"rate"}),
        ({"deadline_s": 0.2}, {"rate"}),
        ({"roi": Disc(0, 0, 1)}, {"ROI"}),
        ({"fusion_weight": 0.5}, {"fusion wts"}),
        ({"duty_percent": 50}, {"duty"}),
        ({"representation": Representation.NONE, "rate_hz": 0.0, "rho": 0.0}, {"topology"}),
    ]
    for fields, decided in changes:
        assert decisions_of(full._replace(**fields)) == decided


def test_what_a_policy_does_for_who_is_gone_is_no_decision_of_its_own() -> None:
    def to_all(view: Any) -> list[Directive]:
        return [Directive(view.ego, p, Representation.FEATURES, 1.0, None, 10.0 - 5.0 * (p == 2)) for p in view.peers]

    gone = VIEW._replace(age_s={0: 0.0, 1: 0.0, 2: 9.0})
    assert observe(to_all, [gone]).decisions == frozenset()
    assert observe(to_all, [VIEW]).decisions == {"rate"}
