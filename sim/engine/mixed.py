"""Drones with different networks in one fleet: each drone's jobs go to its own network.

No job has feature maps of another network: receivers refuse those (`PeerMemory.can_fuse`). Detections of a drone with
another network are what that network finds in the sender's capture. A drone without a detector has no capture of its own:
any network joins the boxes that it was sent. Free of torch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from numpy.typing import NDArray

from sortie.perception.detectors import Detector, DetectsMany, box_errors_of
from sortie.perception.joining import sendable
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.perception.uncertainty import BoxErrors
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scenario

Job = tuple[Capture, Sequence[Share]]
Maker = Callable[[SceneModel, Perception, int, int], Detector | None]


def mixed(detector_of: Maker, scene: SceneModel, scenario: Scenario, seed: int, replication: int) -> Detector | None:
    """The fleet's detector: one network, or one for each that its makes name; None flies without."""
    perception, each = scenario.perception, scenario.networks
    networks = list(dict.fromkeys(n for n, blind in zip(each, scenario.context_only, strict=True) if not blind))
    found = [detector_of(scene, perception.model_copy(update=n._asdict()), seed, replication) for n in networks]
    detectors = [d for d in found if d is not None]
    if len(detectors) < 2:
        return detectors[0] if detectors else None
    of_drone = [networks.index(n) if n in networks else 0 for n in each]
    cut = perception.fusion == "late"  # then the network's drones send confident boxes alone
    sends = [sendable if cut and network.detector == "torch" else None for network in networks]
    if all(isinstance(d, DetectsMany) for d in detectors):
        return MixedMany(detectors, of_drone, sends)
    return Mixed(detectors, of_drone, sends)


class Mixed:
    """Several detectors as one."""

    def __init__(
        self, detectors: Sequence[Detector], of_drone: Sequence[int], sends: Sequence[Callable[[Boxes], Boxes] | None]
    ) -> None:
        """Args:
        detectors: one for each network.
        of_drone: each drone's place among them.
        sends: which of its boxes a drone of each network sends; None sends all.
        """
        self._detectors, self._of, self._sends = detectors, of_drone, sends
        self.name = " + ".join(dict.fromkeys(str(getattr(d, "name", type(d).__name__)) for d in detectors))

    def detect(self, jobs: Sequence[Job]) -> list[Boxes]:
        """Each ego's boxes from its own capture and the shares it received, ENU, best first."""
        return list(self._detected([jobs]))

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        """The cars in the ego's square at `t_s`, ENU."""
        return self._detectors[0].truth(t_s, ego)

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """The number of detections that the drone would send, by its own network."""
        return self._detectors[self._of[capture.drone]].count_boxes(capture, roi)

    def camera_views(self, capture: Capture) -> NDArray[Any]:
        """The drone's camera images."""
        return self._detectors[self._of[capture.drone]].camera_views(capture)

    def _detected(self, moments: Sequence[Sequence[Job]]) -> Iterator[Boxes]:
        moments = self._with_foreign_boxes(moments)
        found = [
            iter(_run(d, [[j for j in moment if self._of[j[0].drone] == k] for moment in moments]))
            for k, d in enumerate(self._detectors)
        ]
        for moment in moments:
            for ego, _ in moment:
                yield next(found[self._of[ego.drone]])

    def _with_foreign_boxes(self, moments: Sequence[Sequence[Job]]) -> Sequence[Sequence[Job]]:
        """The same jobs; detections that another network made bring their boxes."""
        wanted: list[dict[Capture, None]] = [{} for _ in self._detectors]
        errors: dict[int, BoxErrors] = {}
        for moment in moments:
            for ego, shares in moment:
                for share in shares:
                    if self._is_foreign(ego, share):
                        k = self._of[share.capture.drone]
                        wanted[k][share.capture] = None
                        if share.representation == "uncertain_boxes" and k not in errors:
                            errors[k] = box_errors_of(self._detectors[k])
        boxes: dict[Capture, Boxes] = {}
        for detector, sends, captures in zip(self._detectors, self._sends, wanted, strict=True):
            made = _run(detector, [[(c, ())] for c in captures])
            boxes |= zip(captures, made if sends is None else map(sends, made), strict=True)
        if not boxes:
            return moments
        return [
            [
                (
                    ego,
                    [
                        s._replace(boxes=boxes[s.capture], errors=errors.get(self._of[s.capture.drone]))
                        if self._is_foreign(ego, s)
                        else s
                        for s in shares
                    ],
                )
                for ego, shares in moment
            ]
            for moment in moments
        ]

    def _is_foreign(self, ego: Capture, share: Share) -> bool:
        return share.is_detected and share.weight > 0.0 and self._of[share.capture.drone] != self._of[ego.drone]


class MixedMany(Mixed):
    """The same of detectors that compute many moments together."""

    def __init__(
        self, detectors: Sequence[Detector], of_drone: Sequence[int], sends: Sequence[Callable[[Boxes], Boxes] | None]
    ) -> None:
        """Args: as for `Mixed`."""
        super().__init__(detectors, of_drone, sends)
        self.calibration = " + ".join(dict.fromkeys(str(getattr(d, "calibration", "")) for d in detectors))

    def detect_many(self, moments: Sequence[Sequence[Job]]) -> Iterable[Boxes]:
        """As `detect`, moment after moment, job after job."""
        return list(self._detected(moments))

    def truth_many(self, t_s: Sequence[float], egos: Sequence[Capture]) -> Iterable[Boxes]:
        """As `truth`, ego by ego."""
        first = self._detectors[0]
        if isinstance(first, DetectsMany):
            return first.truth_many(t_s, egos)
        return [first.truth(t, ego) for t, ego in zip(t_s, egos, strict=True)]


def _run(detector: Detector, moments: Sequence[Sequence[Job]]) -> list[Boxes]:
    if isinstance(detector, DetectsMany):
        return list(detector.detect_many(moments))
    return [boxes for moment in moments if moment for boxes in detector.detect(moment)]
