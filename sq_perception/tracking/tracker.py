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
from dataclasses import replace
from functools import partial

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.tracking import agreement, association, fusion, sight, state
from sq_perception.tracking.agreement import STILL_SHARE
from sq_perception.tracking.association import Pairs
from sq_perception.tracking.body import CONFIRM_AFTER, Body, Track, TrackState, stacked
from sq_perception.tracking.fusion import Views
from sq_perception.tracking.state import CENTRE, LENGTH, TURN, Observed

__all__ = ["Track", "TrackState", "Tracker"]

COMMON_SHARE, LASTING_SHARE = 0.25, 0.25
"""rho and gamma, the shares of an observation's covariance that all views from one direction, and all views, have in
common.  Chosen; benchmarks/tracking.py finds half of a view's error to be the same over all frames."""
PREDICTED_SHARE = 0.6
"""gamma of bodies beside a predicted hull.  Of 263 household things, own masks, 20 frames of a camera that goes 60
degrees about them, 90 instead of 84 % of the half sizes are within two deviations, of single frames 93 %."""
LEAST = state.diagonal(0.01, 0.02, 0.001, 0.01)
"""F, the least common error of a view, of sizes as a share.  Chosen: 1 % in size, a millimetre, half a degree."""
_LEAST_WHITE = 1e-6
"""Share of F that is new in every observation at least: of exact ones, such as a simulator's, S has no inverse else."""
UNKNOWN = 0.15, 0.2, 0.15, 0.2
"""Deviations (sizes as shares, exponents, centre as a share of the mean half size, turn) of observations without
covariance.  Chosen: errors of the classic fit and of the network alone on household things are of this order."""
PATIENCE = 2
"""After so many disagreeing observations in a row the track gives way: the second may not be chance any more."""
FASTEST = 1.0
"""Metres per second: how far a body may have been moved since its track last followed it.  A hand sets things down."""
MISSES = 5
"""A confirmed track dies in the so-manieth frame in a row that should have shown it; a tentative one in the second.
Chosen: a sixth of a second of a camera at 30 Hz."""
FORGET_AFTER = 30.0
"""Seconds without observation until a body is given up.  Chosen."""
MOST = 100
"""Tracks that are kept; beyond them those die first that were not observed for longest.  Bounds the time of a frame."""
_RESTART = 3.0
"""A restarted pose is unsure by this many times the displacement.  Chosen."""
_Bodies = tuple[Body, ...]
_Expected = Callable[[Sequence[Body]], np.ndarray]
"""Whether n bodies that were not seen should have been, bool (n,)."""


