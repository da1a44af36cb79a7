"""Descriptors of a fleet in GrADyS-SIM, for the page of `make bench`: `python gradys_fleet.py DRONES SECONDS`.

It needs `gradysim` alone, so another environment's Python can run it. Prints the processor seconds and the receptions.
"""

from __future__ import annotations

import sys
import time

from gradysim.protocol.interface import IProtocol
from gradysim.protocol.messages.communication import BroadcastMessageCommand
from gradysim.protocol.messages.telemetry import Telemetry
from gradysim.simulator.handler.communication import CommunicationHandler, CommunicationMedium
from gradysim.simulator.handler.timer import TimerHandler
from gradysim.simulator.simulation import SimulationBuilder, SimulationConfiguration

PERIOD_S = 0.1
DESCRIPTOR = "x" * 208


class Publisher(IProtocol):
    """Broadcasts a descriptor ten times a second, and counts those that it hears."""

    heard = 0

    def initialize(self) -> None:
        self._again()

    def _again(self) -> None:
        self.provider.schedule_timer("", self.provider.current_time() + PERIOD_S)

    def handle_timer(self, timer: str) -> None:
        self.provider.send_communication_command(BroadcastMessageCommand(DESCRIPTOR))
        self._again()

    def handle_packet(self, message: str) -> None:
        Publisher.heard += 1

    def handle_telemetry(self, telemetry: Telemetry) -> None:
        pass

    def finish(self) -> None:
        pass


def main(drones: int, seconds: float) -> None:
    """Fly a square of drones 20 m apart, all within earshot."""
    builder = SimulationBuilder(SimulationConfiguration(duration=seconds, execution_logging=False))
    builder.add_handler(TimerHandler())
    builder.add_handler(CommunicationHandler(CommunicationMedium(transmission_range=10_000)))
    side = round(drones**0.5 + 0.5)
    for i in range(drones):
        builder.add_node(Publisher, (20.0 * (i % side), 20.0 * (i // side), 60.0))
    simulation = builder.build()
    begin_s = time.process_time()
    simulation.start_simulation()
    sys.stdout.write(f"{time.process_time() - begin_s} {Publisher.heard}\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
