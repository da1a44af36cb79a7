"""Training: batches and losses, the run, and validation of the weights."""
