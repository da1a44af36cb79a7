"""What a drone sends as tracks: 20 B each, positions relative to the sender's own. Free of torch.

| bytes | field | unit, step |
|---|---|---|
| 4 | position, x and y | 1 cm, up to 327.67 m from the estimated position in the payload's header |
| 4 | velocity, x and y | 1 cm/s |
| 2 | identity | the sender's number of the track, modulo 65536 |
| 2 | heading | 1/65536 of a turn |
| 2 | length, width | 5 cm, up to 12.75 m |
| 1 | score | 1/255 |
| 2 | standard deviations of position and of velocity | 2 cm and 5 cm/s, up to 5.1 m and 12.75 m/s |
| 1 | their correlation | 1/127 |
| 1 | time since the last box | 20 ms, up to 5.1 s |
| 1 | class | 0: car, 1: truck, 2: person |
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sortie.perception import budget
from sortie.perception.classes import TargetClass
from sortie.perception.motion import Floats, Tracks, predicted
from sortie.scenarios.disc import Disc

TRACK = np.dtype(
    [
        ("xy", "<i2", 2),
        ("velocity", "<i2", 2),
        ("id", "<u2"),
        ("yaw", "<u2"),
        ("size", "u1", 2),
        ("score", "u1"),
        ("deviation", "u1", 2),
        ("correlation", "i1"),
        ("unseen", "u1"),
        ("kind", "u1"),
    ]
)
_TURN = 2.0 * np.pi / 65536
_DEVIATION = np.array([0.02, 0.05])


def content(tracks: Tracks, roi: Disc | None, origin_m: Sequence[float], t_s: float) -> Tracks:
    """What a receiver reads of one drone's tracks: the confirmed ones in the region, at most 12, best first, as rounded.

    Args:
        tracks: all tracks of the sender.
        roi: the region of interest; None is everywhere.
        origin_m: the sender's estimated position, x and y.
        t_s: the time of the payload's capture, at which the tracks are given.
    """
    own = predicted(tracks.take(tracks.confirmed), t_s)
    if roi is not None:
        off = own.xy_m - (roi[0], roi[1])
        own = own.take(off[:, 0] * off[:, 0] + off[:, 1] * off[:, 1] <= roi[2] * roi[2])
    own = own.take(np.argsort(-own.score, kind="stable")[: budget.MAX_TRACKS])
    owner = int(own.owner[0]) if len(own) else 0
    return unpacked(packed(own, origin_m), owner, origin_m, t_s)


def packed(tracks: Tracks, origin_m: Sequence[float]) -> bytes:
    """The bytes of tracks of one time: `budget.TRACK_BYTES` each."""
    out = np.zeros(len(tracks), TRACK)
    deviation = np.sqrt(tracks.covariance[:, [0, 2]])
    out["xy"] = _rounded(tracks.xy_m - (origin_m[0], origin_m[1]), 0.01, "<i2")
    out["velocity"] = _rounded(tracks.velocity_mps, 0.01, "<i2")
    out["id"] = tracks.id % 65536
    out["yaw"] = np.rint(tracks.yaw_rad / _TURN).astype(np.int64) % 65536
    out["size"] = _rounded(tracks.size_m, 0.05, "u1")
    out["score"] = _rounded(tracks.score, 1.0 / 255.0, "u1")
    out["deviation"] = np.maximum(_rounded(deviation, _DEVIATION, "u1"), 1)
    out["correlation"] = _rounded(tracks.covariance[:, 1] / (deviation[:, 0] * deviation[:, 1]), 1.0 / 127.0, "i1")
    out["kind"] = tracks.kind
    out["unseen"] = _rounded(tracks.t_s - tracks.seen_s, 0.02, "u1")
    return out.tobytes()


def unpacked(datagram: bytes, owner: int, origin_m: Sequence[float], t_s: float) -> Tracks:
    """The tracks in `packed` bytes; all are confirmed, and how many boxes they had is not sent: 0.

    Raises:
        ValueError: the bytes are not a whole number of tracks, or a class is unknown.
    """
    if len(datagram) % TRACK.itemsize:
        raise ValueError(f"tracks are {len(datagram)} B, must be a multiple of {TRACK.itemsize} B")
    read = np.frombuffer(datagram, TRACK)
    n = len(read)
    if n and (unknown := int(read["kind"].max())) >= len(TargetClass):
        raise ValueError(f"a track's class is {unknown}, must be at most {len(TargetClass) - 1}")
    deviation: Floats = read["deviation"] * _DEVIATION
    joint = read["correlation"] / 127.0 * deviation[:, 0] * deviation[:, 1]
    zero: NDArray[np.int64] = np.zeros(n, np.int64)
    return Tracks(
        np.full(n, owner, np.int64),
        read["id"].astype(np.int64),
        np.full(n, t_s),
        read["xy"] * 0.01 + (origin_m[0], origin_m[1]),
        read["velocity"] * 0.01,
        np.stack([deviation[:, 0] ** 2, joint, deviation[:, 1] ** 2], axis=1),
        read["size"] * 0.05,
        read["yaw"] * _TURN,
        read["score"] / 255.0,
        zero,
        zero,
        t_s - read["unseen"] * 0.02,
        np.ones(n, bool),
        read["kind"].astype(np.int8),
    )


def _rounded(values: Floats, unit: float | Floats, kind: str) -> NDArray[np.int64]:
    """In units, to the nearest that the type holds."""
    bounds = np.iinfo(kind)
    return np.asarray(np.clip(np.rint(values / unit), bounds.min, bounds.max).astype(np.int64))
