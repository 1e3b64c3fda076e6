"""Bodies followed from frame to frame.

Observations come in the optical frame, with the pose of the camera in the world where it moves; tracks live in the
world frame.  A frame is dealt with in this order:

1. Tracks are predicted: at rest with a slow drift, or with their velocity where they were seen to move.
2. Observations are assigned (:mod:`~sq_perception.tracking.association`) in the form that continues the track
   (:mod:`~sq_perception.tracking.forms`).
3. An observation that agrees with its track is fused (:mod:`~sq_perception.tracking.fusion`).  One that does not agree
   counts little; where several in a row disagree in the pose alone, the body has moved: its pose starts again, its
   sizes and exponents are kept.  Where they disagree otherwise, the track is doubted too and learns anew.  An answer
   that repeats an earlier one shows that a body at rest is still there, and no more.
4. Observations without a track start one; ids are never used again.
5. A track without observation is kept while it is hidden (:mod:`~sq_perception.tracking.sight`), and dies after a
   number of frames in which it should have been seen, or in which another body was seen in its place.

Metres, radians, seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.tracking import agreement, association, fusion, sight, state
from sq_perception.tracking.agreement import STILL_SHARE
from sq_perception.tracking.association import Pairs
from sq_perception.tracking.fusion import Views
from sq_perception.tracking.state import CENTRE, LENGTH, POSE, TURN, Observed
from sq_perception.tracking.track import Track, TrackState

__all__ = ["Track", "TrackState", "Tracker"]

COMMON_SHARE, LASTING_SHARE = 0.25, 0.25
"""rho and gamma, the shares of an observation's covariance that all views from one direction, and all views, have in
common.  Chosen; benchmarks/tracking.py finds half of a view's error to be the same over all frames."""
LEAST = state.diagonal(0.01, 0.02, 0.001, 0.01)
"""F, the least common error of a view.  Chosen: 1 % in size, a millimetre, half a degree."""
UNKNOWN = 0.15, 0.2, 0.15, 0.2
"""Deviations (log sizes, exponents, centre as a share of the mean half size, turn) of observations without covariance.
Chosen: errors of the classic fit and of the network alone on household things are of this order."""
DRIFT = state.diagonal(0.0, 0.0, 0.001, 0.01)
"""Random walk of a body at rest in a second: a millimetre, and 0.6 degrees.  Chosen."""
PATIENCE = 2
"""After so many disagreeing observations in a row the track gives way: the second may not be chance any more."""
FASTEST = 1.0
"""Metres per second: how far a body may have been moved between two frames.  A hand that sets things down."""
CONFIRM_AFTER = 3
"""Observations until a track is confirmed: one more than ``PATIENCE``.  Chosen."""
MISSES = 5
"""A confirmed track dies in the so-manieth frame in a row that should have shown it; a tentative one in the second.
Chosen: a sixth of a second of a camera at 30 Hz."""
FORGET_POSE_AFTER, FORGET_AFTER = 5.0, 30.0
"""Seconds without observation until a body may be anywhere within reach, and until it is given up.  Chosen."""
MOST = 100
"""Tracks that are kept; beyond them those die first that were not observed for longest.  Bounds the time of a frame."""
_RESTART = 3.0
"""A restarted pose is unsure by this many times the displacement.  Chosen."""
_MOTION_SHARE = 0.5
"""Standard deviation of a predicted motion, as a share of it: hands speed up and stop.  Chosen."""
_MOVING_TURN = 0.3
"""Radians in a second that a moving body may turn, standard deviation.  Chosen."""
_COASTING = 1.0
"""Seconds: so long an unseen body is taken to go on as it was seen to move.  Chosen."""
_UNPLACED = 1.0
"""Metres and radians: deviation of a pose that is forgotten, farther than things are carried."""


@dataclass(eq=False)
class _Body:
    """What is kept of one track; state and covariance are those of :mod:`sq_perception.tracking.state`."""

    id: int
    state: np.ndarray
    covariance: np.ndarray
    lasting: np.ndarray
    """M: of the error that all views have in common; ``covariance`` is without it."""
    views: Views
    last: float
    agreed: float
    """Stamp of the last observation that the centre follows."""
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    seen: int = 1
    disagreed: int = 0
    strayed: np.ndarray = field(default_factory=lambda: np.zeros(LENGTH))
    """The last observation's error if it disagreed."""
    jumps: int = 0
    """Observations in a row that were found elsewhere."""
    missed: int = 0
    observation: int | None = None
    follows: bool = False

    @property
    def is_moving(self) -> bool:
        return bool(self.velocity.any())


