"""Campaigns: many sorties over what is varied, resumable, the same rows on one core or a cluster."""
