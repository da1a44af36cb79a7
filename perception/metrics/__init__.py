"""Metrics of boxes: average precision, overlap, and intervals by bootstrap."""
