"""recover_cameras: one process with a recover_node for each of several cameras, which share one network.

    ros2 run sq_perception recover_cameras front wrist --ros-args --params-file cameras.yaml

makes /front/recover_node and /wrist/recover_node, which take /front/depth/image, /wrist/depth/image and so on.
Parameters are those of recover_node, by node name or by wildcard:

    /**:
      ros__parameters:
        max_objects: 5
    /wrist/recover_node:
      ros__parameters:
        depth_max: 1.0

Frames are computed one after the other, in the order in which they ask (:mod:`sq_perception.nodes.engine`): a process
per camera would hold the network once each and let them compete for the same cores.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from sq_perception.nodes import process, recover_node

if TYPE_CHECKING:
    from sq_perception.nodes.frame_node import FrameNode

NAME = "recover_cameras"
_NAMESPACE = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    cut = given.index("--ros-args") if "--ros-args" in given else len(given)
    parser = argparse.ArgumentParser(
        prog=NAME, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cameras", nargs="+", metavar="CAMERA", type=_namespace, help="namespace of a camera")
    cameras = parser.parse_args(given[:cut]).cameras
    if len(set(cameras)) != len(cameras):
        parser.error(f"expected different cameras, got {' '.join(cameras)}")

    def create() -> Iterator[FrameNode]:
        names: dict[str, str] = {}
        for camera in cameras:
            node = recover_node.create(camera)
            yield node
            other = names.setdefault(node.get_fully_qualified_name(), camera)
            if other != camera:
                raise ValueError(
                    f"{other} and {camera} are both {node.get_fully_qualified_name()}: a namespace for the process "
                    f"(__ns) replaces those of the cameras; say robot/{other} robot/{camera} instead"
                )

    return process.run(NAME, create, given[cut:])


def _namespace(text: str) -> str:
    if not _NAMESPACE.fullmatch(text):
        raise argparse.ArgumentTypeError(f"expected a ROS name such as front or arm/wrist, got {text!r}")
    return text.strip("/")


if __name__ == "__main__":
    sys.exit(main())
