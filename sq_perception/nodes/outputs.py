"""The outputs of a frame node: point cloud, pictures, and messages for other stacks.

The point cloud is published first and does not depend on the other outputs.  tf2_msgs, vision_msgs and moveit_msgs are
not on PyPI and may be missing on a robot: each is imported only when its output is enabled; a missing one is named once
in the log and listed in ``absent``.

/tf is published like tf2_ros.TransformBroadcaster does, with the same queue of 100; our own publisher needs only
tf2_msgs, knows its subscribers, and can be destroyed.

The planning scene is sent again when another planner subscribes, and periodically.  Switching it off removes all added
objects.  A node that exits removes nothing: a planner must not lose its obstacles because a camera fails.  The record
of added objects survives a restart after a fault, so that vanished objects are still removed.
"""

from __future__ import annotations

import threading
from collections.abc import Collection
from functools import partial
from time import monotonic
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from sq_msgs_py import collision_objects
from sq_msgs_py.answers import superquadric_array
from sq_msgs_py.markers import markers
from sq_msgs_py.message_types import find_type
from sq_msgs_py.poses import detections, plane_message, transforms
from sq_msgs_py.superquadrics import to_message
from sq_perception.nodes.frame import Frame, latched_qos
from sq_perception.nodes.managed_node import optional
from sq_perception.nodes.parameters import RecoverParameters
from sq_perception.nodes.statistics import THROTTLE
from sq_perception.nodes.tracking import CameraPoses, Pose, PoseError
from sq_perception.recordings.publication import Findings, Identified
from sq_perception.recovery.recoverer import render_recovery
from sq_perception.recovery.recovery import timed

_OVERRIDABLE = tuple(getattr(QoSPolicyKind, name) for name in ("HISTORY", "DEPTH", "RELIABILITY", "DURABILITY"))


class Outputs:
    """The publishers of frames; used by one thread at a time."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.optional = OptionalOutputs(node)
        self._publishers: tuple[Publisher, ...] = ()
        self._header: Any = None  # header of the markers that are shown, if there are any

    def open(self, parameters: RecoverParameters) -> None:
        """Create the publishers."""
        create = partial(
            self._node.create_publisher, qos_overriding_options=QoSOverridingOptions(policy_kinds=_OVERRIDABLE)
        )
        self.superquadrics = create(PointCloud2, "~/superquadrics", 10)
        self.markers = create(MarkerArray, "~/markers", 1)
        self.rendered_depth = create(Image, "~/rendered_depth", 1)
        self.support_plane = create(PoseStamped, "~/support_plane", latched_qos())
        self.array = optional(self._node, create, "sq_msgs/msg/SuperquadricArray", "~/superquadric_array", 10)
        publishers = self.superquadrics, self.markers, self.rendered_depth, self.support_plane, self.array
        self._publishers = tuple(one for one in publishers if one is not None)
        self.optional.follow(parameters)

    def close(self) -> None:
        """Destroy the publishers and delete the markers; planners keep their objects."""
        if self._publishers:
            self.hide()
            self.markers.wait_for_all_acked(Duration(seconds=0.5))  # before the publisher is destroyed
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)
        self._publishers = ()
        self.optional.close()

    def hide(self) -> None:
        """Delete the markers, since nothing updates them from now on."""
        if self._header is not None and self._node.context.ok():
            header, self._header = self._header, None
            self.markers.publish(markers([], [], header))

    def answer(self, shown: Findings) -> None:
        """Publish plane and point cloud."""
        if not shown.header.frame_id:
            self._node.get_logger().warning(
                "the images have no frame_id: RViz and tf2 cannot place the results, and there are no transforms or "
                "collision objects; the camera driver must set it",
                throttle_duration_sec=THROTTLE,
            )
        if shown.plane is not None:  # first: who plans on the bodies, as grasp_node does, has what they stand on
            self.support_plane.publish(plane_message(shown.plane, shown.header))
        self.superquadrics.publish(to_message(shown.cloud, shown.header))

    def accompany(
        self, found: Identified, shown: Findings, frame: Frame, parameters: RecoverParameters, stages: dict[str, float]
    ) -> None:
        """Publish the other outputs and note the time of each stage.  Errors are only logged."""
        try:
            if self.array is not None and self.array.get_subscription_count():
                self.array.publish(superquadric_array(shown.array, shown.covariances, shown.header, shown.parts))
            with timed(stages, "outputs"):
                self.optional.publish(shown, parameters, found.hidden)
            with timed(stages, "pictures"):
                if self.markers.get_subscription_count():
                    self.markers.publish(shown.markers(parameters.marker_alpha))
                    self._header = shown.header
                if self.rendered_depth.get_subscription_count():
                    self.rendered_depth.publish(frame.encode(render_recovery(found.recovery, frame.camera)[0]))
        except Exception as error:
            if self._node.context.ok():
                self._node.get_logger().warning(
                    f"a result was published without its other outputs: {type(error).__name__}: {error}",
                    throttle_duration_sec=THROTTLE,
                )


def pose_in(poses: CameraPoses, header: Any, frame_id: str, patience: float, parameter: str = "target_frame") -> Pose:
    """Return the pose of a header's frame in the tf2 frame of a parameter, at its stamp; ValueError if unknown."""
    try:
        return poses.at(header, frame_id, patience)
    except PoseError as error:
        raise ValueError(
            f"{parameter}: expected a transform from {header.frame_id!r} to {frame_id!r}: {error}"
        ) from error


