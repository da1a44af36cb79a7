"""People who walk through a scene. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sortie.perception.classes import PERSON_SIZE_M
from sortie.perception.scene.traffic import Cars, TargetPath
from sortie.scenarios.schema import Person

_CLOTHES = (64, 66, 92)


class Walkers:
    """The people of a scene as a function of time."""

    def __init__(self, people: Sequence[Person]) -> None:
        self._paths = [(TargetPath.of(person), person.begin_s) for person in people]

    def __len__(self) -> int:
        return len(self._paths)

    def at(self, t_s: float) -> NDArray[np.float64]:
        """[n, 2] where each of them is at `t_s`, ENU."""
        return self.poses(t_s)[:, :2]

    def poses(self, t_s: float) -> NDArray[np.float64]:
        """[n, 3] the same with the way they face."""
        return np.array([path.pose(t_s - begin_s) for path, begin_s in self._paths]).reshape(-1, 3)

    def bodies(self, t_s: float) -> Cars:
        """What cameras see of them: small boxes, as of cars; ids are −1."""
        n, (x, y, yaw) = len(self), self.poses(t_s).T
        length, width, height = np.tile(PERSON_SIZE_M, (n, 1)).T
        return Cars(np.full(n, -1), x, y, yaw, length, width, height, np.tile(np.array(_CLOTHES, np.uint8), (n, 1)))
