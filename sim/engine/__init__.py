"""The clock and everything on it: one sortie from take-off to its end."""
