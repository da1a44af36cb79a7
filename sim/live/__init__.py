"""The context plane in real time over DDS: one process a drone, a bench that measures beside them."""
