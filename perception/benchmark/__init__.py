"""The benchmark: seeded splits of procedural scenes that anyone can reproduce."""
