"""ROS 2 nodes around Sortie's live drones: adapters to rclpy alone, all logic is in `sortie.sim.live`."""
