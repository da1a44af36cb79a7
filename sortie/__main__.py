"""The `sortie` command as it starts: Ctrl-C and SIGTERM are one line while what the commands need is still being imported."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

from sortie._supervised import supervised


def main() -> None:
    """Entry point of the `sortie` command."""
    code = supervised()
    if code is not None:
        sys.exit(code)
    usual: dict[int, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    ours = [number for number, handler in usual.items() if signal.getsignal(number) == handler]  # ignored ones stay so
    for number in ours:
        signal.signal(number, _leave)
    from sortie.sim.cli.app import main as command  # here: it takes a second

    for number in ours:
        signal.signal(number, usual[number])
    command()


def _leave(number: int, *_: object) -> None:
    """Ends at once: libraries that are being imported take an exception for an optional part that is missing, and go on."""
    what = b"interrupted" if number == signal.SIGINT else b"ended by SIGTERM"
    os.write(2, what + b"; nothing was written\n")
    os._exit(128 + number)


if __name__ == "__main__":
    main()
