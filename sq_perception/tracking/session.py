"""A tracker at work on a stream of frames: an id for every recovered body, and the numbers to publish.

A consumer gets each body in the optical frame of its frame and in the form that continues its track:

| the frame's camera pose | the observation | numbers |
| --- | --- | --- |
| known, or the camera stands still | agrees with its track | those of the track: fused over all frames |
| known, or the camera stands still | is elsewhere, and the track has not followed | its own |
| known, or the camera stands still | spans more than the track's body can show | its own |
| wanted and not known | any | its own; the pose of the frame before is taken to find the ids |

So a body that a hand moves is published no farther from where the frame shows it than four deviations of that one
observation.  A single observation of other sizes in the same place is taken for an error and left out.

Ids count from 1 and are never used again, not after a reset either.  A body that failed has no track; its id is
FIRST_FAILED_ID + its label, which no track reaches.

Metres, radians, seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.tracking import association, state
from sq_perception.tracking.state import LENGTH, Observed
from sq_perception.tracking.tracker import Track, Tracker

FIRST_FAILED_ID = 2**31


@dataclass(frozen=True, eq=False)
class Followed:
    """One body of a frame, as its consumer gets it."""

    id: int  # that of its track
    seen: int  # number of frames that showed the body, this one included
    is_fused: bool  # whether the numbers are the track's; otherwise they are this frame's own
    superquadric: Superquadric  # a single body in the optical frame
    covariance: np.ndarray  # (11, 11), as in Observed; NaN if the observation's is unknown
    cavity: Any = None
    """That of the observation, if it has one; else the one seen last, unless the camera looks into it and sees none."""

    @property
    def sigma_size(self) -> np.ndarray:
        """Standard deviations (3,) of the half sizes, metres; NaN where unknown."""
        return np.sqrt(np.diag(self.covariance)[:3])


@dataclass(frozen=True)
class Tally:
    """The counts of a session."""

    tracks: int = 0  # alive now, hidden ones included
    births: int = 0  # ids given so far
    resets: int = 0  # how often time went back
    without_pose: int = 0  # frames whose camera pose was wanted and not known


class TrackingSession:
    """Follows the bodies of one camera's frames, or of several cameras with known poses."""

    def __init__(self) -> None:
        self._tracker = Tracker()
        self._without_pose: Tracker | None = None
        """What follows frames without a pose, by the last one known: a copy, as where their bodies are is a guess."""
        self._stamp = -np.inf
        self._pose = state.parse_pose(None)
        self._cavities: dict[int, Any] = {}  # the last cavity of each track, in the frame of its body
        self.tally = Tally()  # counts after the last frame; may be read from another thread
        self.tracks: tuple[Track, ...] = ()  # all tracks after the last frame, in the world

    @property
    def hidden(self) -> tuple[int, ...]:
        """Ids of the tracks that the last frame did not show and that are not given up."""
        return tuple(track.id for track in self.tracks if track.observation is None)

    def reset(self) -> None:
        """Forget every body; ids go on."""
        self._tracker_of_poses().reset()
        self._stamp, self._pose = -np.inf, state.parse_pose(None)
        self.tally = replace(self.tally, tracks=0)
        self.tracks = ()

    def follow(
        self, observed: Sequence[Observed], stamp: float, camera_pose: object = None, *, is_pose_known: bool = True,
        camera: Camera | None = None, depth: np.ndarray | None = None,
    ) -> tuple[Followed, ...]:
        """The bodies of another frame, in the order of ``observed``: without failed ones, in the optical frame.  A
        ``stamp`` before the last one, seconds, resets the session.  Of a pose that is not known ``camera_pose`` is not
        looked at.

        Other arguments and errors are those of :meth:`Tracker.update`; after an error nothing has changed, but for a
        reset.
        """
        rotation, position = state.parse_pose(camera_pose) if is_pose_known else self._pose
        is_back = stamp < self._stamp
        if is_back:
            self._tracker_of_poses().reset()  # its own last frame, one with a pose, may be older
        if not is_pose_known and self._without_pose is None:
            self._without_pose = copy(self._tracker)
        tracker = self._tracker_of_poses() if is_pose_known else self._without_pose or self._tracker
        tracks = tracker.update(observed, stamp, (rotation, position), camera=camera, depth=depth)
        resets, without_pose = self.tally.resets + is_back, self.tally.without_pose + (not is_pose_known)
        self.tally = Tally(len(tracks), tracker.births, resets, without_pose)
        self._stamp, self._pose, self.tracks = stamp, (rotation, position), tracks

        back = quaternions.conjugate(rotation)
        matrix = quaternions.to_matrix(back)
        by_index = {track.observation: track for track in tracks}
        here = [by_index[index] for index in range(len(observed))]
        bodies = [track.superquadric.transformed(back, -matrix @ position) for track in here]
        outgrown = _exceed_tracks(bodies, observed)
        found = []
        for track, body, observation, is_outgrown in zip(here, bodies, observed, outgrown, strict=True):
            covariance = state.rotate(track.covariance, matrix)
            is_fused = is_pose_known and track.follows and not is_outgrown
            if not is_fused:
                body, covariance = _rename_axes(body, covariance, observation)
            elif not np.isfinite(observation.covariance).all():
                covariance = np.full((LENGTH, LENGTH), np.nan)
            body = _add_taper(body, observation.superquadric)
            cavity = self._keep_cavity(track.id, body, getattr(observation, "cavity", None))
            found.append(Followed(track.id, track.seen, is_fused, body, covariance, cavity))
        self._cavities = {track.id: self._cavities[track.id] for track in tracks if track.id in self._cavities}
        return tuple(found)

    def _keep_cavity(self, number: int, body: Superquadric, seen: Any) -> Any:
        """The cavity of a body as a frame shows it, or as frames before showed it, moved with the body."""
        turn, place = body.rotation_matrix, body.translation
        if seen is not None:
            self._cavities[number] = replace(seen, rim=(seen.rim - place) @ turn, axis=seen.axis @ turn)
            return seen
        if number not in self._cavities:
            return None
        known = self._cavities[number]
        known = replace(known, rim=place + turn @ known.rim, axis=turn @ known.axis)
        if -(known.axis @ known.rim) > 0.2 * np.linalg.norm(known.rim):  # the camera looks into it
            del self._cavities[number]  # it was closed
            return None
        return known

    def _tracker_of_poses(self) -> Tracker:
        """The tracker of frames with a pose, as it was before those without one, but for what these counted."""
        if self._without_pose is not None:
            self._tracker.take_counts(self._without_pose)
            self._without_pose = None
        return self._tracker


