"""Scenarios against their own expectations: verdicts, golden outcomes, the pytest plugin."""