class Tracker:
    """Follows bodies; one call of :meth:`update` for each frame.

    What it knows between two frames is frozen: a copy of it goes on by itself.
    """

    def __init__(self) -> None:
        self._bodies: _Bodies = ()
        self._stamp: float | None = None
        self.births = 0
        """Ids given so far."""

    def reset(self) -> None:
        """Forget every body; ids go on."""
        self._bodies, self._stamp = (), None

    def count_on(self, other: Tracker) -> None:
        """Take over what another tracker, begun as a copy, has counted: ids, and frames that showed a body."""
        seen = {body.id: body.seen for body in other._bodies}
        self._bodies = tuple(replace(body, seen=max(body.seen, seen.get(body.id, 0))) for body in self._bodies)
        self.births = max(self.births, other.births)

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
            a depth image without camera, of another size or not of floats.
        """
        if not np.isfinite(stamp):
            raise ValueError(f"stamp: expected a finite number of seconds, got {stamp}")
        if depth is not None:
            if camera is None:
                raise ValueError("depth: expected its camera along with it")
            depth = camera.readings(depth)
        rotation, position = state.as_pose(camera_pose)
        orthographic = camera is not None and not camera.is_pinhole
        observed, covariance = _in_world(recoveries, rotation, position)
        gamma = np.array([PREDICTED_SHARE if body.is_predicted else LASTING_SHARE for body in recoveries])
        to_camera = sight.towards(observed[:, 5:8], rotation, position, orthographic)
        expected = _asked_once(
            partial(sight.expected, camera=camera, depth=depth, rotation=rotation, position=position)
        )

        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        elapsed = 0.0 if self._stamp is None else stamp - self._stamp
        bodies = tuple(body.predicted(elapsed, stamp) for body in self._bodies)
        repeats = [body.repeats > 0 for body in recoveries]
        new: list[int] = []
        if all(repeats) and (unchanged := _repeated(bodies, observed, stamp)) is not None:
            bodies = unchanged
        else:
            here, there = _pairs(bodies, observed, covariance, stamp, expected)
            bodies, pairs = _placed(bodies, here, there), here + there
            bodies, fresh = _still_there(bodies, pairs, observed, repeats, stamp)
            bodies = _fused(bodies, fresh, gamma[fresh.observed], to_camera[fresh.observed], stamp)
            new = np.setdiff1d(np.arange(len(observed)), pairs.observed).tolist()
        bodies += tuple(
            _born(self.births + n, k, observed[k], covariance[k], float(gamma[k]), to_camera[k], stamp)
            for n, k in enumerate(new, 1)
        )
        self._bodies, self._stamp, self.births = _survivors(bodies, expected, stamp), stamp, self.births + len(new)
        return tuple(body.published() for body in self._bodies)


def _asked_once(look: Callable[[np.ndarray], np.ndarray]) -> _Expected:
    """A function that looks for each body once in a frame and keeps the answer, as a body that was not seen stays
    where it was predicted to be."""
    known: dict[int, bool] = {}

    def expected(bodies: Sequence[Body]) -> np.ndarray:
        new = [body for body in bodies if body.id not in known]
        if new:
            known.update(zip((body.id for body in new), look(stacked(new)[0]).tolist(), strict=True))
        return np.array([known[body.id] for body in bodies], dtype=bool)

    return expected


def _in_world(
    recoveries: Sequence[Observed], rotation: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States (m, 12) and covariances (m, 11, 11) of what was observed."""
    if not len(recoveries):
        return np.zeros((0, 12)), np.zeros((0, LENGTH, LENGTH))
    for body in recoveries:
        if not isinstance(body.superquadric, Superquadric) or body.superquadric.batch_shape:
            raise ValueError("recoveries: expected a single body in each")
        if np.shape(body.covariance) != (LENGTH, LENGTH):
            raise ValueError(f"covariance: expected shape (11, 11), got {np.shape(body.covariance)}")
    flat = np.array([body.superquadric.untapered().to_flat() for body in recoveries], dtype=float)
    covariance = np.array([body.covariance for body in recoveries], dtype=float)
    unknown = ~np.isfinite(covariance).all(axis=(1, 2))
    if unknown.any():
        size, shape, centre, turn = UNKNOWN
        for k in np.flatnonzero(unknown):
            shares = state.diagonal(size, shape, centre * float(flat[k, 0:3].mean()), turn)
            covariance[k] = state.in_metres(shares, flat[k, 0:3])
    matrix = quaternions.to_matrix(rotation)
    flat[:, 5:8] = flat[:, 5:8] @ matrix.T + position
    flat[:, 8:12] = quaternions.multiply(rotation, flat[:, 8:12])
    return flat, state.turned(covariance, matrix)


def _repeated(bodies: _Bodies, observed: np.ndarray, stamp: float) -> _Bodies | None:
    """The bodies after a frame whose observations are all equal, to the bit, to those of the frame before.

    None for any other frame.  Nothing else is compared then: a table at which nothing happens costs next to nothing.
    """
    by_answer = {body.answer.tobytes(): k for k, body in enumerate(bodies) if body.answer is not None}
    tracks = [by_answer.get(each.tobytes(), -1) for each in observed]
    if not tracks or min(tracks) < 0 or len(set(tracks)) < len(tracks):
        return None
    after = list(bodies)
    for index, k in enumerate(tracks):
        after[k] = after[k].still_there(index, observed[index], stamp)
    return tuple(after)


def _pairs(
    bodies: _Bodies,
    observed: np.ndarray,
    covariance: np.ndarray,
    stamp: float,
    expected: _Expected,
) -> tuple[Pairs, Pairs]:
    """Pairs of bodies with what was observed in their place, and with what was observed elsewhere."""
    if not bodies:
        return Pairs.none(), Pairs.none()
    states, covariances = stacked(bodies)
    covariances = covariances + _least(states)
    here = association.in_place(states, covariances, observed, covariance)
    left = np.setdiff1d(np.arange(len(states)), here.track)
    new = np.setdiff1d(np.arange(len(observed)), here.observed)
    # What is hidden has rather stayed where it was than become one more body of its kind far away.
    absent = [bodies[k] for k in left]
    free = expected(absent) | np.array([body.is_moving for body in absent], dtype=bool)
    reach = FASTEST * np.array([stamp - bodies[k].agreed for k in left])
    reach = np.where(free, reach, np.minimum(reach, 2 * states[left, 0:3].max(axis=1)))
    there = association.elsewhere(states[left], covariances[left], reach, observed[new], covariance[new])
    return here, there._replace(track=left[there.track], observed=new[there.observed])


