"""Prior methods and representations in flight: what each sends or asks first takes airtime and is counted."""

from __future__ import annotations

import pyarrow.compute as pc
import pytest
from sim_examples import example

from sortie.perception.errors import InputError
from sortie.policies.catalogue.prior import METHODS
from sortie.scenarios.representation import BOXES, NAME_OF, REPRESENTATION_OF, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.compare import Contender, compare
from sortie.sim.export.messages import directives
from sortie.sim.results.outcome import outcome
from sortie.sim.results.palette import SENT
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.report_figures import SENT as REPORT

FEW = ("fleet.drones=3", "mission.phases=[{}]")


def flown(policy: str, *more: str) -> SortieRecord:
    """A short flight of its own: the recorded ones fly the worked policy."""
    return run_sortie(example("duration_s=2", *FEW, f"policy={{name: {policy}}}", *more))


def kinds(record: SortieRecord) -> set[str]:
    return set(record.tables["transmissions"]["representation"].to_pylist())


def test_every_method_flies_in_a_comparison() -> None:
    contenders = [Contender(m, example("duration_s=1.5", *FEW, f"policy={{name: {m}}}")) for m in METHODS]
    sent = {r.policy: r.outcome["bytes"]["data_sent"] for r in compare(contenders, [1])[0]}
    assert all(sent.values())
    assert sent["fixed-compression"] < sent["where2comm-style"] < sent["v2vnet-style"] == sent["disconet-style"]
    assert sent["who2com-style"] < sent["disconet-style"]


@pytest.mark.filterwarnings("error")
def test_where_there_is_nothing_to_find_there_is_no_gain() -> None:
    """Not a gain of NaN, which JSON has no word for."""
    empty = "perception={detector: surrogate, scene: {parked_density: 0, moving_cars_per_km: 0}}"
    sets = ("duration_s=1", *FEW, "mission.target=null", empty)
    contenders = [Contender(name, example(*sets, f"policy={{name: {name}}}")) for name in ("silence", "all-4")]
    rows, gains = compare(contenders, [1])
    assert [r.outcome["ap50"]["scored_fusions"] for r in rows] == [6, 6]
    assert [r.gain for r in rows] == [{"full_scene": None, "mission": None}] * 2
    assert gains == ()


def test_a_handshake_takes_airtime_stands_in_the_outcome_and_is_no_payload() -> None:
    plain, asking = (flown("where2comm-style", f"policy.params={{rho: 0.02, rounds: {rounds}}}") for rounds in (1, 2))
    sent = asking.tables["transmissions"]
    asked = sent.filter(pc.equal(sent["representation"], "handshake"))
    assert set(asked["payload_bytes"].to_pylist()) == {8192}
    assert pc.sum(asked["airtime_s"]).as_py() > 0.0
    first, second = outcome(plain), outcome(asking)
    assert first["bytes"]["handshakes_sent"] == 0
    assert second["bytes"]["handshakes_sent"] == asked.num_rows * 8192
    assert second["bytes"]["data_sent"] == pc.sum(sent["payload_bytes"]).as_py()
    assert second["medium_busy_fraction"] > first["medium_busy_fraction"]
    # every drone asks every peer it has heard, once a frame: 6 links, the first frames apart
    assert asked.num_rows == pytest.approx(6 * 20, rel=0.06)
    served = flown("who2com-style", "perception.detector=surrogate")
    assert {k for ks in served.tables["fusions"]["representations"].to_pylist() for k in ks} == {"features"}
    assert kinds(served) == {"features", "handshake"}


def test_uncertain_boxes_fly_by_the_surrogate_and_count_36_bytes_each() -> None:
    record = flown("uncertain-boxes", "perception.detector=surrogate")
    rows = record.tables["transmissions"].to_pylist()
    assert kinds(record) == {"uncertain_boxes"}
    assert all(r["payload_bytes"] == 76 + 36 * r["boxes"] for r in rows)
    assert any(r["boxes"] > 5 for r in rows)
    assert {how for r in record.tables["fusions"].to_pylist() for how in r["representations"]} == {"uncertain_boxes"}
    assert {d.representation for _, d in directives(record)} >= {Representation.UNCERTAIN_BOXES}
    assert outcome(record)["ap50"]["full_scene"] is not None


def test_codes_are_traffic_of_exact_size_and_the_surrogate_refuses_them() -> None:
    record = flown("codes", "perception.code_bytes=5", "policy.params={received_budget: 0.05}")
    rows = record.tables["transmissions"].to_pylist()
    assert kinds(record) == {"codes"}
    assert {r["cells"] for r in rows} == {409, 410} or {r["cells"] for r in rows} <= {102, 103, 204, 205, 409, 410}
    assert all(r["payload_bytes"] == 76 + 8 + 5 * r["cells"] + r["index_bytes"] for r in rows)
    words = r"the surrogate cannot estimate what codes do: .* Set perception.detector to torch"
    with pytest.raises(InputError, match=words):
        flown("codes", "perception.detector=surrogate")


def test_every_representation_has_its_colours_and_its_way_on_the_air() -> None:
    sent = set(REPRESENTATION_OF) - {"none"}
    assert sent <= set(SENT)
    assert sent <= set(REPORT)
    assert len({SENT[name] for name in sent}) == len({REPORT[name] for name in sent}) == len(sent)
    assert {NAME_OF[r] for r in BOXES} == {"tracks", "detections", "uncertain_boxes"}
