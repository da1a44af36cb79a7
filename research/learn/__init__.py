"""Fitting the policy `learned`."""
