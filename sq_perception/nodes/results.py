"""Recovered bodies as the columns and meshes that messages are made of.

Frames: those of a frame's findings are the optical frame of its image, for orthographic images the cube frame, until
they are moved into another (:func:`in_frame`).  Metres, or the cube's unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from visualization_msgs.msg import MarkerArray

from sq_msgs_py import poses
from sq_msgs_py.markers import markers
from sq_msgs_py.superquadrics import CONVERGED, SuperquadricArray
from sq_perception.geometry.mesh import MARKER_RESOLUTION, mesh, outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.nodes.camera_poses import CameraPoses, PoseError
from sq_perception.nodes.frame import Frame
from sq_perception.nodes.inbox import Refused
from sq_perception.nodes.parameters import FrameParameters
from sq_perception.recovery import FrameRecovery

_WORST, _BEST = np.array([0.80, 0.20, 0.15]), np.array([0.20, 0.65, 0.30])
_CENTRE_AND_TURN = slice(5, 11)
"""Of a body's covariance: its centre in the optical frame and its rotation vector in its own."""

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (k, 3) and faces (m, 3) of vertex indices."""


@dataclass(frozen=True, eq=False)
class Findings:
    """What one image showed, as every output but the rendered depth is made of it.

    Attributes
    ----------
    array
        Every object, failed ones included.
    covariances : (n, 6, 6)
        Of their poses, as in :mod:`sq_msgs_py.poses`; NaN where unknown.
    header
        std_msgs/Header: the stamp of the image, and the frame that all this is in.
    """

    array: SuperquadricArray
    covariances: np.ndarray
    header: Any

    @property
    def shown_ids(self) -> list[int]:
        """Ids of the bodies that did not fail, those of the meshes."""
        return [int(number) for number in self.array.recovered.id]

    @cached_property
    def meshes(self) -> tuple[Mesh, ...]:
        """Surface of each body that did not fail, in the body's own frame; made when it is first asked for."""
        shown = self.array.recovered
        surfaces = [mesh(_at_origin(*one), MARKER_RESOLUTION) for one in zip(shown.size, shown.shape, strict=True)]
        return tuple((np.asarray(one.vertices), np.asarray(one.faces)) for one in surfaces)

    def moved(self, frame_id: str, rotation: np.ndarray, translation: np.ndarray) -> Findings:
        """The same in another frame, p_new = R(rotation) p + translation; the stamp stays."""
        return Findings(
            array=poses.moved(self.array, rotation, translation),
            covariances=poses.moved_covariances(self.covariances, rotation),
            header=poses.header_in(self.header, frame_id),
        )

    def markers(self, parameters: FrameParameters, previous_ids: Iterable[int]) -> MarkerArray:
        """Meshes and outlines of the bodies that did not fail; those of ``previous_ids`` that are gone are deleted."""
        shown = self.array.recovered
        turns = poses.matrices(poses.unit_quaternions(shown.rotation))
        surfaces = []
        for k, (vertices, faces) in enumerate(self.meshes):
            turn, centre = turns[k].T, shown.translation[k].astype(float)
            lines = outline(_at_origin(shown.size[k], shown.shape[k]))
            surfaces.append((vertices @ turn + centre, faces, lines @ turn + centre))
        colours = None
        if parameters.marker_colours == "score" and len(shown):
            share = np.clip(np.nan_to_num(shown.score), 0, 1)[:, None]
            colours = (1 - share) * _WORST + share * _BEST
        return markers(
            surfaces,
            self.shown_ids,
            self.header,
            colours=colours,
            alpha=parameters.marker_alpha,
            line_width=parameters.marker_line_width,
            previous_ids=previous_ids,
        )


def findings(recovery: FrameRecovery, ids: Sequence[int], frame: Frame) -> Findings:
    """What a frame showed, in the frame of its image."""
    array = superquadric_array(recovery, ids, frame.is_cube)
    covariances = np.full((len(array), 6, 6), np.nan)
    for k, one in enumerate(recovery.bodies):
        covariances[k] = one.covariance[_CENTRE_AND_TURN, _CENTRE_AND_TURN]
    change = np.zeros((len(array), 6, 6))
    change[:, :3, :3] = np.diag([1.0, -1.0, -1.0]) if frame.is_cube else np.eye(3)
    change[:, 3:, 3:] = poses.matrices(poses.unit_quaternions(array.rotation))
    return Findings(array, change @ covariances @ np.swapaxes(change, 1, 2), frame.header)


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


def superquadric_array(recovery: FrameRecovery, ids: Sequence[int], is_cube: bool) -> SuperquadricArray:
    """Every object of a frame, failed ones included; in the cube frame if ``is_cube``, else in the optical frame."""
    if not recovery.bodies:
        return SuperquadricArray.empty()
    bodies = Superquadric.stack([one.superquadric for one in recovery.bodies])
    if is_cube:
        bodies = unit_cube.cube_from_optical(bodies)
    return SuperquadricArray(
        size=bodies.size,
        shape=bodies.shape,
        translation=bodies.translation,
        rotation=bodies.rotation,
        score=np.array([one.score for one in recovery.bodies]),
        residual=np.array([one.residual for one in recovery.bodies]),
        sigma_size=np.stack([one.sigma_size for one in recovery.bodies]),
        id=np.array(ids, dtype=np.uint32),
        status=np.array([one.status for one in recovery.bodies], dtype=np.uint32),
    )


def truth_array(bodies: Superquadric) -> SuperquadricArray:
    """A batch (n,) of known bodies: score 1, residual and deviations 0, ids 1 to n."""
    count = len(bodies)
    return SuperquadricArray(
        size=bodies.size,
        shape=bodies.shape,
        translation=bodies.translation,
        rotation=bodies.rotation,
        score=np.ones(count),
        residual=np.zeros(count),
        sigma_size=np.zeros((count, 3)),
        id=np.arange(1, count + 1, dtype=np.uint32),
        status=np.full(count, CONVERGED, dtype=np.uint32),
    )


def _at_origin(size: np.ndarray, shape: np.ndarray) -> Superquadric:
    return Superquadric(size.astype(float), shape.astype(float), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
