"""Descriptors and directives as bytes: CDR, the compact form and authentication."""
