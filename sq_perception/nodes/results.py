"""Results in the frame that the user wants them in, and with the looks."""

from __future__ import annotations

from sq_perception.nodes.camera_poses import CameraPoses, PoseError
from sq_perception.nodes.inbox import Refused
from sq_perception.nodes.parameters import FrameParameters
from sq_perception.recordings.publication import Findings, MarkerStyle


def marker_style(parameters: FrameParameters) -> MarkerStyle:
    """How markers look."""
    return MarkerStyle(parameters.marker_colours, parameters.marker_alpha, parameters.marker_line_width)


def in_frame(found: Findings, camera_poses: CameraPoses, frame_id: str) -> Findings:
    """Findings in another tf2 frame, by the transform at their stamp; as they are for an empty ``frame_id``.

    Raises
    ------
    Refused
        If the transform is not known: nothing may be published in a wrong frame.
    """
    if not frame_id:
        return found
    try:
        rotation, translation = camera_poses.at(found.header, frame_id)
    except PoseError as error:
        raise Refused(
            f"target_frame: expected a transform from {found.header.frame_id!r} to {frame_id!r}: {error}"
        ) from error
    return found.moved(frame_id, rotation, translation)
