"""Recovered bodies as the columns and meshes that messages are made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from visualization_msgs.msg import MarkerArray

from sq_msgs_py.markers import markers
from sq_msgs_py.superquadrics import CONVERGED, SuperquadricArray
from sq_perception.fitting.fit import Status
from sq_perception.geometry.mesh import MARKER_RESOLUTION, mesh, outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.nodes.frame import Frame
from sq_perception.nodes.parameters import FrameParameters
from sq_perception.recovery import FrameRecovery

_WORST, _BEST = np.array([0.80, 0.20, 0.15]), np.array([0.20, 0.65, 0.30])


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


def shown_ids(recovery: FrameRecovery, ids: Sequence[int]) -> list[int]:
    """Ids of the bodies that have markers: those that did not fail."""
    return [number for one, number in zip(recovery.bodies, ids, strict=True) if one.status != Status.FAILED]


def marker_array(
    recovery: FrameRecovery,
    ids: Sequence[int],
    frame: Frame,
    parameters: FrameParameters,
    previous_ids: Sequence[int],
) -> MarkerArray:
    """Meshes and outlines of the recovered bodies; markers of ``previous_ids`` that are gone are deleted."""
    shown = recovery.recovered
    bodies = [unit_cube.cube_from_optical(one.superquadric) if frame.is_cube else one.superquadric for one in shown]
    meshes = []
    for body in bodies:
        surface = mesh(body, MARKER_RESOLUTION)
        meshes.append((surface.vertices, surface.faces, outline(body)))
    colours = None
    if parameters.marker_colours == "score" and shown:
        share = np.clip(np.nan_to_num([one.score for one in shown]), 0, 1)[:, None]
        colours = (1 - share) * _WORST + share * _BEST
    return markers(
        meshes,
        shown_ids(recovery, ids),
        frame.header,
        colours=colours,
        alpha=parameters.marker_alpha,
        line_width=parameters.marker_line_width,
        previous_ids=previous_ids,
    )
