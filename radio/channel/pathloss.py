"""Path loss between two positions: free space, log-distance, and two rays over the ground."""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.radio import own_links
from sortie.radio.settings import AirSettings

FloatArray = NDArray[np.float64]

LIGHT_MPS = 299_792_458.0
GROUND_PERMITTIVITY = 15.0
"""Relative permittivity of medium dry ground near 5 GHz, losses left out (ITU-R P.527)."""


def free_space_loss_db(distance_m: ArrayLike, carrier_ghz: float) -> FloatArray:
    """Friis: 20 log10(4π d f / c), dB."""
    return np.asarray(20.0 * np.log10(4.0 * pi * np.asarray(distance_m, dtype=float) * carrier_ghz * 1e9 / LIGHT_MPS))


def log_distance_loss_db(distance_m: ArrayLike, carrier_ghz: float, exponent: float) -> FloatArray:
    """Free space at 1 m, then 10 · exponent · log10(d), dB; nearer than 1 m counts as 1 m."""
    loss_db = np.asarray(np.log10(np.maximum(distance_m, 1.0)))
    loss_db *= 10.0 * exponent  # in place: a large fleet's are many
    loss_db += float(free_space_loss_db(1.0, carrier_ghz))
    return loss_db


def two_ray_loss_db(
    distance_m: ArrayLike,
    height_a_m: ArrayLike,
    height_b_m: ArrayLike,
    carrier_ghz: float,
    roughness_m: float = 0.0,
    permittivity: float = GROUND_PERMITTIVITY,
) -> FloatArray:
    """The direct ray and the one that flat ground reflects, added with their phases, dB.

    The reflected ray is weakened by the Fresnel coefficient of vertical polarisation and by Ament's factor
    exp(−2 (k s sin ψ)²) of ground whose height has the standard deviation s: seen steeply, rough ground scatters,
    and free space is left; at grazing angles it is a mirror of coefficient −1, and beyond the break point
    4 h_a h_b / λ the loss grows by 40 dB a decade. (Rappaport, Wireless Communications, §4.6; W. S. Ament,
    Proc. IRE 41, 1953.)

    Args:
        distance_m: along the direct ray; nearer than 1 m counts as 1 m.
        height_a_m, height_b_m: over the ground; below it counts as on it.
        carrier_ghz: carrier frequency.
        roughness_m: standard deviation s of the ground's height.
        permittivity: relative, of the ground.
    """
    d = np.maximum(np.asarray(distance_m, dtype=float), 1.0)
    a, b = (np.maximum(np.asarray(h, dtype=float), 0.0) for h in (height_a_m, height_b_m))
    k = 2.0 * pi * carrier_ghz * 1e9 / LIGHT_MPS
    reflected = np.sqrt(d**2 + 4.0 * a * b)
    sine = np.minimum((a + b) / reflected, 1.0)
    refracted = np.sqrt(permittivity - 1.0 + sine**2)
    mirror = (permittivity * sine - refracted) / (permittivity * sine + refracted)
    mirror = mirror * np.exp(-2.0 * (k * roughness_m * sine) ** 2)
    # the difference of the two ways, written so that it keeps its digits at grazing angles
    longer = 4.0 * a * b / (reflected + d)
    power = (1.0 / d + mirror * np.cos(k * longer) / reflected) ** 2 + (mirror * np.sin(k * longer) / reflected) ** 2
    return np.asarray(float(free_space_loss_db(1.0, carrier_ghz)) - 10.0 * np.log10(np.maximum(power, 1e-30)))


def path_loss_db(
    settings: AirSettings, distance_m: ArrayLike, height_a_m: ArrayLike, height_b_m: ArrayLike
) -> FloatArray:
    """Path loss by the model of the settings, dB; arguments as for `two_ray_loss_db`."""
    if not isinstance(settings.path_loss, str):
        free_db = free_space_loss_db(np.maximum(distance_m, 1.0), settings.carrier_ghz)
        ends = distance_m, height_a_m, height_b_m
        return own_links.path_loss(settings.path_loss, *ends, settings.carrier_ghz, free_db)
    if settings.path_loss == "two_ray":
        return two_ray_loss_db(distance_m, height_a_m, height_b_m, settings.carrier_ghz, settings.ground_roughness_m)
    exponents = {"free_space": 2.0, "log_distance": settings.path_loss_exponent}
    return log_distance_loss_db(distance_m, settings.carrier_ghz, exponents[settings.path_loss])


def range_m(settings: AirSettings, loss_db: float) -> float:
    """The distance beyond which the loss exceeds `loss_db` for certain."""
    exponent = settings.path_loss_exponent if settings.path_loss == "log_distance" else 2.0
    gain_db = 0.0 if settings.path_loss in ("log_distance", "free_space") else own_links.GAIN_DB
    beyond_1m_db = loss_db + gain_db - float(free_space_loss_db(1.0, settings.carrier_ghz))
    return float(10.0 ** (max(0.0, beyond_1m_db) / (10.0 * exponent)))
