"""How the suites of `sortie rank` are drawn."""
