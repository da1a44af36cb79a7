"""The search of all views, for policies in plain Python."""
