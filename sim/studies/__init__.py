"""Many sorties for one question: comparisons, conditions, learning, the paper's table."""
