"""Positions to signal-to-noise ratios: path loss, antennas, shadowing, fading, bursts of loss and link traces."""
