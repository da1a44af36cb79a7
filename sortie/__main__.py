"""The `sortie` command as it starts."""

from __future__ import annotations

from sortie import _signals

_signals.end_at_once()

import sys  # noqa: E402 - after the signals, as what comes now takes a second

from sortie._supervised import supervised  # noqa: E402


def main() -> None:
    """Entry point of the `sortie` command."""
    code = supervised()
    if code is not None:
        sys.exit(code)
    from sortie.sim.cli.app import main as command

    command()


if __name__ == "__main__":
    main()
