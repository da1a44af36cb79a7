"""How features of several drones become one map: the interface and the methods that the paper names."""
