"""The study of the flip: whether the best choice of peers changes with the budget."""
