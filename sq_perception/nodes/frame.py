"""Decoding of depth image messages, and encoding of depth as messages of the same kind.

The message is an Image, a CompressedImage (PNG or RVL) or a PointCloud2, by ``image_transport``; their quality of
service is here too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import cv2
import numpy as np
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Header

from sq_msgs_py.columns import labels_of_points, points_from_message
from sq_msgs_py.depth_image import DEPTH_ENCODINGS, GREY_ENCODINGS, labels_from_message
from sq_perception.geometry.rotation import to_matrix
from sq_perception.imaging import depth_units, unit_cube
from sq_perception.imaging.calibration import Calibration
from sq_perception.imaging.camera import Camera
from sq_perception.nodes.parameters import POINTS, RAW
from sq_perception.recordings import cloud_file, publication
from sq_perception.recordings.cloud_file import move

DepthMessage: TypeAlias = Image | CompressedImage | PointCloud2
MaskMessage: TypeAlias = Any
"""A label image, or a yolo_msgs/DetectionArray, which is imported only where it is installed."""


def newest_qos() -> QoSProfile:
    """Return the quality of service of images: keep only the newest, as a queue would delay slow subscribers.

    Made anew each time, as rclpy writes overrides into it.
    """
    return QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)


def latched_qos() -> QoSProfile:
    """Return the quality of service of persistent messages: later subscribers get the last one."""
    return QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


@dataclass(frozen=True, eq=False)
class Frame:
    """A depth image that is ready to be processed.

    ``depth`` (height, width) is float32, metres in the optical frame, NaN where nothing was measured, rectified as the
    int32 ``labels`` are; ``encoding`` is that of the message before it was packed.  ``has_free_space``: whether a
    pixel beside an object shows that there is nothing before what it measured; not so for a cloud that is no image.
    ``notes`` say what was found out about the message's numbers.
    """

    header: Any
    encoding: str
    depth: np.ndarray
    calibration: Calibration
    labels: np.ndarray | None = None
    has_free_space: bool = True
    notes: tuple[str, ...] = ()

    @property
    def camera(self) -> Camera:
        """The camera of the depth image, pinhole or orthographic."""
        return self.calibration.camera

    @property
    def is_cube(self) -> bool:
        """Whether results are in the cube frame."""
        return not self.camera.is_pinhole

    def with_mask(self, message: MaskMessage) -> Frame:
        """Return the frame with the masks of its objects.  Raises ValueError for a wrong size or encoding."""
        is_image = isinstance(message, Image)
        labels = labels_from_message(message) if is_image else draw_masks(message, self.calibration.size)
        (rows, columns), (width, height) = labels.shape, self.calibration.size
        if (columns, rows) != (width, height):
            raise ValueError(f"mask: expected the size of the depth image, {width} x {height}, got {columns} x {rows}")
        return replace(self, labels=self.calibration.rectify_labels(labels))

    def encode(self, depth: np.ndarray) -> Image:
        """Encode another depth image (height, width), NaN or inf for no reading, as a message like the frame's own."""
        return publication.depth_message(self.calibration.as_sent(depth), self.header, self.encoding)


