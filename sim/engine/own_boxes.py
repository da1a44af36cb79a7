"""Each drone's own detections, capture by capture: what its tracker takes in. They do not depend on what was sent. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence

from sortie.perception.detectors import Detector, DetectsAhead, DetectsMany
from sortie.perception.types import Boxes, Capture
from sortie.sim.engine.tracking import Ahead


class OwnBoxes:
    """Own detections of a detector, computed when they are asked for.

    A detector that computes many moments together also computes the captures that are expected next. So a tracker can use
    it in flight at little more than what it costs at the end of a sortie.
    """

    def __init__(self, detector: Detector, coming: Ahead) -> None:
        """Args: `coming` has captures that will probably be asked for; in flight they may turn out others."""
        self._detector, self._coming = detector, coming
        self._many = detector if isinstance(detector, DetectsMany) else None
        self._ahead = detector if isinstance(detector, DetectsAhead) else None
        self._known: dict[Capture, Boxes] = {}
        self._until_s = float("-inf")

    def __call__(self, captures: Sequence[Capture]) -> list[Boxes]:
        """The boxes of each capture, ENU, best first."""
        if self._many is None:
            jobs = [(capture, ()) for capture in captures]
            return self._detector.detect(jobs) if self._ahead is None else self._ahead.begin(jobs)()
        missing = [c for c in captures if c not in self._known]
        if missing:
            now_s = max(c.t_s for c in captures)
            if now_s > self._until_s:
                next_ones = list(self._coming.after(now_s))
                self._known = {c: self._known[c] for c in captures if c in self._known}
                self._until_s = max((c.t_s for c in next_ones), default=self._until_s)
                missing = list(dict.fromkeys([*missing, *next_ones]))
            self._known.update(zip(missing, self._many.detect_many([[(c, ())] for c in missing]), strict=True))
        return [self._known.pop(c) for c in captures]
