"""A synthetic depth camera with recover_node and fitter_node behind it; RViz2 if asked for.

ros2 launch sq_perception synthetic.launch.py scene:=table rate:=10.0 rviz:=true
ros2 launch sq_perception synthetic.launch.py scene:=replay path:=/recordings/frame.npz
"""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from sq_perception.nodes import fast_dds

ARGUMENTS = {
    "scene": ("table", "thesis (orthographic grey images), table (pinhole) or replay"),
    "path": ("", "recorded frame or folder of frames, for scene:=replay"),
    "projection": ("auto", "camera model of recorded frames, pinhole or orthographic; auto: by the scene"),
    "rate": ("10.0", "frames per second"),
    "seed": ("0", "seed of scenes and noise"),
    "rviz": ("false", "also start RViz2 with share/sq_perception/config/superquadrics.rviz"),
}


def generate_launch_description() -> LaunchDescription:
    """Called by ros2 launch."""
    declared = [DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in ARGUMENTS.items()]  # fmt: skip
    profile = [SetEnvironmentVariable(name, value) for name, value in fast_dds.additions().items()]
    return LaunchDescription([*declared, *profile, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    projection = given["projection"]
    if projection == "auto":
        projection = "orthographic" if given["scene"] == "thesis" else "pinhole"
    camera = {
        "scene": given["scene"],
        "path": given["path"],
        "projection": projection,
        "rate": float(given["rate"]),
        "seed": int(given["seed"]),
    }
    nodes = {
        "recover_node": {"projection": projection},
        "fitter_node": {"projection": projection},
        "synthetic_depth_node": camera,
    }
    started = [
        Node(package="sq_perception", executable=name, name=name, output="screen", parameters=[parameters])
        for name, parameters in nodes.items()
    ]
    if given["rviz"].lower() in ("true", "1", "yes"):
        share = PathJoinSubstitution([FindPackageShare("sq_perception"), "config", "superquadrics.rviz"])
        frame = "unit_cube" if projection == "orthographic" else "camera_depth_optical_frame"
        started.append(Node(package="rviz2", executable="rviz2", arguments=["-d", share, "-f", frame]))
    return started
