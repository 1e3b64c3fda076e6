"""Bodies followed from frame to frame.

Observations come in the optical frame with the pose of the camera in the world; tracks live in the world.  A frame:

1. Prediction: a body rests, with a slow drift, or keeps the velocity that it was seen to have.
2. Association, in the form that continues the track (:mod:`~sq_perception.tracking.association`).
3. Fusion (:mod:`~sq_perception.tracking.fusion`) where both agree.  A single observation that disagrees counts little.
   After several in a row that disagree in the pose alone the body has moved, its pose starts again, its sizes and
   exponents are kept.  Where they disagree otherwise, the track is doubted too.  An answer that repeats an earlier one
   shows that a body at rest is still there, and no more.
4. Birth: observations without a track start one; ids are never used again.
5. Death: after some frames in a row in which a body should have been seen (:mod:`~sq_perception.tracking.visibility`)
   or another one was seen in its place.  Hidden bodies are kept for a while.

Metres, radians, seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.tracking import association, fusion, state, visibility
from sq_perception.tracking.association import Pairs
from sq_perception.tracking.fusion import Estimate, Observation
from sq_perception.tracking.state import CENTRE, HAND, LENGTH, TURN, Observed
from sq_perception.tracking.track import CONFIRM_AFTER, Body, Track, TrackState, stack

__all__ = ["Track", "TrackState", "Tracker"]

COMMON_SHARE, LASTING_SHARE = 0.25, 0.25
"""rho and gamma, the shares of an observation's covariance that views from one direction, and all views, have in
common.  Chosen; benchmarks/tracking.py finds half of a view's error to be the same over all frames."""
PREDICTED_SHARE = 0.6  # gamma of bodies beside a predicted hull, which errs alike in all frames
LEAST = state.diagonal(0.01, 0.02, 0.001, 0.01)
"""F, the least common error of a view, of sizes as a share.  Chosen: 1 % in size, a millimetre, half a degree."""
PATIENCE = 2
"""After so many disagreeing observations in a row the track gives way: the second may not be chance any more."""
FORGET_AFTER = 30.0  # seconds without observation until a body is given up.  Chosen.
MOST = 100
"""Tracks that are kept; beyond them those die first that were not observed for longest.  Bounds the time of a frame."""
_Bodies = tuple[Body, ...]


class _Frame(NamedTuple):
    """m observations in the world: states (m, 12), covariances (m, 11, 11), gamma (m,), directions to the camera
    (m, 3), and which repeat an earlier answer (m,)."""

    stamp: float
    state: np.ndarray
    covariance: np.ndarray
    gamma: np.ndarray
    direction: np.ndarray
    repeats: np.ndarray

    def observe(self, pairs: Pairs) -> Observation:
        """The parts of the errors of some observations, in the forms of their tracks."""
        # Share of F that is new in every observation: of exact ones, such as a simulator's, S has no inverse without
        # it.
        least_white = 1e-6
        gamma, least = self.gamma[pairs.observed, None, None], _least(pairs.state)
        return Observation(
            pairs.state, (1 - COMMON_SHARE - gamma) * pairs.covariance + least_white * least,
            COMMON_SHARE * pairs.covariance + (1 - least_white) * least, gamma * pairs.covariance,
            self.direction[pairs.observed],
        )


