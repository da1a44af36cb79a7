"""What each drone fuses at a moment, and what it finds so, where that goes with its maps (`perception.maps_bring_boxes`)."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from itertools import count
from typing import Any

import numpy as np
import simpy

from sortie.fleet.agent import Agent
from sortie.fleet.memory import Received
from sortie.perception.budget import MAX_TRACKS
from sortie.perception.classes import PERSON
from sortie.perception.detectors import Detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Found, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.frames import instant
from sortie.scenarios.representation import DETECTED_NAMES, NAME_OF
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.tracking import FleetTracking, cars_in_reach


def as_share(received: Received, trust: float = 1.0, age_s: float = 0.0) -> Share:
    """A received payload in the detector's form.

    Args:
        trust: the receiver's in the sender, 0 … 1; it multiplies the payload's weight.
        age_s: of the capture, as the receiver knows it.

    What its age leaves of it is the detector's to say: it differs between maps and boxes.
    """
    payload = received.payload
    name, weight = NAME_OF[payload.representation], payload.fusion_weight * trust
    tracks, people = payload.tracks, payload.people
    return Share(
        received.capture, name, payload.rho, payload.roi, weight, received.missing, age_s, tracks, people=people
    )


def found_in(received: Received, of_map: Share) -> Share | None:
    """The boxes that came with a map, in the detector's form; None where none came."""
    found = received.payload.found
    if found is None:
        return None
    age_s = of_map.age_s + (received.capture.t_s - found.capture.t_s)
    return Share(found.capture, "detections", 0.0, of_map.roi, of_map.weight, age_s=age_s, boxes=found.boxes)


def of_vehicles(share: Share) -> Share:
    """What a detector takes of a share: it joins vehicles alone."""
    tracks = share.tracks
    if tracks is None or not np.any(person := tracks.kind == PERSON):
        return share
    return share._replace(tracks=tracks.take(~person), cut=share.cut or len(tracks) >= MAX_TRACKS)


Job = tuple[Capture, list[Share]]
"""An ego's capture, and the shares of its peers."""


def is_flying(agent: Agent, frame: int, frame_s: float) -> bool:
    """Whether a drone flies in this frame; one that came back does so once it has sensed."""
    came_back = agent.here is not None and agent.here.t_s < (frame - 1.5) * frame_s
    return agent.status.airborne and not came_back


def ready(agent: Agent) -> Capture | None:
    """The pose of a drone that may fuse; None before its first look is computed."""
    return agent.here if agent.latest is not None or not agent.status.looks or agent.status.blocked else None


class Fusing:
    """What drones fuse, of their own looks and of what they hold."""

    def __init__(self, scenario: Scenario, tracking: FleetTracking) -> None:
        """Args: `tracking` has what each drone's own tracker follows."""
        config = scenario.perception
        self._limit_s, self._fusion_delay_s = config.max_age_s, config.fusion_delay_s
        self._tracking, self._delays_s = tracking, scenario.compute_delays_s

    def maps(self, agent: Agent, now_s: float) -> list[Share]:
        """The maps among what the agent received lately, by ascending peer."""
        return [share for _, share in self._held(agent, now_s) if share.is_map]

    def shares(self, agent: Agent, now_s: float) -> list[Share]:
        """What the agent received lately, by ascending peer; boxes that came with a map follow it."""
        shares = []
        for received, share in self._held(agent, now_s):
            shares.append(share)
            if (boxes := found_in(received, share)) is not None and instant(boxes.age_s) <= instant(self._limit_s):
                shares.append(boxes)
        if any(s.representation in DETECTED_NAMES for s in shares):
            own = self._tracking.tracks(agent.drone)
            shares = [s._replace(tracks=own) if s.representation in DETECTED_NAMES else s for s in shares]
        return shares

    def _held(self, agent: Agent, now_s: float) -> Iterator[tuple[Received, Share]]:
        memory = agent.memory
        for peer, received in sorted(memory.held.items()):
            age_s = memory.payload_age_s(received, now_s)
            if instant(age_s) <= instant(self._limit_s):
                yield received, as_share(received, memory.trust_in(peer), age_s)

    def job(self, agent: Agent, here: Capture, shares: list[Share], now_s: float) -> Job | None:
        """The agent's capture and its recent shares, where `here` is its present pose.

        Where its own capture is too old it has its present pose alone, and fuses what its peers sent; None where that is
        nothing.
        """
        look = agent.latest
        delay_s = self._delays_s[here.drone] + agent.status.slowed_s + self._fusion_delay_s  # of any capture
        if look is None or instant(now_s - look.t_s) > instant(self._limit_s + delay_s):
            if not shares:
                return None
            look = here._replace(looked=False)
        return look, shares


class FindingEachFrame:
    """What every drone finds in each frame of its own look and the maps that it holds then.

    Boxes that came are left out, or a drone would send others' boxes on. The detector runs when somebody first asks.
    """

    def __init__(
        self,
        env: simpy.Environment,
        scenario: Scenario,
        detector: Detector | None,
        fusing: Fusing,
        scene: SceneModel,
    ) -> None:
        """Args: `scene`: drones find its cars in reach where no detector flies."""
        self._env, self._scenario, self._detector, self._fusing = env, scenario, detector, fusing
        self._scene = scene
        self._limit_s = scenario.perception.max_age_s
        self._jobs: list[Job] = []
        self._found: dict[int, tuple[Capture, Boxes | None]] | None = None  # of these jobs

    def start(self, agents: Sequence[Agent]) -> None:
        """Begin the process; call once."""
        self._env.process(self._run(agents))

    def _run(self, agents: Sequence[Agent]) -> Generator[simpy.Event, Any, None]:
        frame_s, delay_s = self._scenario.frame_s, self._scenario.perception.fusion_delay_s
        for frame in count():
            yield self._env.timeout(frame * frame_s + delay_s - self._env.now)
            self._jobs, self._found = [*self._each(agents, frame)], None

    def _each(self, agents: Sequence[Agent], frame: int) -> Iterator[Job]:
        now_s, fusing = self._env.now, self._fusing
        for agent in agents:
            if is_flying(agent, frame, self._scenario.frame_s) and (here := ready(agent)) is not None:
                job = fusing.job(agent, here, fusing.maps(agent, now_s), now_s)
                if job is not None and job[0].looked:
                    yield job

    def last(self, drone: int, roi: Disc | None) -> Found | None:
        """What the drone found last in a region.

        None before it first fused, where it had no look of its own then, and of a look that receivers would find too old.
        """
        if self._found is None:
            boxes: Sequence[Boxes | None] = [None] * len(self._jobs)
            if self._detector is not None:
                boxes = self._detector.detect(self._jobs)
            self._found = {look.drone: (look, each) for (look, _), each in zip(self._jobs, boxes, strict=True)}
        if drone not in self._found:
            return None
        look, each = self._found[drone]
        if instant(self._env.now - look.t_s) > instant(self._limit_s):
            return None
        if each is None:
            return Found(look, cars_in_reach(self._scene, look, roi), None)
        inside = each.inside(roi)
        return Found(look, len(inside), inside)
