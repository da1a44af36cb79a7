"""Who may send when, and for how long: contention, airtime, rate control and group-addressed frames."""
