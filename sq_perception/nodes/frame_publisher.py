"""What a frame node makes of a recovered frame: ids, the frame that the user wants, and every message about it.

The point cloud is the answer to a frame; what goes with it (:mod:`sq_perception.nodes.outputs`, markers, the rendered
depth) comes afterwards and cannot take the answer back.  Ids, and what planners were told of, outlive a restart after a
fault: a body keeps its name, and an object that is gone is still removed.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from sq_msgs_py.superquadrics import to_message
from sq_perception.nodes import results
from sq_perception.nodes.camera_poses import CameraPoses
from sq_perception.nodes.frame import Frame
from sq_perception.nodes.identity import Identity
from sq_perception.nodes.outputs import Outputs
from sq_perception.nodes.parameters import FrameParameters
from sq_perception.recordings import publication
from sq_perception.recordings.publication import Findings, Identified
from sq_perception.recovery.recoverer import FrameRecovery, render_recovery
from sq_perception.tracking.session import Tally


class FramePublisher:
    """Publishes frames; used by one thread at a time, except for ``tally`` and ``absent``.

    Parameters
    ----------
    node
        Whose publishers they are.
    warn, inform
        What takes texts for the log; ``warn`` with a kind to throttle by.
    """

    def __init__(self, node: Node, warn: Callable[[str, str], None], inform: Callable[[str], None]) -> None:
        self._node, self._warn = node, warn
        self._poses = CameraPoses(node)
        self._identity = Identity(self._poses, warn, inform)
        self._outputs = Outputs(node)
        self.superquadrics: Publisher
        self.markers: Publisher
        self.rendered_depth: Publisher
        self._is_open = False
        self._shown_ids: list[int] = []

    @property
    def tally(self) -> Tally:
        """Counts of the tracking session."""
        return self._identity.tally

    @property
    def absent(self) -> tuple[str, ...]:
        """Packages that outputs are asked for and that are not there."""
        return self._outputs.absent

    def open(self, parameters: FrameParameters) -> None:
        """Create what is published, and begin to listen to tf2 where that is needed."""
        self.superquadrics = self._node.create_publisher(PointCloud2, "~/superquadrics", 10)
        self.markers = self._node.create_publisher(MarkerArray, "~/markers", 1)
        self.rendered_depth = self._node.create_publisher(Image, "~/rendered_depth", 1)
        self._is_open = True
        self._outputs.follow(parameters)
        if parameters.fixed_frame or parameters.target_frame:
            self._poses.listen()

    def close(self) -> None:
        """Destroy the publishers; what planners were told of stays with them."""
        if self._is_open:
            for publisher in (self.superquadrics, self.markers, self.rendered_depth):
                self._node.destroy_publisher(publisher)
        self._is_open = False
        self._outputs.close()
        self._poses.close()
        self._shown_ids = []

    def withdraw(self) -> None:
        """Take back what planners were told of: nobody looks after it from now on."""
        self._outputs.withdraw()

    def answer(
        self, frame: Frame, recovery: FrameRecovery, arrival: float, parameters: FrameParameters
    ) -> tuple[Identified, Findings, dict[str, float]]:
        """Name the bodies and publish the point cloud; also milliseconds by stage.

        Parameters
        ----------
        arrival
            The time, seconds, of an image without stamp.

        Raises
        ------
        ValueError
            If there is no answer: the tracker cannot go on, or the frame that is wanted is not known.
        """
        stages, clock = {}, perf_counter()
        if parameters.tracking:
            found = self._identity.tracked(recovery, frame, arrival, parameters.fixed_frame)
            stages["tracking"] = 1e3 * (perf_counter() - clock)
        else:
            found = self._identity.untracked(recovery, frame)
        clock = perf_counter()
        findings = publication.findings(found, frame.header, frame.is_cube)
        findings = results.in_frame(findings, self._poses, parameters.target_frame)
        self.superquadrics.publish(to_message(findings.array, findings.header))
        stages["publish"] = 1e3 * (perf_counter() - clock)
        return found, findings, stages

    def accompany(
        self, frame: Frame, found: Identified, findings: Findings, parameters: FrameParameters
    ) -> dict[str, float]:
        """Publish what goes with the answer; milliseconds by stage.  Whatever goes wrong here is told, and no more."""
        clock = perf_counter()
        try:
            self._outputs.publish(findings, parameters, found.hidden)
            outputs = perf_counter()
            self._publish_pictures(frame, found, findings, parameters)
        except Exception as error:
            if self._node.context.ok():
                said = f"{type(error).__name__}: {error}"
                self._warn("beside", f"a result was published without all that goes with it: {said}")
            return {}
        return {"outputs": 1e3 * (outputs - clock), "pictures": 1e3 * (perf_counter() - outputs)}

    def _publish_pictures(
        self, frame: Frame, found: Identified, findings: Findings, parameters: FrameParameters
    ) -> None:
        if self.markers.get_subscription_count():
            self.markers.publish(findings.markers(self._shown_ids, results.marker_style(parameters)))
            self._shown_ids = findings.shown_ids
        if self.rendered_depth.get_subscription_count():
            depth, _ = render_recovery(found.recovery, frame.camera)
            self.rendered_depth.publish(frame.encode(depth))
