"""A recording as a sortie's detector: a drone sees the record nearest to its capture. Free of torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sortie.perception import budget
from sortie.perception.errors import InputError
from sortie.perception.geometry import CELLS, CHANNELS, FULL
from sortie.perception.ground_truth import ground_truth
from sortie.perception.joining import NMS_IOU, EgoSources, SourceBoxes, joined_many, sendable, source_of
from sortie.perception.lateness import own_age_s, weighed
from sortie.perception.metrics.ap import suppress
from sortie.perception.recordings.exchange import Sent, fused, received_boxes
from sortie.perception.recordings.recording import RecordingError, open_recording
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.plugins.reference import resolve
from sortie.scenarios.schema import Perception

NEAR_M = 5.0
"""The drone of the sortie has to be this near to where the recorded one was."""


class RecordedDetector:
    """A recording flown.

    Args:
        config: the scenario's `perception` section; `recording` names the file, `recorded_fusion` the user's fusion.

    A capture shows the recorded frame whose time is nearest, at most one step of the recording away (the median
    distance of its frames), of the drone with the same number, which must have been within 5 m of it. The recording's
    poses and truth are the world; the sortie's decide how many cells go, so that bytes on the air are exact.

    Raises:
        RecordingError: a broken recording, one of several scenes, or of other features than the radio carries.
    """

    name = "recorded"
    """As `perception.detector` names it."""

    def __init__(self, config: Perception) -> None:
        self._recording = rec = open_recording(Path(config.recording or ""))
        self._config = config
        self._fuse = None if config.recorded_fusion is None else resolve("recorded_fusion", config.recorded_fusion)
        scenes = len(set(rec.scene.tolist()))
        if scenes > 1:
            raise RecordingError(f"{rec.path}: scene names {scenes} scenes, must be one to be flown")
        if rec.grid != (CHANNELS, CELLS, CELLS) or abs(rec.geometry.half_extent_m - FULL.half_extent_m) > 1e-6:
            c, h, w = rec.grid
            bound = f"{CHANNELS} × {CELLS} × {CELLS} of {FULL.cell_m:g} m, as a sortie's radio carries them"
            raise RecordingError(f"{rec.path}: features are {c} × {h} × {w} of {rec.cell_m:g} m, must be {bound}")
        if self._fuse is not None and "features" not in rec.large:
            raise RecordingError(f"{rec.path}: features are missing, must be there for perception.recorded_fusion")
        self._step_s = float(np.median(np.diff(rec.t_s))) if len(rec) > 1 else 0.1

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]:
        """Each ego's boxes from its own record and the shares it received, ENU, best first."""
        now = {ego.drone: ego for ego, _ in jobs}
        return [self._detect_ego(ego, shares if self._config.fusion != "none" else (), now) for ego, shares in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        """The recorded cars of the frame nearest to `t_s`, in the square about where the ego was recorded."""
        pose = self._recording.pose[self._frame(ego), ego.drone]
        return ground_truth(self._recording.truth(self._nearest(t_s, "truth")), pose).single()

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """How many recorded detections the drone would send."""
        return len(self._sendable(self._alone(capture, self._pose(capture))).inside(roi))

    def camera_views(self, capture: Capture) -> NDArray[np.uint8]:
        """There are none.

        Raises:
            InputError: always.
        """
        raise InputError("a recording holds no images: fly with perception.detector = torch to see camera views")

    # --- one ego ---------------------------------------------------------------------------------

    def _detect_ego(self, ego: Capture, shares: Sequence[Share], now: Mapping[int, Capture]) -> Boxes:
        config, pose = self._config, self._pose(ego)
        at = (self._frame(ego), ego.drone)
        if self._fuse is not None and ego.looked:
            shares = weighed(ego, shares)
        weighted = [s for s in shares if s.weight > 0.0]
        for s in weighted:
            if s.representation == "codes":
                raise InputError("a recording has no codebook: let policies send features")
        maps = [self._sent(s, now) for s in weighted if s.is_map]
        if self._fuse is not None and maps and ego.looked:
            local = fused(self._fuse, self._recording, at, pose, maps, config.unsent_cells)
        else:
            own_at, freshest_s = (at, own_age_s(ego, shares)) if ego.looked else (None, 0.0)
            local = received_boxes(self._recording, own_at, pose, maps, freshest_s)
        own = Boxes.placed(local[local[:, 5] >= config.score_threshold], pose)
        own = suppress(own, NMS_IOU)
        late = [self._source(s) for s in weighted if not s.is_map]
        sources = EgoSources.of(ego, shares, own, bool(maps), late)._replace(pose=pose)
        if not ego.looked:  # what it received has lost by its age
            sources = sources._replace(age_s=0.0)
        return joined_many([sources], config.join)[0]

    def _sent(self, share: Share, now: Mapping[int, Capture]) -> Sent:
        capture, config = share.capture, self._config
        frame = self._frame(capture)
        cells = np.ones((CELLS, CELLS), bool)
        if share.representation != "raw":
            est = capture.est_pose
            rank = np.zeros((CELLS, CELLS))
            if share.missing or budget.must_choose(share.rho, share.roi, *est):
                rank = self._recording.rank(frame, capture.drone)
            cells = budget.select(rank, share.rho, share.roi, *est, share.missing)
        lies = capture if config.motion_compensation else now.get(capture.drone, capture)
        return Sent(frame, capture.drone, cells, self._pose(lies), share.weight, share.age_s)

    def _source(self, share: Share) -> SourceBoxes:
        if share.boxes is not None or share.capture.drone >= self._recording.drones:  # of another network
            return source_of(share, None)
        pose = self._pose(share.capture)
        alone = self._sendable(self._alone(share.capture, pose)) if share.is_detected else None
        return replace(source_of(share, alone), pose=pose)

    def _sendable(self, boxes: Boxes) -> Boxes:
        """Those of a drone's boxes that it sends: in late fusion only confident ones."""
        return sendable(boxes) if self._config.fusion == "late" else boxes

    def _alone(self, capture: Capture, pose: tuple[float, float, float]) -> Boxes:
        local = self._recording.boxes(self._frame(capture), capture.drone)
        return suppress(Boxes.placed(local[local[:, 5] >= self._config.score_threshold], pose), NMS_IOU)

    # --- which record ----------------------------------------------------------------------------

    def _frame(self, capture: Capture) -> int:
        """The recorded frame of a capture.

        Raises:
            RecordingError: no such drone, no such time, or the drone was elsewhere.
        """
        rec = self._recording
        if capture.drone >= rec.drones:
            raise RecordingError(f"{rec.path}: drone {capture.drone} is not in it, must be one of 0 … {rec.drones - 1}")
        frame = self._nearest(capture.t_s, f"drone {capture.drone}")
        x, y = rec.pose[frame, capture.drone, :2]
        off = float(np.hypot(x - capture.position_m[0], y - capture.position_m[1]))
        if off > NEAR_M:
            raise RecordingError(
                f"{rec.path}: drone {capture.drone} at {capture.t_s:g} s flies {off:.1f} m from where it was recorded, "
                f"must be within {NEAR_M:g} m: give the scenario the recording's route"
            )
        return frame

    def _nearest(self, t_s: float, who: str) -> int:
        times = self._recording.t_s
        k = int(np.searchsorted(times, t_s))
        frame = min((i for i in (k - 1, k) if 0 <= i < len(times)), key=lambda i: (abs(times[i] - t_s), i))
        off = abs(float(times[frame]) - t_s)
        if off > self._step_s * (1 + 1e-9):
            bound = f"within {self._step_s:g} s of a frame ({times[0]:g} … {times[-1]:g} s)"
            raise RecordingError(f"{self._recording.path}: {who} is needed at {t_s:g} s, must be {bound}")
        return frame

    def _pose(self, capture: Capture) -> tuple[float, float, float]:
        x, y, yaw = self._recording.est_pose[self._frame(capture), capture.drone].tolist()
        return x, y, yaw
