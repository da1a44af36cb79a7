"""Models that `test_sim_own_models.py` and `test_sim_knobs.py` fly."""

import sys

import numpy as np

from sortie.perception.types import Boxes
from sortie.radio.channel.pathloss import free_space_loss_db


def constant(air_velocity_mps, acceleration_mps2, climb_mps, mass_kg, *, power_w=300.0):
    return np.full_like(climb_mps, power_w)


def negative(air_velocity_mps, acceleration_mps2, climb_mps, mass_kg):
    return np.full_like(climb_mps, -1.0)


def scalar(air_velocity_mps, acceleration_mps2, climb_mps, mass_kg):
    return 200.0


def wall(distance_m, height_a_m, height_b_m, carrier_ghz, *, wall_db=25.0):
    return free_space_loss_db(np.maximum(distance_m, 1.0), carrier_ghz) + wall_db


class Noisy:
    def __init__(self, drones, frame_s, rng, *, sigma_db=10.0):
        self._rng, self._sigma_db = rng, sigma_db

    def snr_db(self, t_s, positions_m, snr_db):
        return snr_db + self._rng.normal(scale=self._sigma_db, size=snr_db.shape)


class Raises(Noisy):
    def snr_db(self, t_s, positions_m, snr_db):
        return 1 / 0


class Exits(Noisy):
    def snr_db(self, t_s, positions_m, snr_db):
        sys.exit(0)


class Hangs(Noisy):
    def snr_db(self, t_s, positions_m, snr_db):
        while True:
            pass


class Half:
    def __init__(self, scene, perception, seed, replication, *, finds=True):
        self._scene, self._finds = scene, finds

    def detect(self, jobs):
        return [self.truth(ego.t_s, ego) if self._finds else Boxes.join([]) for ego, _ in jobs]

    def count_boxes(self, capture, roi):
        return len(self.truth(capture.t_s, capture).inside(roi))

    def camera_views(self, capture):
        raise ValueError("no cameras")


class Omniscient(Half):
    """Finds the cars of the moment of scoring where it looks; a car that moves is off by what it went since."""

    def truth(self, t_s, ego):
        cars = self._scene.cars_at(0.0)
        x_m, y_m, _ = ego.position_m
        near = cars.where((abs(cars.x_m - x_m) <= 102.4) & (abs(cars.y_m - y_m) <= 102.4))
        columns = (
            np.column_stack([near.x_m, near.y_m]),
            np.column_stack([near.length_m, near.width_m]),
            near.yaw_rad,
            np.ones(len(near)),
        )
        return Boxes(*(column.astype(np.float32) for column in columns))


class Short(Omniscient):
    def detect(self, jobs):
        return []
