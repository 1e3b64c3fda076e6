"""grasp_node: superquadrics in, grasps of a parallel gripper out; its topics are in docs/grasping.md.

All outputs have the header of the cloud.  The last plane in its frame is used, even if the camera has moved with that
frame since; without a plane, grippers approach from the side of the frame's origin: the camera, or ``target_frame``.
Measured points, unseen space and correlations are in no message and so ignored, unlike in ``sq-perception grasp``.  The
cloud does not say whether it is in metres: of clouds from orthographic images, only the frame ``unit_cube`` is refused.

``~/plan`` and ``~/plan_grasps`` plan on the last cloud again, unless it is older than ``max_age``: if the camera has
stopped, the bodies may be gone.

If moveit_msgs is installed, ``~/plan_grasps`` is its service GraspPlanning: moveit_msgs/Grasp for the body whose
collision object is the target's id, or for all bodies without an id.  Other fields of the request are ignored.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Any, cast

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from sq_msgs_py import answers, poses
from sq_msgs_py import grasps as messages
from sq_msgs_py.answers import grasp_array
from sq_msgs_py.markers import markers
from sq_msgs_py.message_types import find_type
from sq_msgs_py.superquadrics import SuperquadricArray, from_message
from sq_perception.grasping.gripper import GRIPPERS, Gripper, gripper
from sq_perception.grasping.plan import GraspPlan
from sq_perception.grasping.planner import FRICTION, PLACEMENT, grasps, warm_up
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.nodes.frame import latched_qos, stamp_of
from sq_perception.nodes.listener import Listener
from sq_perception.nodes.managed_node import ManagedNode, optional
from sq_perception.nodes.parameters import EVERYWHERE, LiveParameters, Parameters, check_box, check_prefix, setting
from sq_perception.nodes.statistics import OLDEST, THROTTLE, Statistics
from sq_perception.recordings.publication import CUBE_FRAME, covariances, superquadrics
from sq_perception.recovery.recovery import timed
from sq_perception.segmentation.options import Box

_OF_EACH_GRASP = ("position", "rotation", "opening", "width", "score")
"""Columns of a message that are attributes of a grasp of the same name."""


@dataclass(frozen=True)
class GraspParameters(Parameters):
    """Parameters of grasp_node."""

    autostart: bool = setting(True, "Configure and activate at start; false: wait for a lifecycle manager.", live=False)
    max_age: float = setting(
        10.0, "~/plan and ~/plan_grasps refuse bodies older than this; 0: never.", unit="s", within=(0.0, 3600.0)
    )
    no_cloud_warning: float = setting(
        5.0, "Warn after this time without bodies; 0 never warns.", unit="s", within=(0.0, 3600.0)
    )
    tf_prefix: str = setting(poses.PREFIX, "The tf_prefix of recover_node, for the names that ~/plan_grasps uses.")
    gripper: str = setting("panda", "Gripper to plan for.", choices=tuple(GRIPPERS))
    friction: float = setting(FRICTION, "Smallest friction coefficient between pads and objects.", within=(0.05, 2.0))
    placement: float = setting(
        PLACEMENT, "Standard deviation of the hand's position along each axis, metres.", within=(0.0, 0.05)
    )
    min_score: float = setting(0.3, "Publish only grasps that hold with at least this probability.", within=(0.0, 1.0))
    only_id: int = setting(-1, "Plan only for the body with this id; -1: for all.", within=(-1, 2**31 - 1))
    region: tuple[float, ...] = setting(
        EVERYWHERE,
        "Plan for bodies with their centre in this box, min x, y, z, max x, y, z, in the cloud's frame; the default "
        "keeps all.",
        unit="m",
    )

    @property
    def box(self) -> Box | None:
        """``region``; None for the default, which keeps all, however far away the origin of a map is."""
        return None if self.region == GraspParameters.region else cast(Box, self.region)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_box("region", self.region)
        check_prefix(self.tf_prefix)


class GraspNode(ManagedNode):
    """Node that plans grasps; see the module."""

    def __init__(self, name: str, *, context: Any = None) -> None:
        super().__init__(name, Statistics(what="cloud"), context=context)
        self._settings = LiveParameters(self, GraspParameters)
        self._last: PointCloud2 | None = None
        self._heard_at = monotonic()
        self._arrival = 0.0  # its arrival, seconds of the node's clock
        self._plane: PoseStamped | None = None
        # By names that rclpy's Node has not: it keeps lists of its own, and destroying takes out of these.
        self._outputs: list[Publisher] = []
        self._array: Publisher | None = None
        self._publishing = threading.Lock()  # held while publishing, or while publishing ends
        self._clouds: Listener | None = None
        self._planes: Any = None
        self.create_service(Trigger, "~/plan", self._on_plan)
        optional(self, self.create_service, "sq_msgs/srv/PlanGrasps", "~/plan_array", self._on_plan_array)
        with suppress(ImportError):
            self.create_service(find_type("moveit_msgs/srv/GraspPlanning"), "~/plan_grasps", self._on_plan_grasps)
        self.start(self._settings.current.autostart)

    def _configure(self) -> None:
        """Compile or load the kernels, so that the first cloud does not wait."""
        warm_up()

    def _activate(self) -> None:
        self._last = self._plane = None  # of another time: what was there then may be gone
        self._outputs = [
            self.create_publisher(PoseArray, "~/grasps", 10),
            self.create_publisher(PointCloud2, "~/grasp_details", 10),
            self.create_publisher(MarkerArray, "~/markers", 10),
        ]
        self._array = optional(self, self.create_publisher, "sq_msgs/msg/GraspArray", "~/grasp_array", 10)
        self._planes = self.create_subscription(PoseStamped, "support_plane", self._on_plane, latched_qos())
        self._heard_at = monotonic()
        self._clouds = Listener(self, PointCloud2, "superquadrics", self._on_cloud, self._statistics)
        self.get_logger().info(f"ready, listening to {self._clouds.topic}")

    def _deactivate(self) -> None:
        clouds, self._clouds = self._clouds, None
        if clouds is not None:
            clouds.close()
            self.destroy_subscription(self._planes)
        with self._publishing:
            if self._outputs and self._last is not None and self.context.ok():
                shown = self._outputs[-1]
                shown.publish(markers([], [], self._last.header, namespace="grasps"))
                shown.wait_for_all_acked(Duration(seconds=0.5))  # before the publisher is destroyed
            for publisher in (*self._outputs, *([] if self._array is None else [self._array])):
                self.destroy_publisher(publisher)
            self._outputs, self._array = [], None

    _cleanup = _deactivate

    def _on_plane(self, message: PoseStamped) -> None:
        self._plane = message

    def _on_cloud(self, message: PointCloud2) -> None:
        self._last, self._arrival, self._heard_at = message, self._now(), monotonic()
        self._statistics.count("received")
        stages: dict[str, float] = {}
        with timed(stages, "plan"):
            found, text = self._answer(message)
        if found is not None:
            self._statistics.answer(stages, text)
        elif self._clouds is None:
            self._statistics.count("dropped")
        else:
            self._statistics.refuse(text)

    def _now(self) -> float:
        return 1e-9 * self.get_clock().now().nanoseconds

    def _age(self, cloud: PointCloud2) -> float:
        """Return the seconds since the stamp of the last cloud, or since its arrival if the stamp is of another
        clock."""
        now, stamp = self._now(), 1e-9 * stamp_of(cloud)
        since = max(now - self._arrival, 0.0)
        return max(now - stamp, since) if stamp and now - stamp < OLDEST else since

    def _on_second(self) -> None:
        clouds, limit, silence = self._clouds, self._settings.current.no_cloud_warning, monotonic() - self._heard_at
        cloud, standing = self._last, self.standing()
        more = {} if cloud is None else {"age of the bodies [s]": f"{self._age(cloud):.1f}"}
        if clouds is not None:
            clouds.follow()
            if 0 < limit < silence:
                text = f"no superquadrics on {clouds.topic} for {silence:.0f} s: {clouds.publishers}"
                self.get_logger().warning(text, throttle_duration_sec=THROTTLE)
                standing = standing or (DiagnosticStatus.WARN, "no superquadrics arrive")
        self.report(standing, more)

    def _on_plan(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        found, response.message, cloud = self._plan_again()
        if found:
            response.success, response.message = True, answers.text_of(found, cloud.header, response.message)
        return response

    def _on_plan_array(self, request: Any, response: Any) -> Any:
        found, response.message, cloud = self._plan_again()
        if found:
            response.success, response.grasps = True, grasp_array(found, cloud.header)
        return response

    def _on_plan_grasps(self, request: Any, response: Any) -> Any:
        code, target = response.error_code, request.target.id
        code.source = self.get_fully_qualified_name()
        found, code.message, cloud = self._plan_again()
        if found is None:
            code.val = code.FAILURE
            return response
        settings = self._settings.current
        known = [poses.body_name(number, settings.tf_prefix) for number in from_message(cloud).recovered.id]
        if target and target not in known:
            code.val = code.INVALID_OBJECT_NAME
            code.message = f"target: expected an id among {', '.join(known) or 'none'}, got {target!r}"
            return response
        hand, plane = gripper(settings.gripper), self._plane_in(cloud.header)
        up = None if plane is None else plane[:3].tolist()
        each = messages.moveit_grasps(
            found, cloud.header, hand.link, hand.link_from_tcp, up, settings.tf_prefix, hand.joints
        )
        response.grasps = [one for one in each if not target or target in one.allowed_touch_objects]
        code.val = code.SUCCESS if response.grasps else code.PLANNING_FAILED
        return response

    def _plan_again(self) -> tuple[messages.GraspArray | None, str, Any]:
        """Return grasps on the last cloud, or None and why, and that cloud."""
        cloud = self._last
        if not self.is_active or cloud is None:
            return None, "no superquadrics have come yet" if self.is_active else f"the node is {self.state}", cloud
        age, limit = self._age(cloud), self._settings.current.max_age
        if 0 < limit < age:
            return None, f"the last superquadrics are {age:.1f} s old, and max_age is {limit:g} s", cloud
        found, text = self._answer(cloud)
        return found, f"{text}; {age:.1f} s old", cloud

    def _plane_in(self, header: Any) -> np.ndarray | None:
        """Return the last plane if it is in the frame of this header."""
        plane = self._plane
        return poses.plane_of(plane) if plane is not None and plane.header.frame_id == header.frame_id else None

    def _answer(self, message: PointCloud2) -> tuple[messages.GraspArray | None, str]:
        """Plan and publish; return the grasps and why bodies have none.  No message ends the node."""
        try:
            if message.header.frame_id == CUBE_FRAME:
                raise ValueError("views of the unit cube have no metres to grasp in")
            array = from_message(message)
            bodies = array.recovered
            planned = plan(array, self._settings.current, self._plane_in(message.header))
            with self._publishing:
                if not self._outputs:  # deactivated while it was planned
                    return None, f"the node is {self.state}"
                found = self._publish(message.header, bodies, planned, gripper(self._settings.current.gripper))
        except Exception as error:
            reason = f"refused superquadrics: {type(error).__name__}: {error}"
            self.get_logger().warning(reason, throttle_duration_sec=THROTTLE)
            return None, reason
        reasons = [f"{number}: {why}" for number, why in zip(bodies.id, planned.reasons, strict=True) if why]
        if len(bodies) and not (reasons or len(found)):
            reasons = ["only_id and region leave none"]
        return found, "; ".join([f"{len(found)} grasps of {len(bodies)} bodies", *reasons])

    def _publish(self, header: Any, bodies: SuperquadricArray, plan: GraspPlan, hand: Gripper) -> messages.GraspArray:
        found = messages.GraspArray(
            **{name: np.array([getattr(grasp, name) for grasp in plan.grasps]) for name in _OF_EACH_GRASP},
            id=np.array([bodies.id[grasp.body] for grasp in plan.grasps]),
        )
        arrows, details, shown = self._outputs
        arrows.publish(messages.poses(found, header))
        details.publish(messages.to_message(found, header))
        if self._array is not None:
            self._array.publish(grasp_array(found, header))
        best = {int(bodies.id[grasp.body]): grasp for grasp in reversed(plan.grasps)}
        meshes = []
        for grasp in best.values():
            vertices, faces, edges = hand.mesh(grasp.opening)
            meshes.append((grasp.to_body_frame(vertices), faces, grasp.to_body_frame(edges)))
        shown.publish(markers(meshes, list(best), header, namespace="grasps"))
        return found


def plan(array: SuperquadricArray, parameters: GraspParameters, plane: np.ndarray | None = None) -> GraspPlan:
    """Plan grasps of recovered objects as the parameters say; excluded ones are obstacles without grasps."""
    bodies, (rows, things) = array.recovered, array.with_parts
    hand = gripper(parameters.gripper)
    friction, placement = parameters.friction, parameters.placement
    plan = grasps(superquadrics(rows), hand, covariances(rows), Surroundings(plane), friction, placement, things)
    wanted = (parameters.only_id == -1) | (bodies.id == parameters.only_id)
    if (box := parameters.box) is not None:
        wanted = wanted & np.all((bodies.translation >= box[:3]) & (bodies.translation <= box[3:]), axis=1)
    kept = tuple(grasp for grasp in plan.grasps if grasp.score >= parameters.min_score and wanted[grasp.body])
    have = {grasp.body for grasp in kept}
    reasons = tuple(
        "" if k in have or not wanted[k] else why or f"less probable than {parameters.min_score:g}"
        for k, why in enumerate(plan.reasons)
    )
    return GraspPlan(kept, reasons)
