"""Training of the detector, and fitting of what representations need."""
