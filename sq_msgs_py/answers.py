"""What ``~/recover`` of a frame node answers: the bodies of one image, as JSON in the message of a std_srvs/Trigger.

    {"frame_id": "camera", "stamp": {"sec": 7, "nanosec": 5}, "words": "1 body in 80 ms; ...", "superquadrics": [...]}

Each superquadric has the columns of :class:`~sq_msgs_py.superquadrics.SuperquadricArray` by their names, in its units
and order; null where a number is not known.  Where the answer is no success, its message says why, in words.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sq_msgs_py.superquadrics import FIELDS, UINT32, MessageError, SuperquadricArray

_COLUMNS = tuple(column.name for column in fields(SuperquadricArray))
_WHOLE = tuple(name for name, kind in FIELDS if kind == UINT32)


@dataclass(frozen=True, eq=False)
class Answer:
    """The bodies of one image, the frame they are in, the image's stamp, nanoseconds, and a summary."""

    bodies: SuperquadricArray
    frame_id: str
    stamp: int
    words: str


def text_of(bodies: SuperquadricArray, header: Any, words: str) -> str:
    """The message of an answer; ``header`` is that of the cloud."""
    columns = {name: getattr(bodies, name) for name in _COLUMNS}
    return json.dumps(
        {
            "frame_id": header.frame_id,
            "stamp": {"sec": header.stamp.sec, "nanosec": header.stamp.nanosec},
            "words": words,
            "superquadrics": [
                {name: _plain(column[k]) for name, column in columns.items()} for k in range(len(bodies))
            ],
        },
        allow_nan=False,
    )


def from_response(response: Any) -> Answer:
    """The answer in a std_srvs/Trigger response.

    Raises
    ------
    MessageError
        If it was no success, by its words, or is of another service.
    """
    if not response.success:
        raise MessageError(response.message)
    try:
        found = json.loads(response.message)
        rows, stamp = found["superquadrics"], found["stamp"]
        columns = {
            name: np.array([row[name] for row in rows], np.int64 if name in _WHOLE else float)
            for name in _COLUMNS
            if all(name in row for row in rows)  # a node of another version may know less
        }
        nanoseconds = int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])
        return Answer(SuperquadricArray(**columns), str(found["frame_id"]), nanoseconds, str(found["words"]))
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        raise MessageError(f"expected the answer of a ~/recover service: {type(error).__name__}: {error}") from error


def _plain(value: np.ndarray | np.generic) -> Any:
    """Numbers with as many digits as tell one float32 from another; JSON knows neither NaN nor infinity."""
    if isinstance(value, np.ndarray):
        return [_plain(one) for one in value]
    if isinstance(value, np.integer):
        return int(value)
    return float(str(value)) if math.isfinite(value) else None
