"""How good boxes are: average precision, overlap, and intervals by bootstrap."""