class Tracker:
    """Follows bodies; one call of :meth:`update` for each frame.  What it knows between two frames is frozen: a copy of
    it goes on by itself."""

    def __init__(self) -> None:
        self._bodies: _Bodies = ()
        self._stamp: float | None = None
        self.births = 0  # ids given so far

    def reset(self) -> None:
        """Forget every body; ids go on."""
        self._bodies, self._stamp = (), None

    def take_counts(self, other: Tracker) -> None:
        """Take over what another tracker, begun as a copy, has counted: ids, and observations."""
        seen = {body.id: body.seen for body in other._bodies}
        self._bodies = tuple(replace(body, seen=max(body.seen, seen.get(body.id, 0))) for body in self._bodies)
        self.births = max(self.births, other.births)

    def update(
        self, recoveries: Sequence[Observed], stamp: float, camera_pose: object = None, *, camera: Camera | None = None,
        depth: np.ndarray | None = None,
    ) -> tuple[Track, ...]:
        """The tracks after another frame, oldest first.

        Parameters
        ----------
        recoveries
            Bodies of the frame in the optical frame, without failed ones:
            :attr:`~sq_perception.recovery.recoverer.FrameRecovery.recovered`.
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
            a depth image without camera, of another size or not of floats.
        """
        if not np.isfinite(stamp):
            raise ValueError(f"stamp: expected a finite number of seconds, got {stamp}")
        if depth is not None:
            if camera is None:
                raise ValueError("depth: expected its camera along with it")
            depth = camera.readings(depth)
        rotation, position = state.parse_pose(camera_pose)
        orthographic = camera is not None and not camera.is_pinhole
        frame = _to_world(recoveries, stamp, rotation, position, orthographic)

        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        elapsed = 0.0 if self._stamp is None else stamp - self._stamp
        bodies = tuple(body.predict(elapsed, stamp) for body in self._bodies)
        states, covariances = stack(bodies)
        here = association.pairs_in_place(states, covariances + _least(states), frame.state, frame.covariance)
        missing = np.ones(len(bodies), dtype=bool)
        missing[here.track] = False
        missing[missing] = visibility.is_missing(states[missing], camera, depth, rotation, position)
        there = _pairs_elsewhere(bodies, frame, here, missing)
        pairs = here + there
        bodies, pairs_left = _see_again(_count_jumps(bodies, here, there), pairs, frame)
        bodies = _fuse(bodies, pairs_left, frame)
        new = np.delete(np.arange(len(recoveries)), pairs.observed)
        bodies += tuple(_birth(self.births + n, int(k), frame) for n, k in enumerate(new, 1))
        missing = np.append(missing, np.zeros(len(new), dtype=bool))
        self._bodies, self._stamp, self.births = _survivors(bodies, missing, stamp), stamp, self.births + len(new)
        return tuple(body.publish() for body in self._bodies)


def _to_world(
    recoveries: Sequence[Observed], stamp: float, rotation: np.ndarray, position: np.ndarray, orthographic: bool
) -> _Frame:
    for body in recoveries:
        if not isinstance(body.superquadric, Superquadric) or body.superquadric.batch_shape:
            raise ValueError("recoveries: expected a single body in each")
        if np.shape(body.covariance) != (LENGTH, LENGTH):
            raise ValueError(f"covariance: expected shape (11, 11), got {np.shape(body.covariance)}")
    flat = np.array([body.superquadric.untapered().to_flat() for body in recoveries], dtype=float).reshape(-1, 12)
    covariance = np.array([body.covariance for body in recoveries], dtype=float).reshape(-1, LENGTH, LENGTH)
    for k in np.flatnonzero(~np.isfinite(covariance).all(axis=(1, 2))):
        # Chosen: errors of the classic fit and of the network alone on household things are of this order.
        shares = state.diagonal(0.15, 0.2, 0.15 * float(flat[k, 0:3].mean()), 0.2)
        covariance[k] = state.scale_sizes(shares, flat[k, 0:3])
    matrix = quaternions.to_matrix(rotation)
    flat[:, 5:8] = flat[:, 5:8] @ matrix.T + position
    flat[:, 8:12] = quaternions.multiply(rotation, flat[:, 8:12])
    return _Frame(
        stamp, flat, state.rotate(covariance, matrix),
        np.array([PREDICTED_SHARE if body.is_predicted else LASTING_SHARE for body in recoveries]),
        visibility.directions(flat[:, 5:8], rotation, position, orthographic),
        np.array([body.repeats > 0 for body in recoveries], dtype=bool),
    )


