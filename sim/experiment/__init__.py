"""Experiments: policies × conditions × draws are flown, and what their rows come to: comparisons, campaigns, ranks."""
