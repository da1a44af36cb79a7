"""The laboratory: the paper's claims, training, calibration and studies. It is run from a clone (`python -m research`)
and not installed; it imports `sortie` as a user does, and nothing in `sortie` imports it."""