def _add_taper(body: Superquadric, observed: Superquadric) -> Superquadric:
    """An untapered body in the box of the observed one, with its taper where both have the same z axis."""
    turn = np.round(body.rotation_matrix.T @ observed.rotation_matrix)
    if not observed.is_tapered or abs(turn[2, 2]) != 1:
        return body
    return body.with_taper(turn[2, 2] * np.abs(turn[:2, :2]) @ observed.taper)


def _exceed_tracks(bodies: list[Superquadric], observed: Sequence[Observed]) -> np.ndarray:
    """Which observations (n,) have points that span more, along their axes, than their track's body in this frame."""
    if not bodies:
        return np.zeros(0, bool)
    shown = Superquadric.stack([each.superquadric for each in observed])
    spanned = shown.untapered().size * np.stack([each.seen for each in observed])
    wide = Superquadric.stack(bodies).support(np.swapaxes(shown.rotation_matrix, -1, -2))
    # Measured points that span more than this share of a body's width are of a larger one, put in its place while
    # nobody looked. Of household things that stay, one in a hundred spans 1.03 of its track's body and more; of what
    # took another one's place, and kept its id, up to 2.7. Chosen.
    return np.asarray((spanned > 1.2 * wide).any(axis=-1))


def _rename_axes(body: Superquadric, covariance: np.ndarray, observation: Observed) -> tuple[Superquadric, np.ndarray]:
    """The observed body and its covariance, in that of its forms which continues ``body`` with ``covariance``."""
    own = np.asarray(observation.covariance, dtype=float)
    known = np.isfinite(own).all()
    given = own if known else np.zeros((LENGTH, LENGTH))
    seen = observation.superquadric.untapered().to_flat()
    found, changed = association.rename_axes(body.to_flat(), covariance, seen, given)
    return Superquadric.from_flat(found), changed if known else own
