"""recover_node on the topics of a depth camera; if asked for, fitter_node, grasp_node and RViz2 beside it.

With ``cameras`` one process for several cameras, which share a network: topics are then in the namespace of each, and
what goes beside it is for the first one.

ros2 launch sq_perception recover.launch.py depth:=/camera/camera/depth/image_rect_raw \
    camera_info:=/camera/camera/depth/camera_info rviz:=true
ros2 launch sq_perception recover.launch.py cameras:="front wrist" depth:=camera/depth/image_rect_raw \
    camera_info:=camera/depth/camera_info
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from sq_msgs_py.poses import prefix_in
from sq_perception.nodes import process

ARGUMENTS = {
    "depth": ("depth/image", "topic of the depth images"),
    "camera_info": ("depth/camera_info", "topic of their camera_info"),
    "points": ("", "topic of point clouds in the optical frame, which are read instead of depth images"),
    "mask": ("mask/image", "topic of label images with the same stamps, if there are any"),
    "detections": ("mask/detections", "topic of yolo_msgs/DetectionArray with masks, such as /yolo/detections"),
    "params_file": ("", "YAML file of parameters, like the one in share/sq_perception/config"),
    "cameras": ("", "namespaces of several cameras: recover_cameras instead of recover_node"),
    "namespace": ("", "of the nodes; relative topics are in it too"),
    "autostart": ("", "false: stay unconfigured until a lifecycle manager asks"),
    "model": ("", "network weights: a .safetensors file or the name of shipped ones"),
    "target_frame": ("", "tf2 frame that results are published in"),
    "use_sim_time": ("", "true: time is that of /clock"),
    "log_level": ("", "of the nodes: debug, info, warn, error or fatal"),
    "respawn": ("true", "start a node again that has ended by itself"),
    "fitter": ("false", "also start fitter_node, the classic method"),
    "grasp": ("false", "also start grasp_node on the bodies of recover_node"),
    "gripper": ("", "of grasp_node: panda, robotiq_2f_85 or robotiq_2f_140"),
    "rviz": ("false", "also start RViz2 with share/sq_perception/config/superquadrics.rviz"),
    "rviz_frame": ("camera_depth_optical_frame", "RViz2's fixed frame: the frame_id of the depth images"),
}
_YES = ("true", "1", "yes")
_PARAMETERS = ("model", "target_frame")
_SWITCHES = ("autostart", "use_sim_time")
"""Arguments that are parameters: one that is not given is left to ``params_file``, or to the node."""
_MARKERS = ("recover_node/markers", "recover_node/rendered_depth", "fitter_node/markers", "grasp_node/markers")


def generate_launch_description() -> LaunchDescription:
    """Called by ros2 launch."""
    declared = [DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in ARGUMENTS.items()]  # fmt: skip
    profile = [SetEnvironmentVariable(name, value) for name, value in process.additions().items()]
    return LaunchDescription([*declared, *profile, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Node]:
    """What is to be started.

    Raises
    ------
    RuntimeError
        If a file or package is missing: launch then ends before anything has started, and leaves nothing behind.
    """
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    file = given["params_file"] and str(Path(given["params_file"]).expanduser())
    if file and not Path(file).is_file():
        raise RuntimeError(f"params_file: expected a YAML file, {file} is none")
    asked = {name: given[name].lower() in _YES for name in ("fitter", "grasp", "rviz")}
    if asked["rviz"]:
        _check_rviz()
    cameras = [_within(given["namespace"], camera).strip("/") for camera in given["cameras"].split()]
    first = cameras[0] if cameras else given["namespace"]
    switches = {name: given[name].lower() in _YES for name in _SWITCHES if given[name]}
    files = [file] if file else []
    common = [*files, *({name: given[name]} for name in _PARAMETERS if given[name])]
    common += [{name: value} for name, value in switches.items()]
    common += [{"image_transport": "points"}] * bool(given["points"])
    inputs = [
        ("depth/image", given["depth"]),
        ("depth/camera_info", given["camera_info"]),
        ("depth/points", given["points"] or "depth/points"),
        ("mask/image", given["mask"]),
        ("mask/detections", given["detections"]),
    ]
    single = {"namespace": first}
    nodes = [
        # No name and namespace for recover_cameras: those of the process would be those of all its nodes.
        _node("recover_cameras", given, common, inputs, arguments=cameras)
        if cameras
        else _node("recover_node", given, common, inputs, name="recover_node", **single)
    ]
    if asked["fitter"]:
        # A file for recover_node has a method for all nodes.
        classic = [*common, {"method": "classic"}]
        nodes.append(_node("fitter_node", given, classic, inputs, name="fitter_node", **single))
    if asked["grasp"]:
        wiring = [(name, f"recover_node/{name}") for name in ("superquadrics", "support_plane")]
        # First, so that a prefix in the file has the last word.
        own = [{"tf_prefix": prefix_in(first)}] * bool(cameras) + files + [switches] * bool(switches)
        own += [{"gripper": given["gripper"]}] * bool(given["gripper"])
        nodes.append(_node("grasp_node", given, own, wiring, name="grasp_node", **single))
    return [*nodes, _rviz(given, first)] if asked["rviz"] else nodes


def _node(
    executable: str,
    given: dict[str, str],
    parameters: list[Any],
    remappings: list[tuple[str, str]],
    *,
    arguments: list[str] | None = None,
    **named: str,
) -> Node:
    level = ["--ros-args", "--log-level", given["log_level"]] if given["log_level"] else []
    return Node(
        package="sq_perception",
        executable=executable,
        output="screen",
        respawn=given["respawn"].lower() in _YES,
        respawn_delay=2.0,  # seconds: a model that is missing must not fill the log
        parameters=parameters,
        remappings=remappings,
        arguments=[*(arguments or []), *level],
        **named,
    )


def _check_rviz() -> None:
    try:
        get_package_prefix("rviz2")
    except (PackageNotFoundError, LookupError) as error:
        raise RuntimeError(
            "rviz:=true: the package rviz2 is not installed: sudo apt install ros-$ROS_DISTRO-rviz2, or leave "
            "rviz:=true out"
        ) from error


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
            *((f"/{name}", _within(namespace, name)) for name in _MARKERS if namespace),
        ],
    )


def _within(namespace: str, topic: str) -> str:
    """A topic as a node of the namespace means it."""
    return f"/{namespace.strip('/')}/{topic}" if namespace and not topic.startswith("/") else topic
