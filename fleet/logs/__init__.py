"""Flight logs of real drones: readers, context traces made of them, and MAVLink."""
