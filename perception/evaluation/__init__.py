"""The paper's evaluation: limit at test time what drones share, and measure the AP that it costs. Only `instrument.py` needs torch."""
