"""The surrogate's parameters: small networks and tables, read from safetensors, evaluated in numpy. Free of torch.

Five parts, each fitted to what the torch detector did:

- **look**: a drone's own confidence in a car, the logit of its heat map there. A mixture of two normals.
- **rank**: the share of the drone's cells that rank above the car's cell. It decides whether a budget sends the cell.
- **find**: whether fusion gives a box, and its score.
- **place**: the localisation error of that box, along and across the car, in heading, length and width.
- **alarms**: the number of false positives, in bands of scores.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from scipy.special import expit, ndtri

from sortie.perception.errors import InputError
from sortie.perception.scene.town import Floats
from sortie.perception.surrogate.draws import BANDS
from sortie.perception.surrogate.exchange import ALARM_COVARIATES, FUSED_COVARIATES
from sortie.perception.surrogate.features import LOOK_COVARIATES, beside
from sortie.scenarios.replacing import replacing
from sortie.scenarios.shipped import CALIBRATION, SHIPPED_WEIGHTS, calibration_of

Singles = NDArray[np.float32]
FORMAT = 6
RANK_COVARIATES = ("confidence", "range", "visible", "nadir", "cars", "brightness", "shade")
PLACE_COVARIATES = (*FUSED_COVARIATES, "score")
ALARM_COLUMNS = ("ahead_m", "left_m", "length_m", "width_m", "yaw_rad", "score")
NETS: dict[str, tuple[int, int]] = {
    "look": (len(LOOK_COVARIATES), 5),
    "rank": (len(RANK_COVARIATES), 2),
    "find": (len(FUSED_COVARIATES), 6),
    "place": (len(PLACE_COVARIATES), 11),
    "alarms": (len(ALARM_COVARIATES), BANDS),
}
"""Inputs and outputs of each network."""
SHIPPED = calibration_of(SHIPPED_WEIGHTS)


SPREAD = (-3.5, 2.0)
"""Bounds of log deviations."""
RATES = (-12.0, 8.0)
"""Bounds of log rates of false alarms."""
BAND = 64
"""Residuals in a band, predicted with about equal uncertainty; a box draws one of these, the highest draw the best."""
SQUARE = 0.5
"""Squareness from which on a car, or a drone, counts as square."""
KINDS = 8
"""Of boxes, each with residuals of its own (`kind_of`)."""
FEW, WHOLE = 0.015, 0.99
"""Shares of the requested cells (of the map, or of a region): up to the first they are few, from the second on all."""
_ROWS = 192
"""At a time: few enough for the cache, and for the matrix library to start no threads."""
_STEP = 2.0**-20
"""Of activations and of weights alike."""
_SHARED_TENSOR = "mirages"
"""Name of `Parameters.shared_false_positives` in the file, as in the shipped calibration."""


@dataclass(frozen=True, slots=True)
class Net:
    """A network of one or more layers with rectifiers between them; `weight` [in, out] and `bias` [out] of each.

    Its sums are exact, so a row is the same to the bit whatever else is computed, and in whichever order the
    matrix library of a machine adds: activations and weights are multiples of 2⁻²⁰, and a double holds any sum of their
    products whose magnitudes add up to less than 2¹³.
    """

    weight: tuple[Singles, ...]
    bias: tuple[Singles, ...]
    _layers: tuple[tuple[Floats, Floats], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        layers = tuple(
            (np.rint(w.astype(float) / _STEP) * _STEP, np.rint(b.astype(float) / _STEP))
            for w, b in zip(self.weight, self.bias, strict=True)
        )
        object.__setattr__(self, "_layers", layers)

    def __call__(self, x: Singles) -> Singles:
        """[n, in] → [n, out]."""
        out = np.empty((len(x), self.bias[-1].shape[0]), np.float32)
        *hidden, (last, shift) = self._layers
        for at in range(0, len(x), _ROWS):
            h = np.multiply(x[at : at + _ROWS], 1.0 / _STEP, dtype=np.float64)
            np.rint(h, out=h)
            for w, b in hidden:
                h = h @ w
                h += b
                np.maximum(h, 0.0, out=h)
                np.rint(h, out=h)
            h = h @ last
            h += shift
            h *= _STEP
            out[at : at + _ROWS] = h
        return out


@dataclass(frozen=True, slots=True)
class Parameters:
    """Everything that a calibration leaves behind."""

    nets: Mapping[str, Net]
    alike: Singles
    """[4] shares of the cars that have one draw of their own, whoever looks and whenever: for the look, for being found, and for
    where the box lies. The last is the share of the cars that all drones put off to the same side."""
    residuals: Singles
    """[8, r, 6] localisation errors in units of the predicted deviations, in bands of `BAND` rows, worst first in each. The last
    column is the uncertainty (`vague`) from which on a band is used. Pools are those of `kind_of`."""
    alarm_edges: Singles
    """[b + 1] scores between which false positives are counted."""
    alarm_range: Singles
    """[2, covariates] the least and the most that the network of false positives was fitted to."""
    alarm_pool: Singles
    """[2, b, p, 6] false positives to draw from (`ALARM_COLUMNS`, ego's frame): of drones turned anyhow, and of square ones."""
    shared_false_positives: Singles
    """[4] the share of false positives that other drones may have as well, the chance that a drone has one, and the standard
    deviations of where it puts them (m, rad)."""
    boxes: Singles
    """[3, s] score thresholds; for a drone alone, the share of the cars with a box above each, and its number of false positives."""
    card: Mapping[str, Any]

    @property
    def floor(self) -> float:
        """The lowest score that the surrogate gives; AP hardly knows weaker boxes."""
        return float(self.alarm_edges[0])

    @property
    def id(self) -> str:
        """Names the calibration in outcomes."""
        return str(self.card["id"])

    # --- the five parts ---------------------------------------------------------------------------

    def confidence(self, covariates: Singles, draw: Singles) -> Singles:
        """Each drone's own confidence in each car, a logit [n].

        `draw` [n] uniform: the lowest draws fall to the lower of the two normals, and within each to its lower end.
        """
        return _of_two(self.nets["look"](covariates), draw)

    def rank(self, covariates: Singles, draw: Singles) -> Singles:
        """The fraction [n] of the drone's cells that rank above the car's cell; `draw` [n] standard normal."""
        out = self.nets["rank"](covariates)
        return np.asarray(np.minimum(np.exp(out[:, 0] + _spread(out[:, 1]) * draw), 1.0), np.float32)

    def find(self, covariates: Singles, draw: Singles) -> Singles:
        """Scores [n], 0 where there is no box; `draw` [n, 2] uniform: whether there is one, and how high its score."""
        out = self.nets["find"](covariates)
        score = expit(_of_two(out[:, 1:], draw[:, 1]))
        return np.where((draw[:, 0] < expit(out[:, 0])) & (score >= self.floor), score, 0.0).astype(np.float32)

    def place(self, covariates: Singles, draw: Singles, offset_draw: Singles) -> tuple[Singles, Singles]:
        """Localisation errors [n, 5], and the share [n] of the peers' mean shift that a box follows.

        Errors are along the car and across it (m), heading (rad), log length and log width (`features.axes`).

        Args:
            draw: [n] uniform, picks one of the residuals that were predicted as uncertainly.
            offset_draw: [n, 4] as `Drawn.offset_draw`, with sides as seen from here.
        """
        out = self.nets["place"](covariates)
        which, unsure = kind_of(covariates), vague(out)
        drawn = np.empty((len(out), 5), np.float32)
        for k, pool in enumerate(self.residuals):
            kind = which == k
            band = np.maximum(np.searchsorted(pool[::BAND, 5], unsure[kind], side="right") - 1, 0)
            drawn[kind] = pool[band * BAND + np.minimum((draw[kind] * BAND).astype(np.intp), BAND - 1), :5]
        common = offset_draw[:, 0] < self.alike[3]
        drawn[common, :3] = np.abs(drawn[common, :3]) * offset_draw[common, 1:]
        return np.asarray(out[:, :5] + _spread(out[:, 5:10]) * drawn, np.float32), expit(out[:, 10])

    def alarm_rates(self, covariates: Singles) -> Singles:
        """Expected alarms of each job in each band of scores, [m, b]."""
        x = np.clip(covariates, *self.alarm_range)  # the network knows nothing of what lies beyond
        late, moving, gone = (ALARM_COVARIATES.index(name) for name in ("late", "moving", "gone"))
        x[:, gone] = x[:, late] * x[:, moving]
        return np.asarray(np.exp(np.clip(self.nets["alarms"](x), *RATES)))


def _of_two(out: Singles, draw: Singles) -> Singles:
    """Draws [n] from mixtures of two normals, `out` [n, 5]: the upper one's logit, means and log deviations of the upper and of
    the lower one. `draw` [n] uniform: the worst falls to the lower normal, and within each to its lower end."""
    u, low = draw.astype(np.float64), expit(-out[:, 0].astype(np.float64))
    high = u >= low
    with np.errstate(divide="ignore", invalid="ignore"):  # of the side that is not chosen
        share = np.where(high, (u - low) / (1.0 - low), u / low)
    within = ndtri(np.clip(share, 1e-6, 1.0 - 1e-6))
    mean = np.where(high, out[:, 1], out[:, 2])
    spread = _spread(np.where(high, out[:, 3], out[:, 4]))
    return np.asarray(mean + spread * within, np.float32)


def _spread(log: Singles) -> Singles:
    return np.asarray(np.exp(np.clip(log, *SPREAD)))


def kind_of(fused: NDArray[Any]) -> NDArray[np.intp]:
    """Which of the pools of residuals is a box's [n]: 0 and 1 alone, 2 and 3 with a few cells of others' maps, 4 and 5 with more, 6
    and 7 with all that were requested, which have no seams; the odd ones of cars that stand square on the map, which a network of cells puts
    elsewhere."""
    shared, part, square = (fused[:, FUSED_COVARIATES.index(name)] for name in ("senders", "part", "own_square"))
    kind = (shared > 0) * (1 + (part > FEW) + (part > WHOLE))
    return np.asarray(2 * kind + (square > SQUARE), np.intp)


def vague(place: NDArray[Any]) -> NDArray[Any]:
    """How unsure the place network's outputs [n, 11] are of where a box lies: the log deviations along and across."""
    return np.asarray(np.clip(place[:, 5:7], *SPREAD).sum(axis=1))


def rank_covariates(look: Singles, confidence: Singles, cars: NDArray[Any]) -> Singles:
    """[l, 7] as `RANK_COVARIATES`; `cars` [l] how many the capture's square holds."""
    named = {
        name: look[:, LOOK_COVARIATES.index(name)] for name in ("range", "visible", "nadir", "brightness", "shade")
    }
    named |= {"confidence": confidence, "cars": np.log1p(cars) - 3.6}
    return beside(len(look), [named[name] for name in RANK_COVARIATES])


def save(path: Path, parameters: Parameters) -> None:
    """Write them as safetensors with the card in the metadata, under a temporary name first."""
    names = ("alike", "residuals", "alarm_edges", "alarm_range", "alarm_pool", "boxes")
    tensors: dict[str, Singles] = {name: getattr(parameters, name) for name in names}
    tensors[_SHARED_TENSOR] = parameters.shared_false_positives
    for name, net in parameters.nets.items():
        for k, (w, b) in enumerate(zip(net.weight, net.bias, strict=True)):
            tensors[f"{name}.{k}.weight"], tensors[f"{name}.{k}.bias"] = w, b
    tensors = {k: np.ascontiguousarray(v, np.float32) for k, v in tensors.items()}
    with replacing(path) as part:
        save_file(tensors, part, metadata={"surrogate": json.dumps({"format": FORMAT, **parameters.card})})
        part.chmod(0o644)  # the library makes it private


def load(path: Path) -> Parameters:
    """Parameters from a file.

    Raises:
        InputError: naming the file, and what is missing, of another shape, or not finite.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such calibration; `python -m research calibrate` makes one")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except SafetensorError as error:
        raise InputError(f"{path}: no safetensors file: {error}") from error
    if "surrogate" not in metadata:
        raise InputError(
            f"{path}: holds no calibration, and {path.stem}{CALIBRATION} is not beside it; `python -m research calibrate` makes one"
        )
    try:
        card = json.loads(metadata["surrogate"])
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: its card is no JSON: {error}") from error
    if card.get("format") != FORMAT:
        raise InputError(f"{path}: format is {card.get('format')}, must be {FORMAT}; calibrate again")
    for name in ("id", "fusion"):
        if not isinstance(card.get(name), str):
            raise InputError(f"{path}: card.{name} is {card.get(name)!r}, must be text")
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise InputError(f"{path}: tensor {name} holds values that are not finite")

    def take(name: str, *shape: int | None) -> Singles:
        if name not in tensors:
            raise InputError(f"{path}: tensor {name} is missing")
        found = tensors[name]
        if found.ndim != len(shape) or any(
            want not in (None, have) for want, have in zip(shape, found.shape, strict=True)
        ):
            wanted = ", ".join("any" if v is None else str(v) for v in shape)
            raise InputError(f"{path}: tensor {name} has shape {list(found.shape)}, must be [{wanted}]")
        return np.asarray(found, np.float32)

    return Parameters(
        {
            name: _net(take, name, *sizes, layers=sum(t.startswith(f"{name}.") for t in tensors) // 2)
            for name, sizes in NETS.items()
        },
        take("alike", 4),
        take("residuals", KINDS, None, 6),
        take("alarm_edges", BANDS + 1),
        take("alarm_range", 2, len(ALARM_COVARIATES)),
        take("alarm_pool", 2, BANDS, None, len(ALARM_COLUMNS)),
        take(_SHARED_TENSOR, 4),
        take("boxes", 3, None),
        card,
    )


def _net(take: Any, name: str, inputs: int, outputs: int, layers: int) -> Net:
    weight, bias = [], []
    width = inputs
    for k in range(max(layers, 1)):
        w = take(f"{name}.{k}.weight", width, outputs if k == layers - 1 else None)
        weight.append(w)
        width = w.shape[1]
        bias.append(take(f"{name}.{k}.bias", width))
    return Net(tuple(weight), tuple(bias))
