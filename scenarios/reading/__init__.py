"""YAML in, checked sections out: the reader, its errors, and the files that a scenario names."""
