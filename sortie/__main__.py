"""The `sortie` command as it starts: Ctrl-C is one line also while what the commands need is still being imported."""

from __future__ import annotations

import os
import signal


def main() -> None:
    """Entry point of the `sortie` command."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # where it is ignored, it stays so
        signal.signal(signal.SIGINT, _leave)
    from sortie.sim.cli.app import main as command  # here: it takes a second

    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, before)
    command()


def _leave(*_: object) -> None:
    """Ends at once: libraries that are being imported take an exception for an optional part that is missing, and go on."""
    os.write(2, b"interrupted; nothing was written\n")
    os._exit(130)


if __name__ == "__main__":
    main()