def _pairs_elsewhere(bodies: _Bodies, frame: _Frame, here: Pairs, missing: np.ndarray) -> Pairs:
    """Pairs of what was not found in place; a hidden body has rather stayed than gone far to where its like is seen."""
    left = np.delete(np.arange(len(bodies)), here.track)
    new = np.delete(np.arange(len(frame.state)), here.observed)
    if not (len(left) and len(new)):
        return Pairs.none()
    absent = [bodies[k] for k in left]
    states, covariances = stack(absent)
    reach = HAND * np.array([frame.stamp - body.agreed for body in absent])
    is_free = missing[left] | np.array([body.is_moving for body in absent], dtype=bool)
    reach = np.where(is_free, reach, np.minimum(reach, 2 * states[:, 0:3].max(axis=1)))
    there = association.pairs_elsewhere(
        states, covariances + _least(states), reach, frame.state[new], frame.covariance[new]
    )
    return there._replace(track=left[there.track], observed=new[there.observed])


def _count_jumps(bodies: _Bodies, here: Pairs, there: Pairs) -> _Bodies:
    """The bodies with how often in a row they were found elsewhere; these need not be waited for: they are alike."""
    after = list(bodies)
    for k in here.track:
        after[k] = replace(after[k], jumps=0)
    for k in there.track:
        after[k] = replace(after[k], jumps=after[k].jumps + 1, disagreed=max(after[k].disagreed, PATIENCE))
    return tuple(after)


def _see_again(bodies: _Bodies, pairs: Pairs, frame: _Frame) -> tuple[_Bodies, Pairs]:
    """The bodies after answers that repeat earlier ones, and the pairs left to be fused: those of bodies that move,
    were found elsewhere, or disagree, as after a correction of the camera's pose."""
    if not frame.repeats[pairs.observed].any():
        return bodies, pairs
    agrees = _compare(bodies, pairs)[2].agrees
    rests = np.array([not body.is_moving and body.jumps == 0 for body in (bodies[k] for k in pairs.track)])
    is_old = frame.repeats[pairs.observed] & agrees & rests
    after, old = list(bodies), pairs.at(is_old)
    for k, index in zip(old.track, old.observed, strict=True):
        after[k] = after[k].see_again(int(index), frame.stamp)
    return tuple(after), pairs.at(~is_old)


def _compare(bodies: _Bodies, pairs: Pairs) -> tuple[np.ndarray, np.ndarray, association.Agreement]:
    """S (n, 11, 11), errors (n, 11) and agreement of what was observed against the tracks."""
    states, covariances = stack([bodies[k] for k in pairs.track])
    total, error = covariances + pairs.covariance + _least(states), state.difference(states, pairs.state)
    return total, error, association.compare(states[:, 0:3], total, error)


def _fuse(bodies: _Bodies, pairs: Pairs, frame: _Frame) -> _Bodies:
    """The bodies after the observations of pairs."""
    if not len(pairs.track):
        return bodies
    seen, whole = frame.observe(pairs), pairs.covariance + _least(pairs.state)
    estimate = Estimate.stack(bodies[k].estimate for k in pairs.track)
    some, turning = _doubt(bodies, pairs, estimate.covariance, seen.white, whole, frame.stamp)
    estimate = fusion.update(estimate, seen, turning)
    after = list(bodies)
    rest = association.compare(estimate.state[:, 0:3], whole, state.difference(estimate.state, pairs.state))
    for k, body in enumerate(some):
        insists = body.disagreed >= PATIENCE and not rest.fits[k]
        after[pairs.track[k]] = replace(
            body, estimate=estimate.at(k), seen=body.seen + 1, missed=0, last=frame.stamp,
            observation=int(pairs.observed[k]), follows=not (rest.slid[k] or rest.turned[k] or insists),
        )
    return tuple(after)


