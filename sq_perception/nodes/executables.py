"""The programs of ``ros2 run sq_perception``: one function each, which returns the exit code.

Each imports its node inside :func:`sq_perception.nodes.process.run`: numba and rclpy take seconds to import, and
a Ctrl-C meanwhile must end the process without a traceback.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from functools import partial

from sq_perception.nodes import process

_CAMERAS = """\
recover_cameras: one process with a recover_node for each of several cameras, which share one network.

    ros2 run sq_perception recover_cameras front wrist --ros-args --params-file cameras.yaml

makes /front/recover_node and /wrist/recover_node, which take /front/depth/image, /wrist/depth/image and so on.
Parameters are those of recover_node: in a file /**: is for all, /wrist/recover_node: for one.

Frames are computed one after the other, in the order in which they ask: a process per camera would hold the network
once each and let them compete for the same cores."""
_NAMESPACE = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""Checked here as well as by rclpy, which has begun to make a node by then and complains of its rest."""


def _run(name: str, arguments: Sequence[str] | None = None) -> int:
    return process.run(name, lambda: [create_node(name)], arguments)


recover_node = partial(_run, "recover_node")
fitter_node = partial(_run, "fitter_node")
grasp_node = partial(_run, "grasp_node")
synthetic_depth_node = partial(_run, "synthetic_depth_node")


def recover_cameras(arguments: Sequence[str] | None = None) -> int:
    """A recover_node for each camera of the command line."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    cut = given.index("--ros-args") if "--ros-args" in given else len(given)
    parser = argparse.ArgumentParser(
        prog="recover_cameras", description=_CAMERAS, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cameras", nargs="+", metavar="CAMERA", type=_namespace, help="namespace of a camera")
    cameras = parser.parse_args(given[:cut]).cameras
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

    return process.run("recover_cameras", create, given[cut:])


def create_node(name: str, namespace: str | None = None) -> process.Stoppable:
    """One of this package's nodes, by the name of its program."""
    if name == "grasp_node":
        from sq_perception.nodes.grasp_node import GraspNode

        return process.made(GraspNode, name)
    if name == "synthetic_depth_node":
        from sq_perception.nodes.synthetic_depth_node import SyntheticDepthNode

        return process.made(SyntheticDepthNode, name)
    from sq_perception.nodes.frame_node import FrameNode
    from sq_perception.nodes.parameters import FitterParameters, RecoverParameters

    parameters = FitterParameters if name == "fitter_node" else RecoverParameters
    return process.made(FrameNode, name, parameters, namespace=namespace)


def _namespace(text: str) -> str:
    if not _NAMESPACE.fullmatch(text):
        raise argparse.ArgumentTypeError(f"expected a ROS name such as front or arm/wrist, got {text!r}")
    return text.strip("/")
