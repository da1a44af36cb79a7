"""Runs in the formats of other tools: ROS 2 bags and MAVLink."""
