#!/usr/bin/env python3
"""recover_node, and fitter_node if asked for, on the topics of a depth camera; needs no launch package.

python3 recover.py --depth /camera/camera/depth/image_rect_raw --camera-info /camera/camera/depth/camera_info
"""

from __future__ import annotations

import argparse
import sys

from sq_perception.nodes import fast_dds
from sq_perception.nodes.children import Children


def main() -> int:
    """Run until Ctrl-C, or until a node ends by itself; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depth", default="depth/image", metavar="TOPIC", help="depth images")
    parser.add_argument("--camera-info", default="depth/camera_info", metavar="TOPIC", help="their camera_info")
    parser.add_argument("--mask", default="mask/image", metavar="TOPIC", help="label images, if there are any")
    parser.add_argument("--params-file", metavar="YAML", help="parameters, like the file in share/sq_perception/config")
    parser.add_argument("--fitter", action="store_true", help="also start fitter_node, the classic method")
    options = parser.parse_args()

    arguments = ["--ros-args"]
    topics = {"depth/image": options.depth, "depth/camera_info": options.camera_info, "mask/image": options.mask}
    for name, topic in topics.items():
        arguments += ["-r", f"{name}:={topic}"]
    if options.params_file:
        arguments += ["--params-file", options.params_file]
    with Children(fast_dds.environment(), echo=True) as nodes:
        nodes.start("recover_node", arguments)
        if options.fitter:
            nodes.start("fitter_node", arguments)
        return nodes.until_stopped()


if __name__ == "__main__":
    sys.exit(main())
