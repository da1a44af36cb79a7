"""The procedural town, its cars and what cameras on a drone see of it."""
