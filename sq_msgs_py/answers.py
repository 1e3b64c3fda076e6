"""What ``~/recover`` and ``~/plan`` answer: bodies of one image, or grasps, as JSON in a std_srvs/Trigger's message.

    {"frame_id": "camera", "stamp": {"sec": 7, "nanosec": 5}, "summary": "1 body in 80 ms; ...", "superquadrics": [...]}
    {"frame_id": "base_link", "stamp": {...}, "summary": "8 grasps of 1 bodies", "grasps": [...]}

Each superquadric has the columns of :class:`~sq_msgs_py.superquadrics.SuperquadricArray` by their names, each grasp
those of :class:`~sq_msgs_py.grasps.GraspArray`, in its units and order; null where a number is not known.  Where the
answer is no success, its message is the reason.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sq_msgs_py.columns import UINT32, MessageError
from sq_msgs_py.grasps import GraspArray
from sq_msgs_py.superquadrics import FIELDS, SuperquadricArray

_NAMES: dict[type[Any], str] = {SuperquadricArray: "superquadrics", GraspArray: "grasps"}
_SERVICES: dict[type[Any], str] = {SuperquadricArray: "~/recover", GraspArray: "~/plan"}
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
    """The message of an answer; ``header`` is that of the cloud."""
    columns = {column.name: getattr(found, column.name) for column in fields(found)}
    return json.dumps(
        {
            "frame_id": header.frame_id,
            "stamp": {"sec": header.stamp.sec, "nanosec": header.stamp.nanosec},
            "summary": summary,
            _NAMES[type(found)]: [
                {name: _plain(column[k]) for name, column in columns.items()} for k in range(len(found))
            ],
        },
        allow_nan=False,
    )


def from_response(response: Any) -> Answer:
    """The answer of ``~/recover`` in a std_srvs/Trigger response.

    Raises
    ------
    MessageError
        If it was no success, with its reason, or is of another service.
    """
    return Answer(*_parts(response, SuperquadricArray))


def grasps_from_response(response: Any) -> GraspAnswer:
    """The answer of ``~/plan``; raises as :func:`from_response` does."""
    return GraspAnswer(*_parts(response, GraspArray))


def _parts(response: Any, kind: type[Any]) -> tuple[Any, str, int, str]:
    """Array, frame, stamp and summary of an answer."""
    if not response.success:
        raise MessageError(response.message)
    try:
        found = json.loads(response.message)
        rows, stamp = found[_NAMES[kind]], found["stamp"]
        columns = {
            column.name: np.array([row[column.name] for row in rows], np.int64 if column.name in _WHOLE else float)
            for column in fields(kind)
            if all(column.name in row for row in rows)  # a node of another version may know less
        }
        nanoseconds = int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])
        return kind(**columns), str(found["frame_id"]), nanoseconds, str(found["summary"])
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        raise MessageError(
            f"expected the answer of a {_SERVICES[kind]} service: {type(error).__name__}: {error}"
        ) from error


def _plain(value: np.ndarray | np.generic) -> Any:
    """Numbers with as many digits as distinguish any two float32; JSON knows neither NaN nor infinity."""
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.integer):
        return int(value)
    return float(str(value)) if math.isfinite(value) else None
