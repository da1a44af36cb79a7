"""The radio beside ns-3."""
