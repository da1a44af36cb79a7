"""The gate: the only place that sees both a directive and a payload.

It turns a directive into a payload of an exact size, at the directive's rate. `sortie.perception.budget` works out the
size of the content. Each payload adds a header with capture stamp and pose, and the directive that it obeys.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from sortie.fleet import tiles
from sortie.fleet.messages.wire import directive_bytes
from sortie.perception import budget
from sortie.perception.motion import Tracks
from sortie.perception.types import Boxes, Found
from sortie.policies.contract import Directive, Disc, Representation
from sortie.scenarios.representation import BOXES, NAME_OF

HEADER_BYTES = 40
"""Capture stamp (8), sender and its feature space (4), estimated position (12) and attitude (16)."""

_EPSILON_S = 1e-6
# members of an enumeration are slow to look up
_NONE, _FEATURES, _RAW = Representation.NONE, Representation.FEATURES, Representation.RAW
_TRACKS, _CODES = Representation.TRACKS, Representation.CODES
_RELIABLE = {rung: rung in BOXES for rung in Representation}

CountBoxes = Callable[[Disc | None], int]
"""Counts the boxes that the drone's own detector reports in a region; None is everywhere."""
TracksIn = Callable[[Disc | None], Tracks | None]
"""What the drone's own tracker sends of a region; None where it has no tracker."""
FoundLast = Callable[[Disc | None], Found | None]
"""What the drone found in a region when it last fused; None where it did not, or too long ago."""
PeopleIn = Callable[[Disc | None], Boxes]
"""The people that the drone's thermal camera found in a region."""


class Payload(NamedTuple):
    """What one link sends in one frame: a description of the content and its exact size."""

    representation: Representation
    rho: float
    roi: Disc | None
    fusion_weight: float
    cells: int
    boxes: int
    index_bytes: int
    size_bytes: int
    tile_cells: int = 0
    """Cells of a tile, 0 where the payload is one sample."""
    tile_bytes: int | None = None
    """Bytes of a tile, None where the payload is one sample."""
    tracks: Tracks | None = None
    """The tracks that it carries, as they are read from its bytes; None where it carries none, or no tracker runs."""
    feature_space: str = ""
    """Of its feature cells: the network that made them."""
    people: Boxes | None = None
    """The people among its detections; None where the drone has no thermal camera, and for other payloads. People among
    its tracks are in `tracks`."""
    codebook: str = ""
    """Of its codes: digest of the codebook, empty for the fleet's common one."""
    code_bytes: int = 0
    """Of a cell of codes; 0 for other payloads."""
    found: Found | None = None
    """What comes with a map: what its sender found when it last fused. Its boxes count in `boxes`."""

    @property
    def reliable(self) -> bool:
        """Whether it is sent reliably: compact payloads are, others are sent best effort (the paper's QoS mapping)."""
        return _RELIABLE[self.representation]


