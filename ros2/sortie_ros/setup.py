"""The package for colcon; Sortie itself (`pip install sortie-sim`) must be importable where the nodes run."""

from glob import glob

from setuptools import setup

setup(
    name="sortie_ros",
    version="0.2.0",
    packages=["sortie_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/sortie_ros"]),
        ("share/sortie_ros", ["package.xml"]),
        ("share/sortie_ros/launch", sorted(glob("launch/*.launch.py"))),
    ],
    install_requires=["setuptools"],
    entry_points={
        "console_scripts": [
            "context_publisher = sortie_ros.nodes:context_publisher",
            "policy_node = sortie_ros.nodes:policy_node",
            "gate = sortie_ros.nodes:gate",
            "benchmark = sortie_ros.nodes:benchmark",
            "drone_keys = sortie_ros.keys:main",
        ]
    },
)
