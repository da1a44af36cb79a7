"""Write each drone's secrets to a file of its own: `ros2 run sortie_ros drone_keys FILE_OF_THE_MASTER_KEY DRONES FOLDER`."""

from __future__ import annotations

import sys
from pathlib import Path

from sortie.scenarios.errors import SortieError
from sortie.sim.live.seals import find_key, secrets_of, write_secrets


def main(arguments: list[str] | None = None) -> None:
    """`drone_0.key` … in the folder. Copy each to its drone, and keep the master key at home."""
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) != 3 or not given[1].isdecimal():
        raise SystemExit("usage: drone_keys FILE_OF_THE_MASTER_KEY DRONES FOLDER")
    try:
        master = find_key(Path(given[0]))
        for drone in range(int(given[1])):
            write_secrets(Path(given[2]) / f"drone_{drone}.key", secrets_of(master, drone))
    except SortieError as error:
        raise SystemExit(str(error)) from error
