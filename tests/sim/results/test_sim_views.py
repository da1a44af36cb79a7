"""The views and answers that a run keeps are those that flew, to the last bit, in whatever the fleet meets."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import pytest

import sortie
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, Disc, FleetView, Representation
from sortie.policies.verification.kit.views import draw_view, to_json
from sortie.sim.results import arrow_types
from sortie.sim.results.views import decisions

SHORT = {"duration_s": 4, "perception.detector": "none", "record.views": True}
SHOWN = draw_view(3, 7)
MEETS: dict[str, dict[str, object]] = {
    "nothing": {},
    "losses, small descriptors and another rule of age": {
        "fleet.formation.spacing_m": 150,
        "radio.bursts.good_to_bad": 0.3,
        "context.form": "small",
        "context.detached_after_periods": 14,
        "events": [{"kind": "link_drop", "at_s": 0.5, "drone": 1, "loss_db": 40, "until_s": 3}],
    },
    "a lie that costs trust, and a wrong clock": {
        "events": [
            {"kind": "lie", "at_s": 0.5, "drone": 1},
            {"kind": "clock_skew", "at_s": 1, "drone": 2, "skew_s": -0.37},
        ],
        "duration_s": 10,
    },
    "an attack on an open plane, and a view that it is shown": {
        "fleet.drones": 20,
        "duration_s": 1,
        "context.authentication": False,
        "events": [{"kind": "spoof", "at_s": 0.3, "drone": 1, "attack": "forged"}],
        "policy.replays": [{"at_s": 0.5, "drone": SHOWN.ego, "view": json.loads(json.dumps(to_json(SHOWN)))}],
    },
}


@functools.cache
def flown(meets: str) -> tuple[sortie.Run, list[FleetView], list[Sequence[Directive]]]:
    """A flight of the worked policy, and every view and answer as they were, in their order."""
    views, answers = [], []

    def spy(view: FleetView) -> list[Directive]:
        views.append(view)
        answers.append(worked(view))
        return answers[-1]

    return sortie.fly("track_target", {**SHORT, **MEETS[meets]}, policy=spy), views, answers


def _oldest_s(views: Sequence[FleetView], of: int | None = None) -> float:
    """The greatest age of a descriptor, or of one drone's to the others."""
    return max(age_s for v in views for i, age_s in v.age_s.items() if of in (None, i) and i != v.ego)


@pytest.mark.parametrize("meets", MEETS)
def test_kept_views_are_those_that_flew(meets: str, tmp_path: Path) -> None:
    run, views, answers = flown(meets)
    kept = list(decisions(sortie.open_run(run.save(tmp_path / "run", recording=False)).tables))
    assert [d.view for d in kept] == views
    assert [list(d.directives) for d in kept] == answers
    # equal in their types too, the sign of a zero, and the reasons, which are no part of equality
    if "shown" not in meets:  # which is from JSON, where 1 and 1.0 are the same
        assert repr([(d.view, list(d.directives)) for d in kept]) == repr(list(zip(views, answers, strict=True)))


def test_these_flights_meet_what_they_are_to_meet() -> None:
    """Otherwise the test above would show nothing: some drones hear less, doubt, or read another clock."""
    calm, losses, lie, attack = (flown(meets) for meets in MEETS)
    assert _oldest_s(calm[1]) < 0.6, "a few descriptors collide"
    assert _oldest_s(losses[1]) > 1.0
    assert _oldest_s(lie[1], of=2) > _oldest_s(calm[1], of=2)
    assert lie[0].outcome["distrusted_by"]["1"] > 0
    assert [v for v in lie[1] if v.ego != 1 and 1 in v.descriptors and v.descriptors[1].battery_soc == 0.0]
    assert any(view == SHOWN for view in attack[1])


def test_keeping_views_changes_nothing_that_flies_and_they_are_kept_before_the_shield() -> None:
    rules = {"duration_s": 2, "policy.invariants": "rho <= 0.1", "policy.shield": True}
    kept, plain = (sortie.fly("track_target", {**SHORT, **rules, "record.views": views}) for views in (True, False))
    assert kept.fingerprint == plain.fingerprint
    assert set(kept.tables) - set(plain.tables) == {"views", "view_descriptors", "view_directives"}
    assert kept.outcome["policies"]["shield_interventions"] > 0
    answers = [d for decision in decisions(kept.tables) for d in decision.directives]
    assert max(d.rho for d in answers) > 0.1


def test_a_wrong_directive_is_reported_as_without_views() -> None:
    with pytest.raises(sortie.PolicyError, match="a policy returns Directive, got NoneType"):
        sortie.fly("track_target", SHORT, policy=lambda view: [None for _ in view.peers])  # type: ignore[misc]


def test_every_part_of_a_view_is_kept() -> None:
    """A new field of the view needs a column in `sortie.sim.results.views`."""
    assert FleetView._fields == ("ego", "period_s", "descriptors", "age_s", "detached_after_periods")


class Colour(IntEnum):
    RED = 3


class Grown(NamedTuple):
    """Fields as a later descriptor may have them."""

    whole: int
    numbers: tuple[float, ...]
    pairs: tuple[tuple[int, bytes], ...]
    disc: Disc | None
    discs: tuple[Disc, ...]
    by_id: Mapping[int, float]
    colour: Colour
    maybe: tuple[float, float] | None = None
    name: str = ""


class Odd(NamedTuple):
    ids: set[int]


def test_new_fields_survive_and_a_type_without_a_column_is_named() -> None:
    rows = [
        Grown(2**60, (0.1, -0.0), ((1, b"a"), (7, b"")), None, (Disc(1.0, 2.0, 3.0),), {4: 0.3}, Colour.RED),
        Grown(-1, (), (), Disc(1e300, -0.0, 5e-324), (), {}, Colour.RED, (1 / 3, 2.0), "ρ"),
    ]
    assert repr(arrow_types.from_table(Grown, arrow_types.to_table(Grown, rows))) == repr(rows)
    with pytest.raises(TypeError, match=r"Odd.ids: set\[int\] has no form as a column"):
        arrow_types.columns_of(Odd)


def test_rungs_come_back_as_rungs() -> None:
    kept = [Directive(0, 1, Representation.RAW, reason="x")]
    (back,) = arrow_types.from_table(Directive, arrow_types.to_table(Directive, kept))
    assert back.representation is Representation.RAW
