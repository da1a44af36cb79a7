"""The paper's instrument: share less or with fewer at evaluation time, and see what it costs. Free of torch but for `instrument.py`."""
