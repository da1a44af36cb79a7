"""The policies that ship with Sortie, a file each."""
