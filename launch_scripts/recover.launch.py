"""recover_node, and fitter_node if asked for, on the topics of a depth camera; RViz2 if asked for.

With ``cameras`` one process for several cameras, which share a network: topics are then in the namespace of each.

ros2 launch sq_perception recover.launch.py depth:=/camera/camera/depth/image_rect_raw \
    camera_info:=/camera/camera/depth/camera_info rviz:=true
ros2 launch sq_perception recover.launch.py cameras:="front wrist" depth:=camera/depth/image_rect_raw \
    camera_info:=camera/depth/camera_info
"""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from sq_perception.nodes import fast_dds

ARGUMENTS = {
    "depth": ("depth/image", "topic of the depth images"),
    "camera_info": ("depth/camera_info", "topic of their camera_info"),
    "points": ("", "topic of point clouds in the optical frame, which are read instead of depth images"),
    "mask": ("mask/image", "topic of label images with the same stamps, if there are any"),
    "params_file": ("", "YAML file of parameters, like the one in share/sq_perception/config"),
    "cameras": ("", "namespaces of several cameras: recover_cameras instead of recover_node"),
    "namespace": ("", "of the nodes; relative topics are in it too"),
    "autostart": ("", "false: stay unconfigured until a lifecycle manager asks"),
    "model": ("", "network weights: a .safetensors file or the name of shipped ones"),
    "target_frame": ("", "tf2 frame that results are published in"),
    "use_sim_time": ("", "true: time is that of /clock"),
    "log_level": ("", "of the nodes: debug, info, warn, error or fatal"),
    "respawn": ("true", "start a node again that has ended by itself"),
    "fitter": ("false", "also start fitter_node, the classic method, on the first camera"),
    "rviz": ("false", "also start RViz2 with share/sq_perception/config/superquadrics.rviz, on the first camera"),
    "rviz_frame": ("camera_depth_optical_frame", "RViz2's fixed frame: the frame_id of the depth images"),
}
_YES = ("true", "1", "yes")
_PARAMETERS = {"autostart": bool, "model": str, "target_frame": str, "use_sim_time": bool}
"""Arguments that are parameters of the nodes: one that is not given is left to ``params_file``, or to the node."""
_RESPAWN_DELAY = 2.0
"""Seconds: a model that is missing must not fill the log."""


def generate_launch_description() -> LaunchDescription:
    """Called by ros2 launch."""
    declared = [DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in ARGUMENTS.items()]  # fmt: skip
    profile = [SetEnvironmentVariable(name, value) for name, value in fast_dds.additions().items()]
    return LaunchDescription([*declared, *profile, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    cameras = [_within(given["namespace"], camera).strip("/") for camera in given["cameras"].split()]
    first = cameras[0] if cameras else given["namespace"]
    executables = ["recover_cameras" if cameras else "recover_node"]
    executables += ["fitter_node"] * (given["fitter"].lower() in _YES)
    parameters: list[str | dict[str, bool | str]] = [given["params_file"]] if given["params_file"] else []
    parameters += [
        {name: given[name].lower() in _YES if kind is bool else given[name]}
        for name, kind in _PARAMETERS.items()
        if given[name]
    ]
    parameters += [{"image_transport": "points"}] * bool(given["points"])
    nodes = [
        Node(
            package="sq_perception",
            executable=executable,
            # Those of recover_cameras have names of their own: one for the process would be one for all of them.
            **({} if executable == "recover_cameras" else {"name": executable, "namespace": first}),
            output="screen",
            respawn=given["respawn"].lower() in _YES,
            respawn_delay=_RESPAWN_DELAY,
            # A file for recover_node has a method for all nodes.
            parameters=parameters + [{"method": "classic"}] * (executable == "fitter_node"),
            arguments=[
                *(cameras * (executable == "recover_cameras")),
                *(["--ros-args", "--log-level", given["log_level"]] if given["log_level"] else []),
            ],
            remappings=[
                ("depth/image", given["depth"]),
                ("depth/camera_info", given["camera_info"]),
                ("depth/points", given["points"] or "depth/points"),
                ("mask/image", given["mask"]),
            ],
        )
        for executable in executables
    ]
    return nodes + [_rviz(given, first)] * (given["rviz"].lower() in _YES)


def _rviz(given: dict[str, str], namespace: str) -> Node:
    """RViz2 on the topics of the camera in a namespace: its configuration names those of recover_node."""
    share = PathJoinSubstitution([FindPackageShare("sq_perception"), "config", "superquadrics.rviz"])
    return Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", share, "-f", given["rviz_frame"]],
        parameters=[{"use_sim_time": given["use_sim_time"].lower() in _YES}],
        remappings=[
            ("/depth/image", _within(namespace, given["depth"])),
            ("/depth/camera_info", _within(namespace, given["camera_info"])),
            *(
                (f"/{node}/{name}", _within(namespace, f"{node}/{name}"))
                for node in ("recover_node", "fitter_node")
                for name in ("markers", "rendered_depth")
                if namespace
            ),
        ],
    )


def _within(namespace: str, topic: str) -> str:
    """A topic as a node of the namespace means it."""
    return f"/{namespace.strip('/')}/{topic}" if namespace and not topic.startswith("/") else topic
