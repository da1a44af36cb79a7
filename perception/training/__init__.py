"""Learning: batches and losses, the run, what the weights are worth."""
