"""The conformance kit: its rules, and the views that they are tried on."""
