"""Code from outside: files and installed packages that replace a part of Sortie."""
