"""synthetic_depth_node: depth images with known truth, or recorded ones, as a camera would publish them.

| name | type | |
| --- | --- | --- |
| `depth/image` | sensor_msgs/Image | out: 32FC1 or 16UC1; mono8 or mono16 for orthographic frames |
| `depth/image/compressedDepth` | sensor_msgs/CompressedImage | out, for `image_transport: compressedDepth`: packed |
| `depth/camera_info` | sensor_msgs/CameraInfo | out: for pinhole frames |
| `mask/image` | sensor_msgs/Image | out: label images (16UC1), where recordings have them or they are asked for |
| `~/truth` | sensor_msgs/PointCloud2 | out: the bodies of generated scenes, in the message of the recovery |

All carry the same stamp and frame.  Publishers are reliable, which best effort subscribers hear too.  The image goes
last: whoever has it has the rest.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sq_perception.nodes import process

if TYPE_CHECKING:
    from sq_perception.nodes.synthetic_publisher import SyntheticDepthNode

NAME = "synthetic_depth_node"


def create() -> SyntheticDepthNode:
    """The node; imported here, so that Ctrl-C is heard while numba and rclpy are imported."""
    from sq_perception.nodes.synthetic_publisher import SyntheticDepthNode

    return SyntheticDepthNode(NAME)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    return process.run(NAME, lambda: [create()], arguments)


if __name__ == "__main__":
    sys.exit(main())
