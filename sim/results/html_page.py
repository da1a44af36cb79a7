"""The mark of Sortie's pages, where two commands still look for it."""

from sortie.sim.results.blocks import GENERATOR

__all__ = ["GENERATOR"]
