"""Bodies and grasps as messages of the package sq_msgs, where that is built; their fields are described there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sq_msgs_py.grasps import GraspArray
from sq_msgs_py.message_types import MessageTypes, installed
from sq_msgs_py.poses import poses_at
from sq_msgs_py.superquadrics import SuperquadricArray

_AS_THEY_ARE = ("id", "label", "status", "reason", "seen", "part", "score", "residual", "objectness")
"""Columns that are fields of the same name."""


def superquadric_array(
    bodies: SuperquadricArray,
    covariances: np.ndarray,
    header: Any,
    parts: SuperquadricArray,
    types: MessageTypes = installed,
) -> Any:
    """Return the sq_msgs/SuperquadricArray of bodies (n,), covariances (n, 6, 6) of their poses, and their parts.

    Raises
    ------
    ImportError
        Where sq_msgs is not built.
    """
    return types("sq_msgs/msg/SuperquadricArray")(
        header=header,
        superquadrics=_superquadrics(bodies, covariances, types),
        parts=_superquadrics(parts, np.full((len(parts), 6, 6), np.nan), types),
    )


def grasp_array(grasps: GraspArray, header: Any, types: MessageTypes = installed) -> Any:
    """Return the sq_msgs/GraspArray of grasps.  Raises ImportError as :func:`superquadric_array` does."""
    kind = types("sq_msgs/msg/Grasp")
    found = [
        kind(pose=pose, **{name: getattr(grasps, name)[k].item() for name in ("id", "opening", "width", "score")})
        for k, pose in enumerate(poses_at(grasps.position, grasps.rotation.astype(float), types))
    ]
    return types("sq_msgs/msg/GraspArray")(header=header, grasps=found)


def _superquadrics(bodies: SuperquadricArray, covariances: np.ndarray, types: MessageTypes) -> list[Any]:
    kind, posed, vector = (
        types(name)
        for name in ("sq_msgs/msg/Superquadric", "geometry_msgs/msg/PoseWithCovariance", "geometry_msgs/msg/Vector3")
    )

    def xyz(numbers: Sequence[float]) -> Any:
        return vector(**dict(zip("xyz", numbers, strict=True)))

    return [
        kind(
            pose=posed(pose=pose, covariance=covariances[k].ravel().tolist()),
            half_size=xyz(bodies.size[k].tolist()),
            sigma_half_size=xyz(bodies.sigma_size[k].tolist()),
            exponents=bodies.shape[k].tolist(),
            sigma_exponents=np.asarray(bodies.sigma_shape)[k].tolist(),
            taper=bodies.taper[k].tolist(),
            fused=bool(np.asarray(bodies.fused)[k]),
            **{name: getattr(bodies, name)[k].item() for name in _AS_THEY_ARE},
        )
        for k, pose in enumerate(poses_at(bodies.translation, bodies.rotation.astype(float), types))
    ]
