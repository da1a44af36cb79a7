"""Fitting the surrogate to the torch detector."""
