"""Other models and data sets: recordings of any detector, and UAV3D's files. Free of torch but for the user's own fusion."""
