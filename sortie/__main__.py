"""The `sortie` command as it starts."""

from __future__ import annotations

from sortie import _signals

_signals.end_at_once()


def main() -> None:
    """Entry point of the `sortie` command."""
    from sortie.sim.cli.app import main as command

    command()


if __name__ == "__main__":
    main()
