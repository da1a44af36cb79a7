"""A fast model of the torch detector, fitted from its own runs. Free of torch but for `collect.py` and `fit.py`."""
