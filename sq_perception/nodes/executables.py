"""The programs of ``ros2 run sq_perception``: one function each, which returns the exit code.

Each imports its node inside :func:`sq_perception.nodes.process.run`: numba and rclpy take seconds to import, and
a Ctrl-C during that time must end the process without a traceback.
"""

# ruff: noqa: E402 - the imports below take long enough for a Ctrl-C
from __future__ import annotations

import signal
import sys

PROGRAMS = ("recover_node", "recover_cameras", "fitter_node", "grasp_node", "synthetic_depth_node")

if sys.argv[0].rpartition("/")[2] in PROGRAMS and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Until process.run takes over, in this program alone: Python's own handler would raise in the midst of imports.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import argparse
import re
from collections.abc import Iterator, Sequence
from functools import partial

from sq_perception.nodes import process

_USAGE = "ros2 run sq_perception %(prog)s{} [--ros-args -p NAME:=VALUE --params-file FILE -r TOPIC:=OTHER ...]"
_ABOUT = {
    "recover_node": """\
Depth images in, superquadrics out.

subscribes depth/image and depth/camera_info, or depth/points; mask/image or mask/detections for masks
publishes  ~/superquadrics ~/markers ~/rendered_depth ~/support_plane /diagnostics
services   ~/enable ~/trigger ~/recover, and those of a lifecycle node
with the package sq_msgs also ~/superquadric_array ~/recover_array and the action ~/recover_images""",
    "fitter_node": "recover_node with the classic fit of Solina and Bajcsy, with the same topics.",
    "grasp_node": """\
Superquadrics in, grasps of a parallel gripper out.

subscribes superquadrics and support_plane: remap them to /recover_node/superquadrics, /recover_node/support_plane
publishes  ~/grasps ~/grasp_details ~/markers /diagnostics
services   ~/plan, ~/plan_grasps where moveit_msgs is installed, and those of a lifecycle node
with the package sq_msgs also ~/grasp_array ~/plan_array""",
    "synthetic_depth_node": """\
A simulated depth camera, or recorded frames.

publishes  depth/image depth/camera_info mask/image ~/truth""",
    "recover_cameras": """\
One process with a recover_node for each of several cameras, which share one network.

    ros2 run sq_perception recover_cameras front wrist --ros-args --params-file cameras.yaml

makes /front/recover_node and /wrist/recover_node, which subscribe to /front/depth/image, /wrist/depth/image and so on.
Parameters are those of recover_node: in a file /**: is for all, /wrist/recover_node: for one.

Frames are computed in turn: one process per camera would load the network several times and compete for the cores.""",
}
_NAMESPACE = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""Checked here too, since rclpy checks it only while it makes a node, and complains of the unfinished node."""


def _run(name: str, arguments: Sequence[str] | None = None) -> int:
    given = list(sys.argv[1:] if arguments is None else arguments)
    _parser(name).parse_args(_before_ros(given))
    return process.run(name, lambda: [create_node(name)], given)


recover_node = partial(_run, "recover_node")
fitter_node = partial(_run, "fitter_node")
grasp_node = partial(_run, "grasp_node")
synthetic_depth_node = partial(_run, "synthetic_depth_node")


def recover_cameras(arguments: Sequence[str] | None = None) -> int:
    """Run one recover_node per camera on the command line."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser("recover_cameras", " CAMERA ...")
    parser.add_argument("cameras", nargs="+", metavar="CAMERA", type=_namespace, help="namespace of a camera")
    ours = _before_ros(given)
    cameras = parser.parse_args(ours).cameras
    if len(set(cameras)) != len(cameras):
        parser.error(f"expected different cameras, got {' '.join(cameras)}")

    def create() -> Iterator[process.Stoppable]:
        names: dict[str, str] = {}
        for camera in cameras:
            node = create_node("recover_node", camera)
            yield node
            other = names.setdefault(node.get_fully_qualified_name(), camera)
            if other != camera:
                raise ValueError(
                    f"{other} and {camera} are both {node.get_fully_qualified_name()}: a namespace for the process "
                    f"(__ns) replaces those of the cameras; write robot/{other} robot/{camera} instead"
                )

    return process.run("recover_cameras", create, given[len(ours) :])


def _before_ros(arguments: list[str]) -> list[str]:
    """Return the arguments that are not for ROS."""
    return arguments[: arguments.index("--ros-args")] if "--ros-args" in arguments else arguments


def _parser(name: str, positional: str = "") -> argparse.ArgumentParser:
    """Make a parser that refuses unknown arguments; its help lists the parameters with their defaults."""
    kind = name.replace("recover_cameras", "recover_node")
    parameters = process.configuration_file(f"{kind}.yaml").read_text(encoding="utf-8")
    return argparse.ArgumentParser(
        prog=name, usage=_USAGE.format(positional), description=_ABOUT[name], epilog=parameters.replace("%", "%%"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def create_node(name: str, namespace: str | None = None) -> process.Stoppable:
    """Create one of this package's nodes by the name of its program."""
    if name == "grasp_node":
        from sq_perception.nodes.grasp_node import GraspNode

        return process.make(GraspNode, name)
    if name == "synthetic_depth_node":
        from sq_perception.nodes.synthetic_depth_node import SyntheticDepthNode

        return process.make(SyntheticDepthNode, name)
    from sq_msgs_py.poses import prefix_in
    from sq_perception.nodes.frame_node import FrameNode
    from sq_perception.nodes.parameters import FitterParameters, RecoverParameters

    parameters = FitterParameters if name == "fitter_node" else RecoverParameters
    # Bodies of two cameras must not have one name.
    own = {} if namespace is None else {"tf_prefix": prefix_in(namespace)}
    return process.make(FrameNode, name, parameters, namespace=namespace, defaults=own)


def _namespace(text: str) -> str:
    if not _NAMESPACE.fullmatch(text):
        raise argparse.ArgumentTypeError(f"expected a ROS name such as front or arm/wrist, got {text!r}")
    return text.strip("/")
