"""A fleet on this host: all drones and the benchmark node. `ros2 launch sortie_ros fleet.launch.py drones:=5 keys:=FOLDER`"""

import time

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

LEAD_S = 15.0
"""From here until the scenario's time 0: nodes load, and publishers fly the scenario in simulation."""


def fleet(context: LaunchContext) -> list[Node]:
    """The nodes of every drone, and the benchmark node."""
    drones = int(LaunchConfiguration("drones").perform(context))
    scenario, keys = (LaunchConfiguration(name).perform(context) for name in ("scenario", "keys"))
    changes = LaunchConfiguration("set").perform(context)
    shared = {"scenario": scenario, "set": ";".join(filter(None, [f"fleet.drones={drones}", changes]))}
    begin_unix_s = time.time() + LEAD_S
    nodes = [Node(package="sortie_ros", executable="benchmark", parameters=[shared], output="screen")]
    for drone in range(drones):
        own = {"drone": drone, "begin_unix_s": begin_unix_s, "key_file": f"{keys}/drone_{drone}.key" if keys else ""}
        nodes += [
            Node(
                package="sortie_ros",
                executable=executable,
                namespace=f"drone_{drone}",
                parameters=[{**shared, **own}],
                output="screen",
            )
            for executable in ("context_publisher", "policy_node", "gate")
        ]
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Arguments: drones, scenario, set (fields as KEY=VALUE, separated by semicolons), keys."""
    arguments = {"drones": "5", "scenario": "paper_replay", "set": "", "keys": ""}
    declared = [DeclareLaunchArgument(name, default_value=default) for name, default in arguments.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=fleet)])
