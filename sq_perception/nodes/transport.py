"""How depth images travel: as they are, or packed on a topic beside it, as image_transport names it.

| image_transport | topic | type |
| --- | --- | --- |
| `raw` | `<image topic>` | sensor_msgs/Image |
| `compressedDepth` | `<image topic>/compressedDepth` | sensor_msgs/CompressedImage: PNG or RVL |

A subscriber of either reads :func:`size_of` and :func:`depth_of` the message, and need not know which it has.
"""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from sq_msgs_py.depth_image import depth_from_message
from sq_perception.imaging import compressed_depth

RAW = "raw"
TRANSPORTS = (RAW, compressed_depth.TRANSPORT)


def message_type(transport: str) -> type[Any]:
    """The type of messages of a transport."""
    return Image if transport == RAW else CompressedImage


def topic(node: Node, image_topic: str, transport: str) -> str:
    """The topic to listen to for the images of ``image_topic``, with the node's namespace and remappings.

    A remapping holds for the image's topic, and the transport's part comes behind that; one that names it already is
    left as it is.
    """
    resolved: str = node.resolve_topic_name(image_topic)
    if transport == RAW or resolved.endswith(f"/{transport}"):
        return resolved
    return f"{resolved}/{transport}"


def size_of(message: Image | CompressedImage) -> tuple[int, int]:
    """Width and height of a depth image; of a packed one from its header alone.

    Raises
    ------
    ValueError
        If a packed image is none.
    """
    if isinstance(message, CompressedImage):
        return compressed_depth.size(message.format, message.data)
    return int(message.width), int(message.height)


def depth_of(message: Image | CompressedImage) -> tuple[np.ndarray, str]:
    """Depth in metres, float32 (height, width), NaN for nothing, and its encoding, 16UC1 or 32FC1, before packing.

    Raises
    ------
    ValueError
        If the message is no depth image; says what was expected and what arrived.
    """
    if isinstance(message, CompressedImage):
        depth = compressed_depth.decode(message.format, message.data)
        return depth, compressed_depth.encoding(message.format) or ""
    return depth_from_message(message), message.encoding


def packed(depth: np.ndarray, header: Any, encoding: str = "16UC1") -> CompressedImage:
    """A packed message of depth (height, width) in metres, NaN or inf for nothing; 16UC1 or 32FC1."""
    image_format, data = compressed_depth.encode(depth, encoding)
    return CompressedImage(header=header, format=image_format, data=array.array("B", data))
