"""One drone: context publisher, policy node and gate. `ros2 launch sortie_ros drone.launch.py drone:=0 key_file:=...`"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "drone": ("0", int),
    "scenario": ("paper_replay", str),
    "set": ("", str),
    "key_file": ("", str),
    "begin_unix_s": ("0.0", float),
    "fallback": ("detections@2", str),
    "mavlink": ("", str),
    "origin": ("", str),
    "mavlink_key_file": ("", str),
}


def generate_launch_description() -> LaunchDescription:
    """The three nodes of a drone, with the same parameters."""
    parameters = [{name: ParameterValue(LaunchConfiguration(name), value_type=t) for name, (_, t) in ARGUMENTS.items()}]
    declared = [DeclareLaunchArgument(name, default_value=default) for name, (default, _) in ARGUMENTS.items()]
    nodes = [
        Node(
            package="sortie_ros",
            executable=executable,
            namespace=["drone_", LaunchConfiguration("drone")],
            parameters=parameters,
            output="screen",
        )
        for executable in ("context_publisher", "policy_node", "gate")
    ]
    return LaunchDescription([*declared, *nodes])
