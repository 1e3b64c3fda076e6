"""One superquadric to points from all sides of an object, or from some of them, without a camera.

Maximum a posteriori under the mixture of :mod:`sq_perception.fitting.point_cost`: surface with normal noise, and
outliers anywhere.  The search begins with boxes along the principal axes of the cloud and turned by 45 degrees against
them, of the cloud's size and smaller, each axis as z; the likelier half goes on with more points, until one is left.
Nothing is drawn at random.

The covariance is that of the same normal equations.  Readings of one part of a surface may err together, as where the
thing is no superquadric: with S_b the sum of the weighted residuals in each of 42 directions from the centre, n_b their
number, the variance is multiplied by the mean of S_b^2 / n_b, which is 1 for independent noise, where that is above 1.
A point that may be an outlier, with the probability 1 - r, tells r (1 - (1 - r) d^2 / s^2) of what a sure one does
(T. A. Louis, Finding the observed information matrix when using the EM algorithm, JRSS B 44(2), 1982).

Reference: W. Liu, Y. Wu, S. Ruan, G. S. Chirikjian, Robust and Accurate Superquadric Recovery: a Probabilistic
Approach, CVPR 2022.
"""

from __future__ import annotations

import math
import time
from typing import Any, Literal, TypeAlias

import numpy as np

from sq_perception.fitting import point_cost, starts
from sq_perception.fitting.cost import STEP_LENGTH, Ray, Terms, rays_of
from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import span
from sq_perception.fitting.options import finite_points, limits
from sq_perception.fitting.point_cost import Cloud, Course, Mixture, UnitCloud
from sq_perception.fitting.quality import covariance_of_form, fail, judge, seen_extents
from sq_perception.fitting.residuals import FOOT, evaluate
from sq_perception.geometry.union import DIRECTIONS

Stages: TypeAlias = tuple[tuple[int, int, int], ...]
MOST_POINTS = 2000
"""Points that are fitted of a larger cloud."""
_STAGES, STAGES_OF_PARTS = ((200, 2, 24), (400, 6, 3)), ((400, 4, 24), (800, 8, 4))
"""Points, rounds and most bodies of each stage of the search: for one body, and for the first one of a union."""
_COARSE = 0.02
"""Least noise of the search, in radii of the cloud: a part that is a perfect superquadric is not the whole thing."""
PRIOR = Terms(huber=math.inf, volume_price=1.0, taper_stiffness=math.sqrt(10.0))
"""What is believed of a body before its points: of two through the same ones the smaller, of little taper."""
_MOST_TAPER = 0.9
"""Largest taper of a body to points: those from all sides show a cone."""
_PRIOR = np.array([1.0] * 3 + [0.5] * 2 + [1.0] * 3 + [1.0] * 3 + [0.5] * 2) ** -2.0
"""Precision of the prior of a step: what points leave open has its width."""
_ONE_SIDED = 0.75
"""Share of 42 directions from the centre in which there must be points of an object that is seen from all sides."""


def fit_points(
    points: np.ndarray, normals: np.ndarray | None = None, *, taper: bool = True,
    outliers: float | Literal["auto"] = "auto", sigma: float | None = None,
) -> Fit:
    """Fit one superquadric to points (n, 3) of an object's surface, from all sides or some.

    Parameters
    ----------
    points : (n, 3)
        Metres, or any unit, in any frame: the body comes back in the same.  Rows that are not finite are ignored.
    normals : (n, 3), optional
        Outward normals of the points, of any length: they tell inside from outside.
    taper
        Whether the body may be tapered along z.
    outliers
        Share of points that are not of the surface, 0 to below 1; ``"auto"`` estimates it with the body.
    sigma
        Standard deviation of the noise, in the unit of the points; None estimates it with the body.

    Returns
    -------
    Fit
        ``noise`` and ``inlier_share`` are the estimates of the mixture.  WEAK where the points leave a size open, or
        many belong to no body; FAILED for fewer than 12 points and points on a plane or a line.

    Raises
    ------
    ValueError
        If an argument has the wrong form, or there is no finite point.
    """
    began = time.perf_counter()
    kept, normals = surface_of(points, normals)
    if outliers != "auto" and not 0 <= float(outliers) < 1:
        raise ValueError(f'outliers: expected a share from 0 to below 1, or "auto", got {outliers}')
    if sigma is not None and not (np.isfinite(sigma) and sigma > 0):
        raise ValueError(f"sigma: expected a positive length, got {sigma}")
    cloud = UnitCloud.of(kept, normals, MOST_POINTS)
    if reason := reason_to_fail(cloud):
        return fail(kept, 0.01 * cloud.scale, math.nan, reason, began)
    found = search(cloud, None if sigma is None else sigma / cloud.scale, outliers, taper)
    return assess(cloud, found, 0, began)


def fit_mesh(mesh: Any, *, taper: bool = True) -> Fit:
    """Fit one superquadric to a mesh, what has ``vertices`` and ``faces``, as :func:`fit_points` to points of it."""
    drawn, normals = surface_of(mesh)
    return fit_points(drawn, normals, taper=taper)


