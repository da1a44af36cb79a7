"""Link models from outside: a path loss, and a model that changes the SNR of every link.

Both are the user's own code. What they return is checked at each call, so that an error names the model and the value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.scenarios.plugins.reference import Guard, PluginError, checked_array, checked_call, name_of

FloatArray = NDArray[np.float64]
GAIN_DB = 6.1
"""A path loss may be this much below that of free space: two rays that add up reach 6 dB."""


class OwnPathLoss(Protocol):
    """A path loss of one's own, `radio.path_loss`. Keyword-only arguments are its parameters.

    Example, free space and a wall:

    >>> def wall(distance_m, height_a_m, height_b_m, carrier_ghz, *, wall_db=10.0):
    ...     return 20 * np.log10(41.9 * np.maximum(distance_m, 1.0) * carrier_ghz) + wall_db
    """

    def __call__(
        self, distance_m: FloatArray, height_a_m: FloatArray, height_b_m: FloatArray, carrier_ghz: float
    ) -> ArrayLike:
        """Loss between two ends, dB, of the shape of `distance_m`; at least that of free space, less 6.1 dB."""


class LinkModel(Protocol):
    """A model of one's own that changes the SNR of every link, `radio.link`.

    It is made once a sortie, with the number of drones, the time between two frames in seconds and a numpy random
    generator. All its random numbers come from that generator. Keyword-only arguments are its parameters.
    """

    def snr_db(self, t_s: float, positions_m: FloatArray, snr_db: FloatArray) -> ArrayLike:
        """The SNR of every link in this frame.

        Args:
            t_s: when the frame begins. Frames come in order.
            positions_m: [N, 3], ENU.
            snr_db: [N, N], sender by receiver, from path loss, antennas, shadowing and noise; NaN on the diagonal.
                Fading, `events` and jammers act on what is returned.

        Returns:
            [N, N]; the diagonal does not count.
        """


def own_link(make: Callable[..., LinkModel], drones: int, frame_s: float, rng: np.random.Generator) -> LinkModel:
    """A link model, made and guarded."""
    model: Any = Guard("link", checked_call("link", make, drones, frame_s, rng), ("snr_db",))
    return cast("LinkModel", model)


def path_loss(
    model: OwnPathLoss,
    distance_m: ArrayLike,
    height_a_m: ArrayLike,
    height_b_m: ArrayLike,
    carrier_ghz: float,
    free_space_db: FloatArray,
) -> FloatArray:
    """What a path loss of one's own returns, checked.

    Raises:
        PluginError: it fails, or returns another shape, a number that is not finite or a loss below that of free space.
    """
    ends = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in (distance_m, height_a_m, height_b_m)))
    loss_db = checked_array("path_loss", model, ends[0].shape, *ends, carrier_ghz)
    above_db = loss_db - (free_space_db - GAIN_DB)
    if above_db.size and above_db.min() < 0.0:
        k = int(above_db.argmin())
        raise PluginError(
            f"path_loss {name_of(model)}: {loss_db.flat[k]:.1f} dB at {ends[0].flat[k]:g} m, must be at least "
            f"{free_space_db.flat[k] - GAIN_DB:.1f} dB, that of free space less {GAIN_DB} dB"
        )
    return loss_db


def changed_snr(model: LinkModel, t_s: float, positions_m: FloatArray, snr_db: FloatArray) -> FloatArray:
    """What a link model makes of the SNR, checked; the diagonal is NaN.

    Raises:
        PluginError: it fails, or returns another shape or a number that is not finite.
    """
    diagonal = np.eye(len(snr_db), dtype=bool)
    given = checked_array("link", model.snr_db, snr_db.shape, t_s, positions_m, snr_db, left_out=diagonal)
    return np.where(diagonal, np.nan, given)
