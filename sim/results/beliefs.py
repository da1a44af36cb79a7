"""The poses that drones believed to have, frame by frame. Only where `record.beliefs` is on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyarrow as pa

Array = npt.NDArray[np.float64]

TABLE = "beliefs"
COLUMNS: dict[str, pa.DataType] = dict(
    t_s=pa.float64(), drone=pa.int32(), x_m=pa.float64(), y_m=pa.float64(), z_m=pa.float64(), yaw_rad=pa.float64()
)
ABOUT = (
    "The pose that a drone believes to have, ENU, in a frame; the rows are those of `states`, in the same order. Heading is "
    "counter-clockwise from east."
)


def table(times_s: Array, position_m: Array, yaw_rad: Array) -> pa.Table:
    """All rows, from times [T], positions [T, N, 3] and headings [T, N]."""
    n = yaw_rad.shape[1]
    columns = (
        np.repeat(times_s, n),
        np.tile(np.arange(n), len(times_s)),
        *position_m.reshape(-1, 3).T,
        yaw_rad.ravel(),
    )
    return pa.table({name: pa.array(c, kind) for (name, kind), c in zip(COLUMNS.items(), columns, strict=True)})