def make_payload(
    directive: Directive,
    est_x_m: float,
    est_y_m: float,
    est_yaw_rad: float,
    count_boxes: CountBoxes,
    tile_limit_bytes: int | None = None,
    tracks_in: TracksIn | None = None,
    people_in: PeopleIn | None = None,
    found_last: FoundLast | None = None,
    *,
    classes: bool = False,
    code_bytes: int = budget.CODE_BYTES,
    bring_look: bool = False,
) -> Payload | None:
    """The payload that a directive allows for a capture at this estimated pose; None where nothing is to be sent.

    Args:
        tile_limit_bytes: features are sent as tiles of at most this size (sortie.fleet.tiles); None: as one sample. Codes
            always are one sample.
        tracks_in: gives the tracks of a region that the drone sends; without a tracker, boxes are counted in their place.
        people_in: gives the people of a region; None without a thermal camera.
        found_last: gives what goes with a map that is one sample, or with codes: a header of its own, and boxes; None sends
            maps alone.
        classes: whether each detection names its class.
        code_bytes: of a cell that is sent as a code.
        bring_look: whether the boxes of this capture go with a map that is one sample, or with codes.
    """
    rung, rho, roi, weight = directive.representation, directive.rho, directive.roi, directive.fusion_weight
    cells = boxes = index_bytes = 0
    tracks = people = None
    found: Found | None = None
    if rung == _NONE:
        return None
    if rung in (_FEATURES, _CODES):
        cells = budget.cells_sent(rho, roi, est_x_m, est_y_m, est_yaw_rad)
        if cells == 0:
            return None
        if tile_limit_bytes is not None and rung == _FEATURES:
            t = tiles.cut(cells, tile_limit_bytes)
            return Payload(rung, rho, roi, weight, cells, 0, t.index_bytes, t.size_bytes, t.cells_each, t.tile_bytes)
        index_bytes = budget.index_bytes(cells)
        boxes = count_boxes(roi) if bring_look else 0
        found = None if found_last is None else found_last(roi)
    elif rung == _TRACKS and tracks_in is not None and (tracks := tracks_in(roi)) is not None:
        boxes = len(tracks)
    elif rung != _RAW:
        people = None if people_in is None else people_in(roi)
        boxes = budget.boxes_sent(NAME_OF[rung], count_boxes(roi) + (0 if people is None else len(people)))
    # the directive goes with the payload, so that the receiver has representation, region and fusion weight
    size_bytes = (
        HEADER_BYTES
        + directive_bytes(directive)
        + budget.content_bytes(NAME_OF[rung], cells=cells, boxes=boxes, classes=classes, code_bytes=code_bytes)
    )
    if cells:
        size_bytes += budget.content_bytes("detections", boxes=boxes, classes=classes)
    if found is not None:
        boxes += found.number
        size_bytes += HEADER_BYTES + budget.content_bytes("detections", boxes=found.number, classes=classes)
    return Payload(
        rung,
        rho,
        roi,
        weight,
        cells,
        boxes,
        index_bytes,
        size_bytes,
        tracks=tracks,
        people=people,
        code_bytes=code_bytes if rung == _CODES else 0,
        found=found,
    )


class Gate:
    """One drone's gate: the directive in force on each link, and when the link last sent."""

    def __init__(self) -> None:
        self._directives: dict[int, Directive] = {}
        self._sending: dict[int, Directive] = {}  # those that send anything, by ascending peer
        self._last_slot_s: dict[int, float] = {}
        self.duty_percent = 100
        """The highest duty cycle of the links' directives, 100 where there is no link."""

    def enforce(self, directive: Directive) -> None:
        """Put a directive in force. Repeating one changes nothing: timers run from the last send, not from here."""
        peer, sending = directive.destination, self._sending
        before = self._directives.get(peer)
        self._directives[peer] = directive
        duty = directive.duty_percent
        if before is None and len(self._directives) > 1:  # one more
            self.duty_percent = max(self.duty_percent, duty)
        elif before is None or before.duty_percent != duty:
            self.duty_percent = max([d.duty_percent for d in self._directives.values()])
        if directive.representation == _NONE or directive.rate_hz <= 0:
            sending.pop(peer, None)
        elif peer in sending:
            sending[peer] = directive
        else:
            self._sending = dict(sorted([*sending.items(), (peer, directive)]))

    def in_force(self, peer: int) -> Directive | None:
        """The directive of a link, None before the first."""
        return self._directives.get(peer)

    def due(self, now_s: float) -> list[Directive]:
        """Directives of the links that may send now, by ascending peer; marks them as sent."""
        ready = []
        for peer, directive in self._sending.items():
            period_s = 1.0 / directive.rate_hz
            slot_s = self._last_slot_s.get(peer, -1e9) + period_s
            if now_s < slot_s - _EPSILON_S:
                continue
            # Slots advance by the period, so that 3 Hz on a 10 Hz clock is 3 Hz in the mean; a late slot starts anew.
            self._last_slot_s[peer] = slot_s if now_s - slot_s < period_s else now_s
            ready.append(directive)
        return ready
