"""Several cameras, one scene: what each knows of a body adds up, as over time.

Each camera sees other sides, so that the common error of a view (:mod:`~sq_perception.tracking.fusion`) is not the same
in any two of them that are more than its angle apart.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.tracking.state import Observed
from sq_perception.tracking.tracker import Track, Tracker


class View(NamedTuple):
    """What one camera shows."""

    bodies: Iterable[Observed]
    """In its optical frame, without failed ones: :attr:`~sq_perception.recovery.recoverer.FrameRecovery.recovered`."""
    pose: object
    """Camera in the world that all share: 4 x 4, or (quaternion x y z w, translation)."""
    camera: Camera | None = None
    depth: np.ndarray | None = None
    """(height, width), metres; with it, a body counts as missing only where this camera sees through its place."""


def fuse_views(views: Iterable[View]) -> tuple[Track, ...]:
    """Every body of a scene that rests while all views are taken, in the world; a ValueError as from the tracker.

    ``seen`` of a track is the number of views that showed it.  Bodies that overlap are one: a wrong pose, by more than
    half a body, makes two of one.
    """
    tracker, tracks = Tracker(), tuple[Track, ...]()
    for view in views:
        tracks = tracker.update(tuple(view.bodies), 0.0, view.pose, camera=view.camera, depth=view.depth)
    return tracks