def in_frame(found: Findings, poses: CameraPoses, frame_id: str, patience: float = 0.1) -> Findings:
    """Return findings in another tf2 frame; unchanged for an empty ``frame_id``.  Raises ValueError as :func:`pose_in`:
    nothing may be published in a wrong frame."""
    return found.move(frame_id, *pose_in(poses, found.header, frame_id, patience)) if frame_id else found


_KINDS = {
    "publish_tf": ("tf2_msgs", "TFMessage", "/tf", 100),
    "publish_detections": ("vision_msgs", "Detection3DArray", "~/detections", 10),
    "publish_collision_objects": ("moveit_msgs", "PlanningScene", "~/planning_scene", 10),
}
"""Package, message, topic and queue of each optional output."""


class OptionalOutputs:
    """Messages for other stacks that the parameters enable; used by one thread, except for ``absent``."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers: dict[str, Publisher] = {}
        self.absent: dict[str, str] = {}  # missing packages by output; replaced as a whole, for other threads
        self._scene = collision_objects.Scene()
        self._planner_came = threading.Event()
        self._all_due = 0.0

    def follow(self, parameters: RecoverParameters) -> None:
        """Create the publishers that are enabled, and destroy the others."""
        asked = [parameter for parameter in _KINDS if getattr(parameters, parameter)]
        self.absent = {parameter: package for parameter, package in self.absent.items() if parameter in asked}
        for parameter in asked:
            if parameter not in self._publishers and parameter not in self.absent:
                self._create(parameter)
        for parameter in self._publishers.keys() - set(asked):
            if parameter == "publish_collision_objects" and self.withdraw():
                continue  # the publisher lasts until the next call, so that its last message arrives
            self._node.destroy_publisher(self._publishers.pop(parameter))

    def publish(self, found: Findings, parameters: RecoverParameters, hidden: Collection[int] = ()) -> None:
        """Publish a frame on the outputs that are enabled and have subscribers.

        ``hidden``: ids of bodies that the frame does not show and that are not given up.
        """
        self.follow(parameters)
        has_frame = bool(found.header.frame_id)
        array, header, prefix = found.array, found.header, parameters.tf_prefix
        heard = self._heard("publish_tf")
        if has_frame and heard and len(array.recovered):
            message: Any = heard.msg_type
            heard.publish(message(transforms=transforms(array, header, prefix=prefix)))
        if heard := self._heard("publish_detections"):
            heard.publish(detections(array, header, covariances=found.covariances, prefix=prefix))
        planners = self._heard("publish_collision_objects")
        if planners is None:
            return
        if self._planner_came.is_set():
            self._planner_came.clear()
            self._scene.forget()
        if monotonic() >= self._all_due:
            self._scene.repeat()
            # A planner receives none while it plans, and a lost message would leave its world wrong for good.
            self._all_due = monotonic() + 5.0
        if not (parameters.publish_collision_objects and has_frame):
            return
        objects = self._scene.changes(
            array, header, hidden, rests=bool(parameters.target_frame) or not parameters.fixed_frame,
            meshes=(lambda: found.meshes) if parameters.collision_shapes == "mesh" else None, prefix=prefix,
        )
        if objects:
            planners.publish(collision_objects.planning_scene(objects))

    def withdraw(self) -> bool:
        """Remove every object from the planning scene, since nothing updates it; return whether there was one."""
        publisher = self._publishers.get("publish_collision_objects")
        objects = self._scene.clear() if publisher is not None else []
        if publisher is not None and objects:
            publisher.publish(collision_objects.planning_scene(objects))
        return bool(objects)

    def close(self) -> None:
        """Destroy the publishers; objects stay in the planning scene and are remembered."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
        self._publishers = {}

    def _create(self, parameter: str) -> None:
        package, kind, topic, queue = _KINDS[parameter]
        try:
            message_type: Any = find_type(f"{package}/msg/{kind}")
            events = PublisherEventCallbacks(matched=partial(self._note_listener, parameter))
            self._publishers[parameter] = self._node.create_publisher(
                message_type, topic, queue, event_callbacks=events
            )
        except Exception as error:  # a package that is there in part fails in other ways than ImportError
            self.absent = {**self.absent, parameter: package}
            self._node.get_logger().warning(
                f"{parameter}: expected {package}, which cannot be used ({error}): {topic} is not published; Debian "
                f"package ros-$ROS_DISTRO-{package.replace('_', '-')}"
            )

    def _note_listener(self, parameter: str, event: Any) -> None:
        """Note a planner that has started and knows nothing; called in the executor's thread."""
        if parameter == "publish_collision_objects" and event.current_count_change > 0:
            self._planner_came.set()

    def _heard(self, parameter: str) -> Publisher | None:
        """Return the publisher of an enabled output, if it has subscribers."""
        publisher = self._publishers.get(parameter)
        return publisher if publisher is not None and publisher.get_subscription_count() else None
