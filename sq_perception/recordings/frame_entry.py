"""One recorded frame and what was recovered from it, as an element of ``frames`` in the JSON of ``recover``.

Coordinates are metres in the optical frame, or those of the unit cube.  ``result.schema.json`` explains every
name.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from sq_perception.fitting.fit import Status
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Followed


def frame_entry(
    file: str,
    frame: RecordedFrame,
    recovery: FrameRecovery,
    tracks: Sequence[Followed] | None,
    has_masks: bool,
) -> dict[str, Any]:
    """The element; ``tracks`` are those of the bodies that did not fail, None without tracking.

    ``has_masks``: whether labels are those of masks that came with the frame.
    """
    bodies, left = [], iter(tracks or ())
    for body in recovery.bodies:
        track = None if body.status == Status.FAILED else next(left, None)
        superquadric = in_result_frame(body.superquadric, frame.is_cube)
        bodies.append(
            {
                **_parameters(superquadric),
                "score": _number(body.score),
                "residual": _number(body.residual),
                "sigma_size": _numbers(body.sigma_size),
                "seen": _numbers(body.seen),
                "status": body.status.name.lower(),
                "message": body.message,
                "label": int(body.label) if has_masks else None,
                "pixels": int(body.pixels),
                "track": None if track is None else _track_entry(track, frame.is_cube),
            }
        )
    return {
        "file": file,
        "ms": _number(recovery.milliseconds["total"]),
        "superquadrics": bodies,
        "coordinates": "cube" if frame.is_cube else "optical",
        "camera": {
            "projection": frame.camera.projection,
            "width": frame.camera.width,
            "height": frame.camera.height,
            "K": _numbers(frame.camera.matrix.ravel()),
        },
        "message": recovery.message,
        "ms_by_stage": {stage: _number(value) for stage, value in recovery.milliseconds.items()},
        "plane": None if recovery.plane is None else _numbers(recovery.plane),
        "stamp": None if frame.stamp is None else frame.stamp._asdict(),
        "topic": frame.topic or None,
        "frame_id": frame.frame_id or None,
    }


def _track_entry(track: Followed, is_cube: bool) -> dict[str, Any]:
    body = track.superquadric
    if is_cube:
        body = unit_cube.cube_from_optical(body)  # not its canonical form: the track keeps its own
    return {
        "id": track.id,
        "seen": track.seen,
        "fused": track.is_fused,
        **_parameters(body),
        "sigma_size": _numbers(track.sigma_size),
    }


def in_result_frame(body: Superquadric, is_cube: bool) -> Superquadric:
    """A body in the coordinates that results are given in."""
    return unit_cube.cube_from_optical(body).canonical_form() if is_cube else body


def _parameters(body: Superquadric) -> dict[str, list[float | None]]:
    return {name: _numbers(getattr(body, name)) for name in ("size", "shape", "translation", "rotation")}


def _numbers(values: Iterable[float]) -> list[float | None]:
    return [_number(value) for value in values]


def _number(value: float) -> float | None:
    """JSON knows neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None