class Tracker:
    """Follows bodies; one call of :meth:`update` for each frame."""

    def __init__(self) -> None:
        self._bodies: list[_Body] = []
        self._stamp: float | None = None
        self._next_id = 1

    @property
    def births(self) -> int:
        """Ids given so far."""
        return self._next_id - 1

    def reset(self) -> None:
        """Forget every body; ids go on."""
        self._bodies, self._stamp = [], None

    def skip_ids(self, births: int) -> None:
        """Give none of so many first ids any more: another tracker, begun as a copy, has."""
        self._next_id = max(self._next_id, births + 1)

    def update(
        self,
        recoveries: Sequence[Observed],
        stamp: float,
        camera_pose: object = None,
        *,
        camera: Camera | None = None,
        depth: np.ndarray | None = None,
    ) -> tuple[Track, ...]:
        """The tracks after another frame, oldest first.

        Parameters
        ----------
        recoveries
            Bodies of the frame in the optical frame, without failed ones, of pieces in one place the most important
            first: :attr:`~sq_perception.recovery.recoverer.FrameRecovery.recovered`.
        stamp
            Seconds; a stamp before the last one resets the tracker.
        camera_pose
            Camera in the world: 4 x 4, or (quaternion x y z w, translation).  None: the camera is the world.
        camera : Camera, optional
        depth : float (height, width), optional
            The frame's depth image, metres, NaN invalid.  With it, and the camera, only bodies that the image sees
            through count as missed; without it all that were not observed.

        Raises
        ------
        ValueError
            For a stamp that is not finite, a pose that is no rigid motion, a covariance of another shape than (11, 11),
            a depth image without camera or of another size.
        """
        if not np.isfinite(stamp):
            raise ValueError(f"stamp: expected a finite number of seconds, got {stamp}")
        if depth is not None:
            if camera is None:
                raise ValueError("depth: expected its camera along with it")
            camera.check_image(depth)
        rotation, position = state.as_pose(camera_pose)
        orthographic = camera is not None and not camera.is_pinhole
        observed, covariance = self._in_world(recoveries, rotation, position)

        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        self._predict(stamp)
        self._stamp = stamp

        expected = partial(sight.expected, camera=camera, depth=depth, rotation=rotation, position=position)
        pairs, missing = self._pairs(observed, covariance, stamp, expected)
        to_camera = sight.towards(observed[:, 5:8], rotation, position, orthographic)
        taken = set(pairs.observed.tolist())
        self._fuse(self._without_repeats(pairs, recoveries, stamp), to_camera, stamp)
        for j in range(len(observed)):
            if j not in taken:
                self._begin(j, observed[j], covariance[j], to_camera[j], stamp)
        self._miss(missing, stamp)
        return tuple(_published(body) for body in self._bodies)

    def _in_world(
        self, recoveries: Sequence[Observed], rotation: np.ndarray, position: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """States (m, 12) and covariances (m, 11, 11) of what was observed."""
        if not len(recoveries):
            return np.zeros((0, 12)), np.zeros((0, LENGTH, LENGTH))
        for body in recoveries:
            if not isinstance(body.superquadric, Superquadric) or body.superquadric.batch_shape:
                raise ValueError("recoveries: expected a single body in each")
            if np.shape(body.covariance) != (LENGTH, LENGTH):
                raise ValueError(f"covariance: expected shape (11, 11), got {np.shape(body.covariance)}")
        flat = np.array([body.superquadric.to_flat() for body in recoveries], dtype=float)
        covariance = state.to_log(np.array([body.covariance for body in recoveries], dtype=float), flat[:, 0:3])
        unknown = ~np.isfinite(covariance).all(axis=(1, 2))
        if unknown.any():
            log_size, shape, centre, turn = UNKNOWN
            for k in np.flatnonzero(unknown):
                covariance[k] = state.diagonal(log_size, shape, centre * float(flat[k, 0:3].mean()), turn)
        matrix = quaternions.to_matrix(rotation)
        flat[:, 5:8] = flat[:, 5:8] @ matrix.T + position
        flat[:, 8:12] = quaternions.multiply(rotation, flat[:, 8:12])
        return flat, state.turned(covariance, matrix)

    def _predict(self, stamp: float) -> None:
        elapsed = 0.0 if self._stamp is None else stamp - self._stamp
        for body in self._bodies:
            variance = np.diag(DRIFT) * elapsed
            if stamp - body.last > _COASTING:
                body.velocity = np.zeros(3)
            if body.is_moving:
                step = body.velocity * elapsed
                body.state = body.state.copy()
                body.state[5:8] += step
                variance[CENTRE] += _MOTION_SHARE**2 * (step @ step)
                variance[TURN] += _MOVING_TURN**2 * min(elapsed, 1.0)
            if stamp - body.last > FORGET_POSE_AFTER:
                variance[POSE] += _UNPLACED**2
            body.covariance = body.covariance + np.diag(variance)
            body.observation = None

    def _pairs(
        self,
        observed: np.ndarray,
        covariance: np.ndarray,
        stamp: float,
        expected: Callable[[np.ndarray], np.ndarray],
    ) -> tuple[Pairs, set[int]]:
        """In place first, then what was moved; and the ids of tracks that should have been in place and were not."""
        if not self._bodies:
            return Pairs.none(), set()
        states, covariances = self._stacked(self._bodies)
        covariances = covariances + LEAST
        here = association.in_place(states, covariances, observed, covariance)
        left = np.setdiff1d(np.arange(len(states)), here.track)
        new = np.setdiff1d(np.arange(len(observed)), here.observed)
        open_place = expected(states[left])
        missing = {self._bodies[k].id for k, visible in zip(left, open_place, strict=True) if visible}
        # What is hidden has rather stayed where it was than become one more body of its kind far away.
        free = np.array([visible or self._bodies[k].is_moving for k, visible in zip(left, open_place, strict=True)])
        reach = FASTEST * np.array([stamp - self._bodies[k].last for k in left])
        reach = np.where(free, reach, np.minimum(reach, 2 * states[left, 0:3].max(axis=1)))
        there = association.elsewhere(states[left], covariances[left], reach, observed[new], covariance[new])
        there = there._replace(track=left[there.track], observed=new[there.observed])
        for k in here.track:
            self._bodies[k].jumps = 0
        for k in there.track:
            # Its sizes and exponents were found elsewhere: nothing more has to be waited for.
            self._bodies[k].jumps += 1
            self._bodies[k].disagreed = max(self._bodies[k].disagreed, PATIENCE)
        return here + there, missing

    def _without_repeats(self, pairs: Pairs, recoveries: Sequence[Observed], stamp: float) -> Pairs:
        """The pairs that are to be fused: those of old answers only where these do not say what was fused before, of a
        body that moves, or where the camera's pose was corrected or the first one was never seen."""
        if not len(pairs.track):
            return pairs
        new = np.ones(len(pairs.track), dtype=bool)
        agrees = self._compared(pairs)[2].agrees
        for k, (track, index) in enumerate(zip(pairs.track, pairs.observed, strict=True)):
            body = self._bodies[track]
            if recoveries[index].repeats == 0 or body.is_moving or body.jumps > 0 or not agrees[k]:
                continue
            new[k] = False
            body.seen, body.missed, body.last, body.observation = body.seen + 1, 0, stamp, int(index)
            if body.follows:
                body.agreed = stamp
        return Pairs(*(part[new] for part in pairs))

    def _compared(self, pairs: Pairs) -> tuple[np.ndarray, np.ndarray, agreement.Agreement]:
        """Covariances (n, 11, 11) and errors (n, 11) of what was observed beside the tracks, and whether they agree."""
        states, covariances = self._stacked([self._bodies[k] for k in pairs.track])
        total, error = covariances + pairs.covariance + LEAST, state.difference(states, pairs.state)
        return total, error, agreement.compared(states[:, 0:3], total, error)

    def _fuse(self, pairs: Pairs, to_camera: np.ndarray, stamp: float) -> None:
        if not len(pairs.track):
            return
        some = [self._bodies[k] for k in pairs.track]
        states, covariances = self._stacked(some)
        common = COMMON_SHARE * pairs.covariance + LEAST
        white = (1 - COMMON_SHARE - LASTING_SHARE) * pairs.covariance
        whole = pairs.covariance + LEAST
        total, error, verdict = self._compared(pairs)
        turning = np.zeros(len(some), dtype=bool)
        for k, body in enumerate(some):
            agrees, slid, turned = verdict.agrees[k], verdict.slid[k], verdict.turned[k]
            body.disagreed = 0 if agrees else body.disagreed + 1
            impatient = body.disagreed > 0 and (body.is_moving or body.disagreed >= PATIENCE)
            if not body.is_moving and body.jumps == 0:
                # What moves strays to the same side again; errors larger than their covariance do so seldom.
                slid = slid and agreement.same_side(body.strayed[CENTRE], error[k, CENTRE])
                turned = turned and agreement.same_side(body.strayed[TURN], error[k, TURN])
            body.strayed = np.zeros(LENGTH) if agrees else error[k]
            if impatient and verdict.fits[k] and (slid or turned):
                turning[k] = turned
                variance = np.zeros(LENGTH)
                variance[CENTRE] = (_RESTART * np.linalg.norm(error[k, CENTRE])) ** 2 if slid else 0.0
                variance[TURN] = (_RESTART * np.linalg.norm(error[k, TURN])) ** 2 if turned else 0.0
                covariances[k] += np.diag(variance)
            else:
                # One stray observation is doubted itself; of several in a row, both sides are.
                white[k] += (verdict.excess[k] - 1) * whole[k]
                if body.disagreed >= PATIENCE:
                    covariances[k] *= verdict.excess[k]
            self._follow(body, error[k, CENTRE], slid and impatient, stamp, total[k, CENTRE, CENTRE])
            if agrees or impatient:
                body.agreed = stamp

        after, covariances, lasting, views = fusion.fused(
            states,
            covariances,
            np.array([body.lasting for body in some]),
            Views.stack([body.views for body in some]),
            pairs.state,
            white,
            common,
            fusion.root(LASTING_SHARE * pairs.covariance),
            to_camera[pairs.observed],
            turning,
        )
        strays = agreement.compared(after[:, 0:3], whole, state.difference(after, pairs.state))
        for k, body in enumerate(some):
            body.state, body.covariance, body.lasting, body.views = after[k], covariances[k], lasting[k], views[k]
            body.seen, body.missed, body.last = body.seen + 1, 0, stamp
            body.observation = int(pairs.observed[k])
            insists = body.disagreed >= PATIENCE and not strays.fits[k]
            body.follows = not (strays.slid[k] or strays.turned[k] or insists)

    def _follow(self, body: _Body, error: np.ndarray, slid: bool, stamp: float, covariance: np.ndarray) -> None:
        """The velocity after an observation of the centre, ``error`` (3,) off its prediction."""
        elapsed = stamp - body.agreed
        if elapsed <= 0:
            return
        if body.is_moving:
            velocity = body.velocity + 0.5 * error / elapsed
            noise = float(np.sqrt(np.trace(covariance)))
            still = max(STILL_SHARE * float(body.state[0:3].mean()), 0.5 * noise)
            body.velocity = velocity if np.linalg.norm(velocity) * elapsed > still else np.zeros(3)
        elif slid and body.jumps != 1:
            velocity = error / elapsed
            body.velocity = velocity * min(1.0, FASTEST / float(np.linalg.norm(velocity)))

    def _begin(self, index: int, observed: np.ndarray, covariance: np.ndarray, view: np.ndarray, stamp: float) -> None:
        whole, views = (1 - LASTING_SHARE) * covariance + LEAST, Views.none()
        lasting = fusion.root(LASTING_SHARE * covariance)
        views.direction[0] = quaternions.to_matrix(observed[8:12]).T @ view
        views.bias[0] = views.correlation[0] = COMMON_SHARE * covariance + LEAST
        views.used[0] = 0
        born = _Body(self._next_id, observed, whole, lasting, views, stamp, stamp)
        born.observation, born.follows = index, True
        self._next_id += 1
        self._bodies.append(born)

    def _miss(self, missing: set[int], stamp: float) -> None:
        """Count misses of what should have been seen, and bury the dead."""
        dead = set()
        ousted = self._ousted()
        for body in self._bodies:
            if body.observation is not None:
                continue
            body.missed = body.missed + 1 if body.id in missing | ousted else 0
            patience = MISSES if body.seen >= CONFIRM_AFTER else 1 if body.id in ousted else 2
            if body.missed >= patience or stamp - body.last > FORGET_AFTER:
                dead.add(body.id)
        left = [body for body in self._bodies if body.id not in dead]
        if len(left) > MOST:
            unseen = sorted((body for body in left if body.observation is None), key=lambda body: body.last)
            dead |= {body.id for body in unseen[: len(left) - MOST]}
        self._bodies = [body for body in self._bodies if body.id not in dead]

    def _ousted(self) -> set[int]:
        """Ids of bodies that were not observed and whose place another one takes that was."""
        if all(body.observation is not None for body in self._bodies):
            return set()
        seen = np.array([body.observation is not None for body in self._bodies])
        overlap = association.twins(self._stacked(self._bodies)[0])
        ousted = ~seen & ((overlap | overlap.T) & seen).any(axis=1)
        return {self._bodies[k].id for k in np.flatnonzero(ousted)}

    @staticmethod
    def _stacked(some: list[_Body]) -> tuple[np.ndarray, np.ndarray]:
        return np.array([body.state for body in some]), np.array([body.covariance for body in some])


def _published(body: _Body) -> Track:
    covariance = state.from_log(body.covariance + body.lasting @ body.lasting.T, body.state[0:3])
    known = TrackState.CONFIRMED if body.seen >= CONFIRM_AFTER else TrackState.TENTATIVE
    return Track(
        id=body.id,
        superquadric=Superquadric.from_flat(body.state.copy()),
        sigma_size=np.sqrt(np.diag(covariance)[0:3]),
        covariance=covariance,
        velocity=body.velocity.copy(),
        seen=body.seen,
        state=known if body.observation is not None else TrackState.LOST,
        observation=body.observation,
        follows=body.follows and body.observation is not None,
    )