def _placed(bodies: _Bodies, here: Pairs, there: Pairs) -> _Bodies:
    """The bodies with their ``jumps`` counted: how often in a row they were found elsewhere."""
    after = list(bodies)
    for k in here.track:
        if after[k].jumps:
            after[k] = replace(after[k], jumps=0)
    for k in there.track:
        # Its sizes and exponents were found elsewhere: nothing more has to be waited for.
        after[k] = replace(after[k], jumps=after[k].jumps + 1, disagreed=max(after[k].disagreed, PATIENCE))
    return tuple(after)


def _still_there(
    bodies: _Bodies, pairs: Pairs, observed: np.ndarray, repeats: Sequence[bool], stamp: float
) -> tuple[_Bodies, Pairs]:
    """The bodies after answers that repeat earlier ones, and the pairs that are left to be fused.

    A repeated answer shows no more than that its body is still there.  It is fused all the same if the body moves or
    was found elsewhere, or if the answer disagrees with the track, as after a correction of the camera's pose.
    """
    if not len(pairs.track) or not any(repeats):
        return bodies, pairs
    after, new = list(bodies), np.ones(len(pairs.track), dtype=bool)
    agrees = _compared(bodies, pairs)[2].agrees
    for k, (track, index) in enumerate(zip(pairs.track, pairs.observed, strict=True)):
        body = bodies[track]
        if not repeats[index] or body.is_moving or body.jumps > 0 or not agrees[k]:
            continue
        new[k] = False
        after[track] = body.still_there(int(index), observed[index], stamp)
    return tuple(after), pairs.at(new)


def _compared(bodies: _Bodies, pairs: Pairs) -> tuple[np.ndarray, np.ndarray, agreement.Agreement]:
    """Errors (n, 11) of what was observed against the tracks, after their covariances (n, 11, 11), and whether both
    agree."""
    states, covariances = stacked([bodies[k] for k in pairs.track])
    total, error = covariances + pairs.covariance + _least(states), state.difference(states, pairs.state)
    return total, error, agreement.compared(states[:, 0:3], total, error)


def _fused(bodies: _Bodies, pairs: Pairs, gamma: np.ndarray, to_camera: np.ndarray, stamp: float) -> _Bodies:
    """The bodies after the observations of pairs, gamma (n,) of each, from directions ``to_camera`` (n, 3)."""
    if not len(pairs.track):
        return bodies
    states, covariances = stacked([bodies[k] for k in pairs.track])
    least = _least(states)
    common = COMMON_SHARE * pairs.covariance + least
    shared = gamma[:, None, None] * pairs.covariance
    white = (1 - COMMON_SHARE) * pairs.covariance - shared + _LEAST_WHITE * least
    whole = pairs.covariance + least
    some, turning = _doubted(bodies, pairs, covariances, white, whole, stamp)
    states, covariances, lasting, views = fusion.fused(
        states,
        covariances,
        np.array([body.lasting for body in some]),
        [body.views for body in some],
        pairs.state,
        white,
        common,
        fusion.root(shared),
        to_camera,
        turning,
    )
    strays = agreement.compared(states[:, 0:3], whole, state.difference(states, pairs.state))
    after = list(bodies)
    for k, body in enumerate(some):
        insists = body.disagreed >= PATIENCE and not strays.fits[k]
        after[pairs.track[k]] = replace(
            body,
            state=states[k],
            covariance=covariances[k],
            lasting=lasting[k],
            views=views.of(k),
            seen=body.seen + 1,
            missed=0,
            last=stamp,
            observation=int(pairs.observed[k]),
            follows=not (strays.slid[k] or strays.turned[k] or insists),
            answer=None,
        )
    return tuple(after)