def reason_to_fail(cloud: UnitCloud) -> str:
    """Why no body can be fitted to a cloud; empty if one can."""
    thickness = np.ptp(cloud.points, axis=0).min()
    flat = "all points lie on one plane: nothing is known of the thickness" if thickness < 1e-6 else ""
    return starts.reason_to_fail(cloud.points, len(cloud.points), "points") or flat


def limits_of(cloud: UnitCloud, taper: bool) -> tuple[np.ndarray, np.ndarray]:
    """Limits (10,) of a body of this cloud."""
    return limits(cloud.points, _MOST_TAPER if taper else 0.0)


def surface_of(thing: Any, normals: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Finite points (n, 3) of a surface and their normals, if any: of points themselves, or drawn evenly from a mesh.

    A mesh has ``vertices`` (n, 3) and ``faces`` (m, 3), turned outwards; 20 000 points of it, and their normals, come
    back, the same ones each time.
    """
    if hasattr(thing, "vertices") and hasattr(thing, "faces"):
        import trimesh  # here: points need none

        vertices, faces = np.asarray(thing.vertices, dtype=float), np.asarray(thing.faces, dtype=int)
        if (
            faces.ndim != 2
            or faces.shape[1] != 3
            or (faces.size and not 0 <= faces.min() <= faces.max() < len(vertices))
        ):
            raise ValueError(f"mesh: expected faces (m, 3) of {len(vertices)} vertices, got shape {faces.shape}")
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        if not (np.isfinite(mesh.area) and mesh.area > 0):
            raise ValueError("mesh: expected faces with an area, of finite vertices")
        drawn, face = trimesh.sample.sample_surface(mesh, 20_000, seed=0)
        return np.asarray(drawn), mesh.face_normals[face]
    kept, there = finite_points(thing)
    if normals is None:
        return kept, None
    normals = np.asarray(normals, dtype=float)
    if normals.shape != (len(there), 3):
        raise ValueError(f"normals: expected {len(there)} rows as of the points, got shape {normals.shape}")
    is_known = np.isfinite(normals).all(axis=1, keepdims=True)
    return kept, np.where(is_known, normals, 0.0)[there]


def search(
    cloud: UnitCloud, sigma: float | None, outliers: float | str, taper: bool, stages: Stages = _STAGES
) -> Mixture:
    """The likeliest body of a cloud, tapered if it is likelier so than two more numbers cost."""
    share = 0.5 if outliers == "auto" else float(outliers)
    found = [_alone(start, 0.05, share) for start in _starts(cloud)]
    straight, tapered = limits_of(cloud, False), limits_of(cloud, True)
    for number, rounds, most in stages:
        some = cloud.surface(number)
        course = Course(False, outliers != "auto", _COARSE, rounds, 1e-3, False)
        found = [point_cost.maximize(some, each, PRIOR, straight, course) for each in found[:most]]
        found.sort(key=lambda each: -each.likelihood)
    candidates = [(found[0], straight)]
    if taper:
        body = State(found[0].bodies[0], found[0].turns[0], math.inf, 0)
        orders = (body, *starts.other_orders(body, body.parameters[3:5].mean()))
        turned = [
            point_cost.maximize(some, _alone(each, found[0].sigma, found[0].share), PRIOR, tapered, course)
            for each in orders
        ]
        best = max(turned, key=lambda each: each.likelihood)
        if best.likelihood > found[0].likelihood + math.log(len(some.points)):
            candidates.append((best, tapered))
    whole = cloud.surface()
    course = Course(sigma is not None, outliers != "auto", 1e-4, 40, 1e-5, True)  # mostly six rounds do
    if sigma is not None:
        candidates = [(each._replace(sigma=sigma), bounds) for each, bounds in candidates]
    ends = [point_cost.maximize(whole, each, PRIOR, bounds, course) for each, bounds in candidates]
    return ends[-1] if ends[-1].likelihood > ends[0].likelihood + math.log(len(whole.points)) else ends[0]


def _alone(state: State, sigma: float, share: float) -> Mixture:
    return Mixture(state.parameters[None], state.rotation[None], sigma, share, -math.inf)


def _starts(cloud: UnitCloud) -> list[State]:
    """Boxes along principal axes, and turned by 45 degrees against them.

    They are those of all points and those of the densest: outliers are spread through a volume, and so are sparse.
    """
    from scipy.spatial import cKDTree  # here: a node that recovers does without

    few = cloud.surface(500).points
    reach = cKDTree(few).query(few, k=min(9, len(few)))[0][:, -1]  # itself and eight neighbours
    # Of a cloud with 60 % of outliers seven in eight of the densest 30 % are none.
    dense = few[np.argsort(reach, kind="stable")[: max(3, round(0.3 * len(few)))]]
    found = []
    for some in (few, dense):
        axes = starts.principal_axes(np.cov(some.T))
        for turn in (axes, *starts.eighth_turns(axes)):
            low, high = span(some, turn.T, 0.05).T
            found += starts.boxes(low, high, turn, starts.START_EXPONENT)
    return found


def assess(cloud: UnitCloud, mixture: Mixture, k: int, began: float, reasons: tuple[str, ...] = ()) -> Fit:
    """The result of the k-th body of a mixture."""
    surface = cloud.surface()
    probability, distance, _ = point_cost.shares(surface, mixture, np.zeros((len(cloud.points), len(mixture.bodies))))
    weight, off = probability[:, k], distance[:, k]
    body, turn = mixture.bodies[k], mixture.turns[k]
    covariance = covariance_of(surface, weight, mixture, k)
    units = np.array([cloud.scale] * 3 + [1.0] * 2 + [cloud.scale] * 3 + [1.0] * 3)
    world = np.eye(STEP_LENGTH - 2)
    world[5:8, 5:8] = cloud.axes
    covariance = units[:, None] * (world @ covariance[:11, :11] @ world.T) * units
    fitted = cloud.body(body, turn)
    canonical = fitted.canonical_form()
    covariance = covariance_of_form(covariance, fitted, canonical)
    sigma = mixture.sigma * cloud.scale
    inlying = weight > 0.5
    own = cloud.points[inlying] @ cloud.axes.T * cloud.scale + cloud.centre
    typical = float(np.median(np.abs(off[inlying]))) * cloud.scale if inlying.any() else math.inf
    status, message = judge(canonical, covariance, typical, sigma, False)
    notes = list(reasons)
    if len(mixture.bodies) == 1 and _covered(cloud.points[inlying], body, turn) < _ONE_SIDED:
        notes.append("seen from one side only: sq-perception recover knows more, with the camera that took the points")
    if len(mixture.bodies) == 1 and mixture.share > 0.3:
        notes.append(f"{mixture.share:.0%} of the points are on no surface of it: outliers, or parts of more bodies")
    if float(canonical.size.min()) < 2 * sigma:
        notes.append("it is no thicker than the noise: the points lie on one plane, as far as they tell")
    if notes and status == Status.CONVERGED:
        status, message = Status.WEAK, "; ".join(notes)
    elif notes:
        message = "; ".join([message, *notes])
    return Fit(
        superquadric=canonical,
        residual=float(np.sqrt(np.sum(weight * off**2) / max(weight.sum(), 1e-9))) * cloud.scale, status=status,
        message=message, noise=sigma, inlier_share=float(weight.mean()),
        seen=seen_extents(canonical, own) if len(own) else np.zeros(3), covariance=covariance, iterations=0,
        milliseconds=(time.perf_counter() - began) * 1e3,
    )


def _covered(some: np.ndarray, body: np.ndarray, turn: np.ndarray) -> float:
    """Share of the 42 directions from a body's centre in which there is one of some points (n, 3)."""
    cells = _directions(some, body, turn)
    # Of fewer than three points a direction some have none by chance.
    return len(np.unique(cells)) / min(len(DIRECTIONS), max(1, len(cells) // 3))


def _directions(some: np.ndarray, body: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """In which of the 42 directions (n,) points lie from a body's centre, in units of its half sizes."""
    return np.argmax(((some - body[5:8]) @ turn) / body[0:3] @ DIRECTIONS.T, axis=1)


def covariance_of(surface: Cloud, weight: np.ndarray, mixture: Mixture, k: int) -> np.ndarray:
    """Covariance (13, 13) of sizes, exponents, centre, rotation vector and tapers, in units of the cloud."""
    body, turn = mixture.bodies[k], mixture.turns[k]
    sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    residual = point_cost.distances(surface.points, body, turn) / mixture.sigma
    known = weight * np.maximum(1.0 - (1.0 - weight) * residual**2, 0.0)  # less what the mixture hides
    rays = rays_of(surface.points)
    rays[:, Ray.WEIGHT] = known / mixture.sigma**2
    evaluate(FOOT, rays, rays[:0], Terms(huber=math.inf), body, turn, rays[:, Ray.DEPTH].copy(), sums)
    cell = _directions(surface.points, body, turn)
    number = np.bincount(cell, weight, len(DIRECTIONS))
    together = np.bincount(cell, weight * residual, len(DIRECTIONS)) ** 2 / np.maximum(number, 1.0)
    alike = max(1.0, float(together[number >= 1].mean()) if (number >= 1).any() else 1.0)
    lower = np.tril(sums[:STEP_LENGTH, :STEP_LENGTH])
    information = (lower + np.tril(lower, -1).T) / alike + np.diag(_PRIOR)
    if not body[8:].any():  # straight, not by measurement but by choice
        information[11:, :11] = information[:11, 11:] = 0.0
    units = np.concatenate([body[0:3], np.ones(STEP_LENGTH - 3)])
    covariance = units[:, None] * np.linalg.inv(information) * units
    return np.asarray((covariance + covariance.T) / 2)