def _doubt(
    bodies: _Bodies, pairs: Pairs, covariances: np.ndarray, white: np.ndarray, whole: np.ndarray, stamp: float
) -> tuple[list[Body], np.ndarray]:
    """The bodies of pairs with what observations show of motion and doubt, and which turn, bool (n,).  Where one
    disagrees, the tracks' covariances and its ``white`` one grow, in place; ``whole`` are with the least error."""
    some = [bodies[k] for k in pairs.track]
    total, error, verdict = _compare(bodies, pairs)
    turning = np.zeros(len(some), dtype=bool)
    for k, body in enumerate(some):
        agrees, slid, turned = verdict.agrees[k], verdict.slid[k], verdict.turned[k]
        disagreed = 0 if agrees else body.disagreed + 1
        is_out_of_patience = disagreed > 0 and (body.is_moving or disagreed >= PATIENCE)
        if not body.is_moving and body.jumps == 0:
            # What moves errs to the same side again; errors larger than their covariance do so seldom.
            slid = slid and association.is_same_side(body.last_error[CENTRE], error[k, CENTRE])
            turned = turned and association.is_same_side(body.last_error[TURN], error[k, TURN])
        if is_out_of_patience and verdict.fits[k] and (slid or turned):
            turning[k] = turned
            for part, has_moved in ((CENTRE, slid), (TURN, turned)):
                variance = error[k, part] @ error[k, part] if has_moved else 0.0
                covariances[k, part, part] += variance * np.eye(3)
        else:
            # One stray observation is doubted itself; of several in a row, both sides are.
            white[k] += (verdict.excess[k] - 1) * whole[k]
            if disagreed >= PATIENCE:
                covariances[k] *= verdict.excess[k]
        some[k] = replace(
            body, disagreed=disagreed, last_error=np.zeros(LENGTH) if agrees else error[k],
            velocity=_velocity(body, error[k, CENTRE], slid and is_out_of_patience, stamp, total[k, CENTRE, CENTRE]),
            agreed=stamp if agrees or is_out_of_patience else body.agreed,
        )
    return some, turning


def _velocity(body: Body, error: np.ndarray, slid: bool, stamp: float, covariance: np.ndarray) -> np.ndarray:
    """The velocity (3,) after an observation of the centre, ``error`` (3,) off its prediction."""
    elapsed = stamp - body.agreed
    if elapsed <= 0:
        return body.velocity
    if body.is_moving:
        velocity = body.velocity + 0.5 * error / elapsed
        is_noise = np.linalg.norm(velocity) * elapsed < 0.5 * np.sqrt(np.trace(covariance))
        return np.zeros(3) if is_noise else velocity
    if slid and body.jumps != 1:
        velocity = error / elapsed
        return velocity * min(1.0, HAND / float(np.linalg.norm(velocity)))
    return body.velocity


def _least(states: np.ndarray) -> np.ndarray:
    """F (..., 11, 11) of states (..., 12)."""
    return state.scale_sizes(LEAST, states[..., 0:3])


def _birth(number: int, index: int, frame: _Frame) -> Body:
    one = np.array([index])
    seen = frame.observe(Pairs(one, one, frame.state[one], frame.covariance[one]))
    estimate = Estimate.first(Observation(*(part[0] for part in seen)))
    return Body(number, estimate, last=frame.stamp, agreed=frame.stamp, observation=index)


def _survivors(bodies: _Bodies, missing: np.ndarray, stamp: float) -> _Bodies:
    """The bodies, with their misses counted, without the dead; ``missing`` (n,) should have been seen."""
    seen = np.array([body.observation is not None for body in bodies], dtype=bool)
    if seen.all():
        return bodies
    states, _ = stack(bodies)
    ousted = np.zeros(len(bodies), dtype=bool)
    ousted[~seen] = (association.separation(states[~seen], states[seen]) < association.DEEP).any(axis=1)
    left = []
    for k, body in enumerate(bodies):
        if not seen[k]:
            missed = body.missed + 1 if missing[k] or ousted[k] else 0
            # Frames in a row that should have shown it after which a confirmed track dies; a tentative one after two.
            # Chosen: a sixth of a second at 30 Hz.
            patience = 5 if body.seen >= CONFIRM_AFTER else 1 if ousted[k] else 2
            if missed >= patience or stamp - body.last > FORGET_AFTER:
                continue
            body = replace(body, missed=missed)
        left.append(body)
    hidden = sorted((body for body in left if body.observation is None), key=lambda body: body.last)
    dead = {body.id for body in hidden[: max(0, len(left) - MOST)]}
    return tuple(body for body in left if body.id not in dead)
