"""Benchmark: seeded splits of procedural scenes, their difficulty and contents."""
