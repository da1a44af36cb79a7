"""Models and a policy of one's own that tests of the engine fly."""

import sys

import numpy as np

from sortie.perception.types import Boxes
from sortie.policies.catalogue.baselines import everyone
from sortie.policies.contract import Reposition, looks_from
from sortie.radio.channel.pathloss import free_space_loss_db


def constant(air_velocity_mps, acceleration_mps2, climb_mps, mass_kg, *, power_w=300.0):
    return np.full_like(climb_mps, power_w)


def straight(soc, *, empty_v=3.0, full_v=4.2):
    return empty_v + (full_v - empty_v) * soc


def falling(soc):
    return 4.0 - 0.5 * soc


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


class Forgets(Omniscient):
    def detect(self, jobs):
        super().detect(jobs)


class Texts(Omniscient):
    def truth(self, t_s, ego):
        boxes = super().truth(t_s, ego)
        return Boxes(boxes.xy_m, boxes.size_m, boxes.yaw_rad, np.full(len(boxes), "sure"))


class Storm:
    """Weakens every link, jams, empties the battery of drone 1, and loses drone 2, as its parameters say."""

    def __init__(self, rng, *, loss_db=20.0, jams=False, drains=0.0, loses=-1, wrong=""):
        self.loss_db, self.jams, self.drains, self.loses, self.wrong = loss_db, jams, drains, loses, wrong
        self.steps = []

    def begin(self, fleet):
        fleet.note("a storm")
        if self.drains:
            fleet.drain(1, self.drains)
        if self.loses >= 0:
            fleet.lose(self.loses, "hit by lightning")
        if self.wrong == "loss":
            fleet.set_loss_db(-1.0)
        if self.wrong == "loss_nan":
            fleet.set_loss_db(np.where(np.eye(len(fleet.airborne), k=1), np.nan, 3.0))
        if self.wrong == "drone":
            fleet.lose(99)
        if self.wrong == "loss_of_each":
            fleet.set_loss_db(np.array([50.0, 0.0, 0.0, 0.0, 0.0]))
        if self.wrong == "loss_text":
            fleet.set_loss_db("30")
        if self.wrong == "place":
            fleet.jam((0.0, 0.0), 30.0)
        if self.wrong == "power":
            fleet.jam((0.0, 0.0, 0.0), "30")
        if self.wrong == "moves":
            fleet.positions_m[:] = 0.0
        if self.wrong == "lands":
            fleet.airborne[:] = False
        if self.wrong == "invents":
            fleet.loss_db = 30.0

    def step(self, fleet):
        self.steps.append(fleet.t_s)
        fleet.set_loss_db(self.loss_db)
        if self.jams:
            fleet.jam(fleet.positions_m.mean(axis=0), 20.0)

    def end(self, fleet):
        fleet.note(f"{len(self.steps)} frames from {self.steps[0]:g} s to {self.steps[-1]:g} s")


class Calm(Storm):
    def step(self, fleet):
        self.steps.append(fleet.t_s)


def sent(record, *, times=1.0):
    """How many payloads were sent."""
    return times * record.tables["transmissions"].num_rows


def nothing(record):
    return None


def huge(record):
    return 10**400


def words(record):
    return "many"


def endless(record):
    return float("inf")


def fails(record):
    return record.tables["no such table"]


def drifts(times_s, positions_m, rng, *, mps=5.0):
    error = np.zeros((len(times_s), 4))
    error[:, 1] = mps * times_s
    return error


def largest(agents, takes_part, weight, *, gain=1.0):
    peers = (takes_part * weight[:, :, None, None])[:, 1:, None] * (agents[:, 1:] - agents[:, :1]).relu()
    return agents[:, 0] + gain * peers.amax(1)


def spiral(times_s, starts_m, rng, *, speed_mps=4.0):
    """Everybody flies a spiral about its start."""
    angle = 0.5 * np.sqrt(times_s)
    way = np.stack([np.cos(angle) - 1.0, np.sin(angle), 0 * angle], axis=-1) * speed_mps * np.sqrt(times_s)[:, None]
    return starts_m + way[:, None]


class Goes:
    """Commands what its parameters say: once a time, in turn, the names in `do`."""

    def __init__(self, drone, start_m, rng, *, do="GoTo", x_m=30.0, y_m=0.0, z_m=60.0, only=-1, says=""):
        from sortie.fleet.flight import steering

        self.steering, self.do, self.place, self.drone = steering, do.split(), (x_m, y_m, z_m), drone
        self.only, self.says, self.views = only, says, []

    def command(self, view):
        self.views.append(view)
        if self.says:
            return self.says
        if self.only not in (-1, self.drone):
            return None
        name = self.do[min(len(self.views) // 8, len(self.do) - 1)]
        arguments = {"GoTo": self.place, "Velocity": self.place}.get(name, ())
        return getattr(self.steering, name)(*arguments)


def nearer(view):
    me, middle = view.me, view.descriptors.get(0)
    if me is None or middle is None or view.ego == 0:
        return None
    return Reposition(*((a + b) / 2 for a, b in zip(me.position_m[:2], middle.position_m[:2], strict=True)))


@looks_from(nearer)
def crossing(view):
    """Everybody asks to be half as far from drone 0."""
    return everyone(view, received_budget=0.02)