def decode(
    message: DepthMessage, calibration_of: Callable[[], Calibration] | None, scale: float | None = None,
    kind: str = "z", view: tuple[str, tuple[np.ndarray, np.ndarray]] | None = None,
) -> Frame:
    """Decode a depth image message; raises ValueError for anything that prevents its processing.

    ``message``: 16UC1 or 32FC1, plain or compressed; mono8 or mono16, an image of the unit cube; or points, which
    determine the camera.  ``calibration_of``: Looks up the calibration; only called for a valid image, not for clouds.
    None for images of the unit cube.  ``scale``, ``kind``: units per metre, None: by the encoding; and whether the
    image holds "z" or "range".  ``view``: the camera's optical frame and the pose, quaternion and translation, of the
    points in it; None: they are in it.
    """
    if isinstance(message, PointCloud2):
        header, points = message.header, points_from_message(message) / np.float32(scale or 1.0)
        if view is not None:
            frame_id, (turn, shift) = view
            header, points = Header(stamp=header.stamp, frame_id=frame_id), move(points, to_matrix(turn), shift)
        try:
            labels = labels_of_points(message, cloud_file.LABEL_FIELDS)
            found = cloud_file.as_image(points, None if labels is None else cloud_file.labels_of(labels))
        except ValueError as error:
            raise ValueError(f"points in {header.frame_id or 'a frame without a name'}: {error}") from error
        # Rounded, so that noise does not change it between frames.
        numbers = {name: round(getattr(found.camera, name), 3) for name in ("fx", "fy", "cx", "cy")}
        notes = () if labels is None else (cloud_file.LABELLED,)
        calibration = Calibration(replace(found.camera, **numbers))
        return Frame(header, "32FC1", found.depth, calibration, found.labels, found.is_image, notes)
    if calibration_of is None:
        if message.encoding in DEPTH_ENCODINGS:
            raise ValueError(
                f"encoding: expected mono8 or mono16 for projection = orthographic, got {message.encoding!r}; "
                "metric depth images of a camera need projection = pinhole"
            )
        image, encoding = publication.depth_of(message, is_cube=True)
        height, width = image.depth.shape
        return Frame(message.header, encoding, image.depth, Calibration(unit_cube.camera(width, height)))
    if isinstance(message, Image) and message.encoding in GREY_ENCODINGS:
        raise ValueError(
            f"encoding: expected 16UC1 or 32FC1 for projection = pinhole, got {message.encoding!r}; "
            "grey images of the unit cube need projection = orthographic"
        )
    image, encoding = publication.depth_of(message, False, scale)
    calibration = calibration_of()
    depth = calibration.rectify(image.depth)
    if kind == "range":
        depth = depth_units.z_from_range(depth, calibration.camera)
    return Frame(message.header, encoding, depth, calibration, notes=image.notes)


def draw_masks(message: MaskMessage, size: tuple[int, int]) -> np.ndarray:
    """Draw the masks of a yolo_msgs/DetectionArray as a label image, int32 (height, width): label k is the k-th
    detection, the higher score on top.  Raises ValueError for one without a mask, or of an image of another size."""
    labels = np.zeros(size[::-1], np.int32)
    numbered = enumerate(message.detections, start=1)
    for number, detection in sorted(numbered, key=lambda one: float(one[1].score)):
        mask = detection.mask
        outline = np.array([(point.x, point.y) for point in mask.data], dtype=float).reshape(-1, 2)
        if len(outline) < 3 or not np.isfinite(outline).all():
            raise ValueError(
                f"mask: expected a mask in every detection, got {len(outline)} finite points in number {number}: "
                "use a model for segmentation, such as yolo11n-seg.pt"
            )
        if (mask.width, mask.height) != size:
            raise ValueError(
                f"mask: expected detections in an image of {size[0]} x {size[1]}, the depth image's size, got "
                f"{mask.width} x {mask.height}: align the depth image to the colour image"
            )
        # Within the image: OpenCV's coordinates have 32 bits.
        inside = np.rint(np.clip(outline, 0, np.subtract(size, 1))).astype(np.int32)
        cv2.fillPoly(labels, [inside], number)
    return labels


def image_topic(node: Node, transport: str) -> str:
    """Return the topic of depth images, with the node's namespace and remappings.  The transport is appended to the
    remapped ``depth/image``, unless that ends in it.  Points have a separate topic, ``depth/points``."""
    if transport == POINTS:
        return str(node.resolve_topic_name("depth/points"))
    resolved: str = node.resolve_topic_name("depth/image")
    if transport == RAW or resolved.endswith(f"/{transport}"):
        return resolved
    return f"{resolved}/{transport}"


def listen_to_latched_info(node: Node, topic: str, callback: Callable[[CameraInfo], None]) -> Subscription | None:
    """Subscribe to a camera_info that is latched, if a publisher offers one.

    Not without looking: a driver that keeps nothing would log an incompatible subscription.
    """
    offered = node.get_publishers_info_by_topic(topic)
    if all(publisher.qos_profile.durability != QoSDurabilityPolicy.TRANSIENT_LOCAL for publisher in offered):
        return None
    # Others on the topic may keep nothing; a plain subscription hears them.
    quietly = SubscriptionEventCallbacks(incompatible_qos=lambda _: None)
    return node.create_subscription(CameraInfo, topic, callback, latched_qos(), event_callbacks=quietly)


def stamp_of(message: Any) -> int:
    """Return the nanoseconds of a message's header.  Not by rclpy's Time, which refuses stamps before 1970."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
