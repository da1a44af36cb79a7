"""The `sortie` command, a file a group of its commands."""
