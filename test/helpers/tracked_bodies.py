"""Bodies as a tracker sees them: observations drawn from known covariances, cameras about them, errors of tracks."""

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from sq_perception import Camera, Superquadric
from sq_perception.fitting import quality
from sq_perception.geometry import rotation as quaternions
from sq_perception.imaging.raycast import render
from sq_perception.tracking import association, state, track, tracker

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
NOTHING = np.full((CAMERA.height, CAMERA.width), np.nan)
"""A depth image in which nothing was measured."""


def image_of(bodies, behind=1.5):
    depth, _ = render(bodies if isinstance(bodies, Superquadric) else Superquadric.stack(bodies), CAMERA)
    return np.where(np.isfinite(depth), depth, behind)


class Seen(NamedTuple):
    superquadric: Superquadric
    covariance: np.ndarray
    repeats: int = 0
    is_predicted: bool = False
    seen: np.ndarray = np.full(3, np.nan)
    cavity: object = None


def nothing_but_the_covariances(patch, common, lasting):
    """A tracker for which the covariances that it is given are all there is, with these shares in common."""
    nought = np.zeros_like(tracker.LEAST)
    for module, name, value in (
        (tracker, "LEAST", nought),
        (track, "DRIFT", nought),
        (tracker, "COMMON_SHARE", common),
        (tracker, "LASTING_SHARE", lasting),
        (association, "LIMITS", {freedom: chi2.ppf(1 - 1e-9, freedom) for freedom in association.LIMITS}),
    ):
        patch.setattr(module, name, value)
    return tracker.Tracker()


def body(size=(0.05, 0.04, 0.03), shape=(0.3, 0.5), centre=(0, 0, 0.8), turn=(0.1, 0.2, 0.3)):
    return Superquadric(
        np.array(size, dtype=float), np.array(shape, dtype=float), np.array(centre, dtype=float),
        quaternions.from_rotation_vector(np.array(turn, dtype=float)),
    )


def spread_bodies(count, rng, gap=0.3):
    """Bodies that cannot be confused: on a grid."""
    side = int(np.ceil(np.sqrt(count)))
    place = np.array([(gap * (k % side), gap * (k // side), 0.8) for k in range(count)])
    shape = rng.uniform([0.2, 0.6], [0.5, 0.9], (count, 2))
    return Superquadric(rng.uniform(0.03, 0.07, (count, 3)), shape, place, quaternions.random(count, rng))


def noise(size=0.03, shape=0.03, centre=0.001, turn=0.03):
    """Sizes as shares of themselves, here and in what follows."""
    return state.diagonal(size, shape, centre, turn)


def correlated(rng, scale=0.03):
    """A random covariance with correlations between everything."""
    deviation = np.sqrt(np.diag(noise(scale, scale, scale / 30, scale)))
    mix = rng.standard_normal((11, 22)) / np.sqrt(22)
    return deviation[:, None] * (mix @ mix.T) * deviation


def draw(truth, covariance, rng, form=None, error=None):
    """An observation of a body in a frame where its covariance holds; in a random form."""
    if error is None:
        error = rng.multivariate_normal(np.zeros(11), covariance)
    seen = Superquadric.from_flat(state.add(truth.to_flat(), np.r_[error[:3] * truth.size, error[3:]]))
    metres = state.scale_sizes(covariance, truth.size)
    form = rng.integers(8) if form is None else form
    other = seen.equivalent_forms()[int(form)]
    return Seen(other, quality.covariance_of_form(metres, seen, other))


def exchanged(seen, turn):
    """What a fit finds that chose another axis as z: one of the 16 forms that are no exact ones."""
    flat = association.candidates(seen.superquadric.to_flat())[turn]
    change = association._CHANGES[turn]
    return Seen(Superquadric.from_flat(flat), change @ seen.covariance @ change.T + 1e-6 * np.eye(11))


def from_camera(seen, rotation, position):
    """An observation of the world as a camera with this pose makes it."""
    back = quaternions.conjugate(rotation)
    matrix = quaternions.to_matrix(back)
    local = seen.superquadric.transformed(back, -matrix @ position)
    return Seen(local, state.rotate(seen.covariance, matrix))


def looking_at(target, direction, distance):
    forward = -direction / np.linalg.norm(direction)
    right = np.cross(np.array([0, 1.0, 0]) if abs(forward[1]) < 0.9 else np.array([1.0, 0, 0]), forward)
    right /= np.linalg.norm(right)
    matrix = np.stack([right, np.cross(forward, right), forward], axis=1)
    return quaternions.from_matrix(matrix), target - distance * forward


def error_of(track, truth):
    """Error of a track in the truth's nearest form, and its covariance, in shares of the true sizes."""
    exact = association.candidates(track.superquadric.to_flat())[: association.EXACT]
    errors = state.difference(truth.to_flat(), exact)
    changes = association._CHANGES[: association.EXACT]
    changed = changes @ track.covariance @ changes.swapaxes(-1, -2)
    best = np.argmin(state.mahalanobis(changed + 1e-9 * np.eye(11), errors))
    error, known = errors[best], changed[best]
    return np.r_[error[:3] / truth.size, error[3:]], state.scale_sizes(known, 1 / truth.size)


def nees(track, truth):
    error, covariance = error_of(track, truth)
    return float(state.mahalanobis(covariance, error))


def assert_chi_square(values, degrees=11, probability=1e-3):
    total, count = np.sum(values), np.size(values)
    low, high = chi2.ppf([probability / 2, 1 - probability / 2], degrees * count)
    assert low < total < high, f"mean {total / count:.2f} of {degrees}, allowed {low / count:.2f} to {high / count:.2f}"


def angle_between(a, b):
    return float(quaternions.geodesic_angle(a.rotation, b.rotation))