def _doubted(
    bodies: _Bodies, pairs: Pairs, covariances: np.ndarray, white: np.ndarray, whole: np.ndarray, stamp: float
) -> tuple[list[Body], np.ndarray]:
    """The bodies of pairs with what their observations show of motion and doubt, and which of them turn, bool (n,).

    Where an observation disagrees with its track, the covariances (n, 11, 11) of the tracks and the ``white`` ones of
    the observations grow, in place; ``whole`` (n, 11, 11) are the observations' with the least error.
    """
    some = [bodies[k] for k in pairs.track]
    total, error, verdict = _compared(bodies, pairs)
    turning = np.zeros(len(some), dtype=bool)
    for k, body in enumerate(some):
        agrees, slid, turned = verdict.agrees[k], verdict.slid[k], verdict.turned[k]
        disagreed = 0 if agrees else body.disagreed + 1
        impatient = disagreed > 0 and (body.is_moving or disagreed >= PATIENCE)
        if not body.is_moving and body.jumps == 0:
            # What moves strays to the same side again; errors larger than their covariance do so seldom.
            slid = slid and agreement.same_side(body.strayed[CENTRE], error[k, CENTRE])
            turned = turned and agreement.same_side(body.strayed[TURN], error[k, TURN])
        if impatient and verdict.fits[k] and (slid or turned):
            turning[k] = turned
            variance = np.zeros(LENGTH)
            variance[CENTRE] = (_RESTART * np.linalg.norm(error[k, CENTRE])) ** 2 if slid else 0.0
            variance[TURN] = (_RESTART * np.linalg.norm(error[k, TURN])) ** 2 if turned else 0.0
            covariances[k] += np.diag(variance)
        else:
            # One stray observation is doubted itself; of several in a row, both sides are.
            white[k] += (verdict.excess[k] - 1) * whole[k]
            if disagreed >= PATIENCE:
                covariances[k] *= verdict.excess[k]
        some[k] = replace(
            body,
            disagreed=disagreed,
            strayed=np.zeros(LENGTH) if agrees else error[k],
            velocity=_velocity(body, error[k, CENTRE], slid and impatient, stamp, total[k, CENTRE, CENTRE]),
            agreed=stamp if agrees or impatient else body.agreed,
        )
    return some, turning


def _least(states: np.ndarray) -> np.ndarray:
    """F (..., 11, 11) of states (..., 12)."""
    return state.in_metres(LEAST, states[..., 0:3])


def _velocity(body: Body, error: np.ndarray, slid: bool, stamp: float, covariance: np.ndarray) -> np.ndarray:
    """The velocity (3,) after an observation of the centre, ``error`` (3,) off its prediction."""
    elapsed = stamp - body.agreed
    if elapsed <= 0:
        return body.velocity
    if body.is_moving:
        velocity = body.velocity + 0.5 * error / elapsed
        noise = float(np.sqrt(np.trace(covariance)))
        still = max(STILL_SHARE * float(body.state[0:3].mean()), 0.5 * noise)
        return velocity if np.linalg.norm(velocity) * elapsed > still else np.zeros(3)
    if slid and body.jumps != 1:
        velocity = error / elapsed
        return velocity * min(1.0, FASTEST / float(np.linalg.norm(velocity)))
    return body.velocity


def _born(
    number: int,
    index: int,
    observed: np.ndarray,
    covariance: np.ndarray,
    gamma: float,
    view: np.ndarray,
    stamp: float,
) -> Body:
    direction = quaternions.to_matrix(observed[8:12]).T @ view
    return Body(
        number,
        observed,
        (1 - gamma) * covariance + _least(observed),
        fusion.root(gamma * covariance),
        Views.first(direction, COMMON_SHARE * covariance + _least(observed)),
        last=stamp,
        agreed=stamp,
        observation=index,
        follows=True,
    )


def _survivors(bodies: _Bodies, expected: _Expected, stamp: float) -> _Bodies:
    """The bodies, with their misses counted, without the dead."""
    seen = np.array([body.observation is not None for body in bodies], dtype=bool)
    if seen.all():
        return bodies
    states, _ = stacked(bodies)
    unseen = [body for body in bodies if body.observation is None]
    overlap = association.twins(states)
    ousted = ~seen & ((overlap | overlap.T) & seen).any(axis=1)  # in their place another body was seen
    ousted[~seen] |= sight.taken_share(states[~seen], states[seen]) >= 0.5
    missing = ousted.copy()
    missing[~seen] |= expected(unseen)
    left = []
    for k, body in enumerate(bodies):
        if not seen[k]:
            missed = body.missed + 1 if missing[k] else 0
            patience = MISSES if body.seen >= CONFIRM_AFTER else 1 if ousted[k] else 2
            if missed >= patience or stamp - body.last > FORGET_AFTER:
                continue
            body = replace(body, missed=missed)
        left.append(body)
    hidden = sorted((body for body in left if body.observation is None), key=lambda body: body.last)
    dead = {body.id for body in hidden[: max(0, len(left) - MOST)]}
    return tuple(body for body in left if body.id not in dead)
