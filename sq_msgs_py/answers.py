"""What ``~/recover`` and ``~/plan`` answer: bodies of one image, or grasps, as JSON in a std_srvs/Trigger's message.

    {"frame_id": "camera", "stamp": {"sec": 7, "nanosec": 5}, "summary": "1 body in 80 ms; ...", "superquadrics": [...]}
    {"frame_id": "base_link", "stamp": {...}, "summary": "8 grasps of 1 bodies", "grasps": [...]}

Each superquadric has the columns of :class:`~sq_msgs_py.superquadrics.SuperquadricArray` by their names, each grasp
those of :class:`~sq_msgs_py.grasps.GraspArray`, in its units and order; null where a number is not known.  Where the
answer is no success, its message is the reason.

Where the package sq_msgs is built, the same as its messages, whose fields are described there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sq_msgs_py.columns import UINT32, MessageError
from sq_msgs_py.grasps import GraspArray
from sq_msgs_py.message_types import MessageTypes, find_type
from sq_msgs_py.poses import poses_at
from sq_msgs_py.superquadrics import FIELDS, SuperquadricArray

_NAMES: dict[type[Any], tuple[str, str]] = {
    SuperquadricArray: ("superquadrics", "~/recover"),
    GraspArray: ("grasps", "~/plan"),
}
"""The key and the service of each kind of answer."""
_WHOLE = tuple(name for name, kind in FIELDS if kind == UINT32)


@dataclass(frozen=True, eq=False)
class Answer:
    """The bodies of one image, the frame they are in, the image's stamp, nanoseconds, and a summary."""

    bodies: SuperquadricArray
    frame_id: str
    stamp: int
    summary: str


@dataclass(frozen=True, eq=False)
class GraspAnswer:
    """Grasps, the frame they are in, the stamp of the bodies' image, nanoseconds, and a summary."""

    grasps: GraspArray
    frame_id: str
    stamp: int
    summary: str


def text_of(found: SuperquadricArray | GraspArray, header: Any, summary: str) -> str:
    """Return the message of an answer; ``header`` is that of the cloud."""
    columns = {column.name: getattr(found, column.name) for column in fields(found)}
    rows = [{name: _plain(column[k]) for name, column in columns.items()} for k in range(len(found))]
    stamp = {"sec": header.stamp.sec, "nanosec": header.stamp.nanosec}
    answer = {"frame_id": header.frame_id, "stamp": stamp, "summary": summary, _NAMES[type(found)][0]: rows}
    return json.dumps(answer, allow_nan=False)


def from_response(response: Any) -> Answer:
    """Return the answer of ``~/recover`` in a std_srvs/Trigger response.  Raises MessageError if it was no success,
    with its reason, or is of another service."""
    return Answer(*_parts(response, SuperquadricArray))


def grasps_from_response(response: Any) -> GraspAnswer:
    """Return the answer of ``~/plan``; raises as :func:`from_response` does."""
    return GraspAnswer(*_parts(response, GraspArray))


def _parts(response: Any, kind: type[Any]) -> tuple[Any, str, int, str]:
    """Return array, frame, stamp and summary of an answer."""
    if not response.success:
        raise MessageError(response.message)
    try:
        found = json.loads(response.message)
        rows, stamp = found[_NAMES[kind][0]], found["stamp"]
        columns = {
            column.name: np.array([row[column.name] for row in rows], np.int64 if column.name in _WHOLE else float)
            for column in fields(kind)
            if all(column.name in row for row in rows)  # a node of another version may know less
        }
        nanoseconds = int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])
        return kind(**columns), str(found["frame_id"]), nanoseconds, str(found["summary"])
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        expected = f"expected the answer of a {_NAMES[kind][1]} service"
        raise MessageError(f"{expected}: {type(error).__name__}: {error}") from error


def _plain(value: np.ndarray | np.generic) -> Any:
    """Return numbers with as many digits as distinguish any two float32; JSON knows neither NaN nor infinity."""
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.integer):
        return int(value)
    return float(str(value)) if math.isfinite(value) else None


_AS_THEY_ARE = ("id", "label", "status", "reason", "seen", "part", "score", "residual", "objectness")
"""Columns that are fields of the same name."""


def superquadric_array(
    bodies: SuperquadricArray, covariances: np.ndarray, header: Any, parts: SuperquadricArray,
    types: MessageTypes = find_type,
) -> Any:
    """Return the sq_msgs/SuperquadricArray of bodies (n,), covariances (n, 6, 6) of their poses, and their parts.
    Raises ImportError where sq_msgs is not built."""
    return types("sq_msgs/msg/SuperquadricArray")(
        header=header,
        superquadrics=_superquadrics(bodies, covariances, types),
        parts=_superquadrics(parts, np.full((len(parts), 6, 6), np.nan), types),
    )


def grasp_array(grasps: GraspArray, header: Any, types: MessageTypes = find_type) -> Any:
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
            pose=posed(pose=pose, covariance=covariances[k].ravel().tolist()), half_size=xyz(bodies.size[k].tolist()),
            sigma_half_size=xyz(bodies.sigma_size[k].tolist()), exponents=bodies.shape[k].tolist(),
            sigma_exponents=np.asarray(bodies.sigma_shape)[k].tolist(), taper=bodies.taper[k].tolist(),
            fused=bool(np.asarray(bodies.fused)[k]), **{name: getattr(bodies, name)[k].item() for name in _AS_THEY_ARE},
        )
        for k, pose in enumerate(poses_at(bodies.translation, bodies.rotation.astype(float), types))
    ]
