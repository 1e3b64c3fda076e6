"""One object of a frame: its body by the chosen method, and how well that agrees with its view."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sq_perception.fitting import solina_bajcsy, surface_fit
from sq_perception.fitting.cost import SAMPLE
from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.observation import BAND_PIXELS
from sq_perception.fitting.options import MIN_PIXELS, MODEL_ERROR, FitOptions, PlaneError
from sq_perception.fitting.quality import undetermined
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import soft_agreement
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.recovery.seen_object import SeenObject, surroundings
from sq_perception.segmentation import objectness


def fit_view(obj: SeenObject, depth: np.ndarray, camera: Camera, options: RecoveryOptions, deadline: float) -> Fit:
    """The body of an object by the chosen method; FAILED with a reason instead of any exception on hard data."""
    # A sensor that sees nothing of a thing smears its outline: bodies of masks that showed less had 20 % IoU at most.
    if obj.pixels < max(MIN_PIXELS, 0.02 * obj.masked):
        of_all = f" of {obj.masked}" if obj.pixels >= MIN_PIXELS else ""
        return _failure(obj, f"{obj.pixels}{of_all} pixels with a depth are too few for a body")
    try:
        return _body(obj, depth, camera, options, deadline)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:  # of degenerate data, or an infinite body
        return _failure(obj, f"{options.method}: {error}")


def _body(obj: SeenObject, depth: np.ndarray, camera: Camera, options: RecoveryOptions, deadline: float) -> Fit:
    if options.method == "classic":
        return solina_bajcsy.fit(obj.points)
    if options.method == "network":
        return _predict(obj)
    left = max(deadline - time.perf_counter(), 1e-6)  # an object whose turn comes too late is fitted from one start
    known = FitOptions(plane=obj.plane, time_budget=left)
    if not options.free_space:
        depth = np.where(obj.mask, depth, np.float32(np.nan))
        known = replace(known, nan_is_empty=False, model_error=MODEL_ERROR)
    try:
        return _surface_fit(obj, depth, camera, known)
    except PlaneError:  # it is what the object hangs below, or no support at all
        found = _surface_fit(obj, depth, camera, replace(known, plane=None))
        return replace(found, message=f"{found.message}; the plane found lies above it and was left aside")


def _surface_fit(obj: SeenObject, depth: np.ndarray, camera: Camera, known: FitOptions) -> Fit:
    """The surface fit, with the prediction, if there is one, as a start and where the image leaves the body open."""
    # As much of the image as the fit looks at, and more.
    _, near, mask, view = surroundings(obj, depth, obj.mask, camera, max(obj.mask_crop.shape) + BAND_PIXELS)
    if obj.prediction is None:
        return surface_fit.fit(near, mask, view, options=known)
    predicted = obj.prediction.body
    options = replace(known, expected=predicted, hull=obj.prediction.hull)
    return surface_fit.fit(near, mask, view, start=predicted, options=options)


def widen(fit: Fit, others: Iterable[tuple[float, SeenObject]]) -> Fit:
    """Return a fit that is unsure by how much farther it would reach if others were parts of it: with the probability q
    of each and d what the box around both adds to half sizes and centre, second moments grow by q d d^T."""
    if not np.isfinite(fit.covariance).all():
        return fit
    body, covariance = fit.superquadric, fit.covariance.copy()
    turn, size = body.rotation_matrix, body.untapered().size
    for likely, other in others:
        along = (other.points - body.translation) @ turn
        low, high = np.minimum(along.min(axis=0), -size), np.maximum(along.max(axis=0), size)
        farther = np.zeros(len(covariance))
        farther[0:3] = 0.5 * (high - low) - size
        farther[5:8] = turn @ (0.5 * (high + low))
        covariance += likely * np.outer(farther, farther)
    is_open = fit.status == Status.CONVERGED and undetermined(covariance, body.size).any()
    if not is_open:
        return replace(fit, covariance=covariance)
    return replace(fit, covariance=covariance, status=Status.WEAK, message="it may go on in what is next to it")


def judge(likely: float, fit: Fit, pixels: float, larger: Iterable[tuple[float, Fit]]) -> float:
    """The probability that an object is a thing once its body is known (:func:`objectness.posterior`); ``larger`` are
    affinity and fit of objects with more pixels, of the surest of which it may be a fragment."""
    body, others = fit.superquadric, [(q, each) for q, each in larger if each.status != Status.FAILED]
    affinity, whole = max(others, key=lambda other: other[0], default=(0.0, None))
    overlap = 0.0 if whole is None else _share_inside(body, whole.superquadric)
    uncertainty = float(np.max(fit.sigma_size / body.size))
    return objectness.posterior(likely, uncertainty, pixels, affinity, overlap)


def _share_inside(body: Superquadric, other: Superquadric) -> float:
    """The share of a body's surface, evenly in its angles, that lies inside of another."""
    radii = sum(np.linalg.norm(each.size) * (1 + np.abs(each.taper).max()) for each in (body, other))
    if np.linalg.norm(body.translation - other.translation) > radii:
        return 0.0
    eta, omega = np.meshgrid(np.linspace(-1.4, 1.4, 9), np.linspace(-np.pi, np.pi, 16, endpoint=False))
    return float((other.gauge(body.parametric_points(eta.ravel(), omega.ravel())) < 1).mean())


def _predict(obj: SeenObject) -> Fit:
    """The prediction itself, with its distance from the points; nothing is known about its uncertainty."""
    if obj.prediction is None:
        raise ValueError("no prediction")
    body = obj.prediction.body()
    distance = body.sampson_distance(obj.points[:: max(1, len(obj.points) // SAMPLE)])
    residual = float(np.sqrt(np.mean(distance**2)))
    return Fit(body, residual, Status.CONVERGED, "prediction of the network, not refined")


def _failure(obj: SeenObject, reason: str) -> Fit:
    points = obj.points
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(0.5 * (high - low), 1e-3 * max(float((high - low).max()), 1e-3))
    body = Superquadric(size, np.ones(2), 0.5 * (low + high), np.array([0.0, 0.0, 0.0, 1.0]))
    return Fit(body.canonical_form(), np.nan, Status.FAILED, reason, inlier_share=0.0)


def score(obj: SeenObject, fit: Fit, options: RecoveryOptions) -> float:
    """Agreement of the soft-rendered body with the object's view, 0 to 1; 0 for a failed one, and half of it for one
    whose surface runs out of the image on opposite sides: neither end was there to agree with."""
    view = obj.view
    assert view is not None
    if fit.status == Status.FAILED:
        return 0.0
    body = view.to_canonical(fit.superquadric)
    parameters = np.concatenate([body.size, body.shape, body.translation, body.taper])
    # With a stride of 3, 22 x 22 lines of sight of 64 voxels settle a score to a hundredth.
    agreement = soft_agreement.agreement(
        view.image, 3, parameters, body.rotation_matrix, options.sharpness, options.tau
    )
    if not np.isfinite(agreement):
        return 0.0
    return min(max(agreement, 0.0), 1.0) * (0.5 if obj.fills else 1.0)
