"""Tracks of cars: a Kalman filter, an assignment, a life cycle, and what a track looks like on the air. Free of torch."""
