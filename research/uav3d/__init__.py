"""UAV3D's files as a recording."""
