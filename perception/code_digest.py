"""Which code computed boxes: results of hours are kept under it, and made anew where it changed. Free of torch."""

from __future__ import annotations

from sortie.scenarios.code_digest import sources_digest


def boxes_digest() -> str:
    """16 hex digits over everything that boxes and their matches follow from, but for weights, settings and frames.

    Those are the sources of this room and of `scenarios`, and the libraries that compute. Not the whole package: another
    radio or policy changes no box, and what is kept takes hours. Not fewer files either: which of these a box follows from
    would have to be listed by hand, and a file that is missing there gives old results under a new release.
    """
    return sources_digest(("perception", "scenarios"), ("numba", "numpy", "scipy", "torch"))
