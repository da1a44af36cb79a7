"""The messages of the context plane that a record holds: descriptors and directives, with their times."""

from __future__ import annotations

import math
from collections.abc import Iterator

from sortie.fleet.coverage import TARGET_FLAG, cameras_of, footprint_radius_m
from sortie.fleet.plane import codebooks
from sortie.policies.contract import PHASE_OF, Descriptor, Directive, Disc
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.frames import frame_at
from sortie.scenarios.representation import REPRESENTATION_OF
from sortie.sim.results import rosters
from sortie.sim.results.record import SortieRecord


def descriptors(record: SortieRecord) -> Iterator[tuple[float, Descriptor]]:
    """Every published descriptor with its time; position and attitude are the true ones of the capture's frame."""
    rows = record.tables["descriptors"].to_pylist()
    n, states = record.scenario.fleet.drones, record.tables["states"]
    names = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "vx_mps", "vy_mps", "vz_mps")
    x, y, z, qx, qy, qz, qw, vx, vy, vz = (states[name].to_numpy() for name in names)
    frame_s, spaces = record.scenario.frame_s, record.scenario.feature_spaces
    books = codebooks(record.scenario)
    cameras, blind = cameras_of(record.scenario.fleet), record.scenario.fleet.without_camera
    mission, group_of = record.tables["mission"], record.scenario.mission.group_of
    targets = {
        (frame_at(t_s, frame_s), group): target
        for t_s, group, target in zip(*(mission[name].to_pylist() for name in ("t_s", "group", "target")), strict=True)
    }
    roster_at = rosters.of(record.tables)
    for row in rows:
        frame = min(frame_at(row["t_s"], frame_s), record.scenario.frames - 1)
        k = frame * n + row["drone"]
        region = (
            None
            if math.isnan(row["region_radius_m"])
            else Disc(*(row[f"region_{c}"] for c in ("x_m", "y_m", "radius_m")))
        )
        descriptor = Descriptor(
            stamp_ns=row["stamp_ns"],
            agent_id=row["drone"],
            position_m=(float(x[k]), float(y[k]), float(z[k])),
            orientation_xyzw=(float(qx[k]), float(qy[k]), float(qz[k]), float(qw[k])),
            velocity_mps=(float(vx[k]), float(vy[k]), float(vz[k])),
            footprint_radius_m=0.0 if row["drone"] in blind else footprint_radius_m(float(z[k]), cameras[row["drone"]]),
            battery_soc=row["soc"],
            cpu_headroom=row["cpu_headroom"],
            gpu_headroom=row["gpu_headroom"],
            peer_goodput_mbps=tuple(row["goodput_mbps"]),
            coverage_grid=row["coverage_grid"],
            novelty_flags=row["novelty_flags"],
            task_phase=PHASE_OF[row["phase"]],
            region=region,
            feature_space=spaces[row["drone"]],
            codebook=books[row["drone"]],
            priority_target_ids=(targets[frame, group_of(row["drone"])],) if row["novelty_flags"] & TARGET_FLAG else (),
        )
        roster = roster_at(row["drone"], row["t_s"])
        if n > LISTED_IDS:  # the record lists goodput as the descriptor did
            descriptor = descriptor._replace(roster=roster)
        elif roster is not None:
            descriptor = descriptor.with_roster(roster)
        yield row["t_s"], descriptor


def directives(record: SortieRecord) -> Iterator[tuple[float, Directive]]:
    """Every directive that a gate took up, with its time."""
    for row in record.tables["directives"].to_pylist():
        x, y, radius = (row[f"roi_{c}"] for c in ("x_m", "y_m", "radius_m"))
        yield (
            row["t_s"],
            Directive(
                source=row["drone"],
                destination=row["peer"],
                representation=REPRESENTATION_OF[row["representation"]],
                rho=row["rho"],
                roi=None if math.isnan(radius) else Disc(x, y, radius),
                rate_hz=row["rate_hz"],
                deadline_s=row["deadline_s"],
                fusion_weight=row["fusion_weight"],
                duty_percent=row["duty_percent"],
                reason=row["reason"],
            ),
        )
