"""Networks of a fleet: what each drone detects by its own, what is detected ahead, and boxes of another network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from agent_rig import capture
from sim_examples import example

from sortie.perception.types import Boxes, Capture, Share
from sortie.sim.engine import mixed as mixed_module
from sortie.sim.engine.mixed import Mixed, MixedMany, mixed
from sortie.sim.engine.own_boxes import OwnBoxes

# --- own detections ------------------------------------------------------------------------------


def _box(of: Capture) -> Boxes:
    """A box that names the capture it is of."""
    return Boxes(np.array([[of.t_s, float(of.drone)]]), np.array([[4.5, 1.9]]), np.zeros(1), np.ones(1))


class Many:
    """A detector of many moments; `asked` are the captures of each call."""

    calibration = "made up"

    def __init__(self) -> None:
        self.asked: list[list[tuple[int, float]]] = []

    def detect_many(self, moments: Sequence[Sequence[tuple[Capture, Any]]]) -> Iterable[Boxes]:
        self.asked.append([(c.drone, c.t_s) for moment in moments for c, _ in moment])
        assert all(not shares for moment in moments for _, shares in moment)
        return [_box(c) for moment in moments for c, _ in moment]

    def truth_many(self, t_s: Any, egos: Any) -> list[Boxes]:
        return []

    detect = truth = count_boxes = camera_views = None


def _told(boxes: Sequence[Boxes]) -> list[tuple[int, float]]:
    return [(int(b.xy_m[0, 1]), float(b.xy_m[0, 0])) for b in boxes]


def test_what_comes_next_is_detected_ahead_and_everything_once() -> None:
    ahead: list[float] = []

    def coming(after_s: float) -> list[Capture]:
        ahead.append(after_s)
        return [capture(d, after_s + t) for t in (1.0, 2.0) for d in (0, 1)]

    many = Many()
    own = OwnBoxes(many, SimpleNamespace(after=coming))  # type: ignore[arg-type]
    assert _told(own([capture(1, 0.0), capture(0, 0.0)])) == [(1, 0.0), (0, 0.0)]
    assert many.asked == [[(1, 0.0), (0, 0.0), (0, 1.0), (1, 1.0), (0, 2.0), (1, 2.0)]]
    assert _told(own([capture(1, 1.0), capture(0, 2.0)])) == [(1, 1.0), (0, 2.0)]
    assert (len(many.asked), ahead) == (1, [0.0])
    # another than was expected is detected alone, while what is known reaches beyond it
    assert _told(own([capture(2, 1.5), capture(0, 1.0)])) == [(2, 1.5), (0, 1.0)]
    assert (many.asked[1:], ahead) == ([[(2, 1.5)]], [0.0])
    # beyond that, the next ones are asked for anew; of what was known what is wanted now stays
    assert _told(own([capture(1, 2.0), capture(2, 2.5)])) == [(1, 2.0), (2, 2.5)]
    assert ahead == [0.0, 2.5]
    assert many.asked[2:] == [[(2, 2.5), (0, 3.5), (1, 3.5), (0, 4.5), (1, 4.5)]]
    assert own._known.keys() == {capture(d, t) for t in (3.5, 4.5) for d in (0, 1)}, "what was asked for is not kept"


def test_a_detector_of_single_moments_detects_when_it_is_asked() -> None:
    class Single:
        def detect(self, jobs: Sequence[tuple[Capture, Any]]) -> list[Boxes]:
            return [_box(c) for c, _ in jobs]

    class Ahead(Single):
        def begin(self, jobs: Sequence[tuple[Capture, Any]]) -> Callable[[], list[Boxes]]:
            return lambda: [_box(c._replace(t_s=c.t_s + 100.0)) for c, _ in jobs]

    asked = [capture(1, 0.5), capture(0, 0.5)]
    assert _told(OwnBoxes(Single(), SimpleNamespace(after=lambda _: []))(asked)) == [(1, 0.5), (0, 0.5)]  # type: ignore[arg-type]
    assert _told(OwnBoxes(Ahead(), SimpleNamespace(after=lambda _: []))(asked)) == [(1, 100.5), (0, 100.5)]  # type: ignore[arg-type]


# --- several networks ----------------------------------------------------------------------------


class Net:
    """A detector that finds one box at its number, and can do many moments or not."""

    def __init__(self, number: int) -> None:
        self.number, self.calibration = number, f"fit {number}"
        self.asked: list[Capture] = []

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]:
        self.asked += [c for c, _ in jobs]
        return [Boxes(np.array([[float(self.number), 0.0]]), np.ones((1, 2)), np.zeros(1), np.ones(1)) for _ in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        return Boxes.empty()

    def count_boxes(self, capture: Capture, roi: Any) -> int:
        return self.number

    def camera_views(self, capture: Capture) -> Any:
        return np.array([self.number])


class ManyNet(Net):
    def detect_many(self, moments: Sequence[Any]) -> list[Boxes]:
        return [boxes for moment in moments for boxes in self.detect(moment)]

    def truth_many(self, t_s: Any, egos: Any) -> list[Boxes]:
        return [Boxes.empty() for _ in egos]


def _share(drone: int, weight: float = 1.0, what: str = "detections") -> Share:
    return Share(capture(drone, 1.0), what, 0.0, None, weight)


def test_every_drone_is_counted_shown_and_detected_by_its_own_network() -> None:
    captures = [capture(i, 0.0) for i in range(4)]
    for of_drone in ((0, 1, 0, 2), (2, 2, 1, 0)):
        fleet = Mixed([Net(k) for k in range(3)], of_drone, [None] * 3)
        assert tuple(fleet.count_boxes(c, None) for c in captures) == of_drone
        assert tuple(int(fleet.camera_views(c)[0]) for c in captures) == of_drone
        for order in (captures, captures[::-1]):
            found = fleet.detect([(c, []) for c in order])
            assert [b.xy_m[0, 0] for b in found] == [of_drone[c.drone] for c in order]
        ((_, (given,)),) = fleet._with_foreign_boxes([[(captures[0], [_share(1)])]])[0]
        if of_drone[0] == of_drone[1]:
            assert given.boxes is None  # its own network finds them
        else:
            assert given.boxes is not None
            assert given.boxes.xy_m[0, 0] == of_drone[1]


def test_boxes_of_weight_zero_are_not_detected_and_maps_are_left_to_the_network() -> None:
    nets = [Net(0), Net(1)]
    fleet = Mixed(nets, [0, 1, 1], [None, None])
    fleet.detect([(capture(0, 1.0), [_share(1, 0.0), _share(2, what="features")])])
    assert (nets[0].asked, nets[1].asked) == ([capture(0, 1.0)], [])
    fleet.detect([(capture(0, 1.0), [_share(1), _share(2)])])
    assert nets[1].asked == [capture(1, 1.0), capture(2, 1.0)]


def test_uncertain_boxes_bring_the_errors_of_the_network_that_made_them(monkeypatch: pytest.MonkeyPatch) -> None:
    nets = [Net(0), Net(1), Net(2)]
    monkeypatch.setattr(mixed_module, "box_errors_of", lambda d: f"errors of {d.number}")
    fleet = Mixed(nets, [0, 1, 2], [None, lambda boxes: boxes.take(slice(0, 0)), None])
    shares = [_share(1, what="uncertain_boxes"), _share(2)]
    ((_, given),) = fleet._with_foreign_boxes([[(capture(0, 1.0), shares)]])[0]
    assert [s.errors for s in given] == ["errors of 1", None]
    assert [len(s.boxes) for s in given] == [0, 1], "network 1 sends none of its boxes"


@pytest.mark.parametrize("kinds", [(Net, Net), (Net, ManyNet), (ManyNet, Net), (ManyNet, ManyNet)])
def test_networks_that_do_many_moments_do_so_where_all_can(kinds: tuple[type[Net], type[Net]]) -> None:
    makes = "fleet.makes=[{name: a, drones: [1], detector: torch}]"
    scenario = example("perception={detector: surrogate, fusion: late}", "fleet.drones=3", makes)
    made: list[str] = []

    def maker(scene: Any, perception: Any, seed: int, replication: int) -> Net:
        assert (seed, replication) == (3, 4)
        made.append(perception.detector)
        return kinds[len(made) - 1](len(made) - 1)

    fleet = mixed(maker, None, scenario, 3, 4)  # type: ignore[arg-type]
    assert isinstance(fleet, Mixed)
    assert isinstance(fleet, MixedMany) == (kinds == (ManyNet, ManyNet))
    assert made == ["surrogate", "torch"]
    assert [fleet.count_boxes(capture(d, 0.0), None) for d in range(3)] == [0, 1, 0]
    early = example("perception.detector=surrogate", "fleet.drones=3", makes)
    made.clear()
    assert mixed(maker, None, early, 3, 4)._sends == [None, None]  # type: ignore[arg-type, union-attr]
    assert [s is not None for s in fleet._sends] == [False, True], (
        "late fusion's torch drones send confident boxes alone"
    )
