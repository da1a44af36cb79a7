"""What a user can mend, told in one line by the command line."""

from __future__ import annotations

from sortie.scenarios.errors import SortieError


class InputError(SortieError):
    """A file or setting that perception was given is not as it must be; the message names it, the value and the bound."""
