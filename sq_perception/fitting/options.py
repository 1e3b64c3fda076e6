"""How to fit: the options of :func:`sq_perception.fitting.surface_fit.fit`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sq_perception.fitting.priors import HullPrior
from sq_perception.geometry.quantiles import quantile
from sq_perception.geometry.superquadric import Superquadric

SMALLEST_SIZE = 0.02
"""Smallest size, as a share of the observed extent: 6 mm of 30 cm."""
LARGEST_SIZE = 2.0
"""Largest size, likewise: a body may hide as much again as it shows."""
EXPONENTS = (0.03, 1.0)
"""Least and largest exponent of a fit: from boxes to ellipsoids.  The thesis' least, 0.1, rounds the rims of sharp cans
by a millimetre or two, and the fit makes these longer instead."""
TAPER = 0.8
"""Largest taper of a fit, where bodies may taper: beyond, a bottle would be a cone."""
MIN_PIXELS = 12
"""Fewest pixels of an object with a depth: a body has 11 parameters."""
ON_SUPPORT = 0.003
"""Height, metres, up to which a pixel of a mask may show the support."""
MODEL_ERROR = 0.0025
"""How far real objects stray from superquadrics on tables of everyday things, metres."""


def limits(points: np.ndarray, taper: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limit (10,) of a1 a2 a3 e1 e2 t1 t2 t3 k_x k_y for observed points (n, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = max(float(np.linalg.norm(high - low)), 1e-9)
    smallest, largest = SMALLEST_SIZE * extent / 2, LARGEST_SIZE * extent / 2
    reach = math.sqrt(3.0) * max(extent, largest)  # no point of a body is farther from its centre
    lower = np.array([*[smallest] * 3, *[EXPONENTS[0]] * 2, *(low - reach), -taper, -taper])
    upper = np.array([*[largest] * 3, *[EXPONENTS[1]] * 2, *(high + reach), taper, taper])
    return lower, upper


def finite_points(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows (n, 3) of points that are finite, and which ones these are.

    Raises
    ------
    ValueError
        If the array is not (n, 3) or holds no finite point.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected shape (n, 3), got {points.shape}")
    there = np.isfinite(points).all(axis=1)
    if not there.any():
        raise ValueError("no finite point: there is nothing to fit")
    return points[there], there


class PlaneError(ValueError):
    """A support plane that most of the object lies behind."""


def check_plane(points: np.ndarray, plane: np.ndarray | None) -> None:
    """Raise PlaneError if most of the object's points (n, 3) lie behind its support, as where its normal's sign is
    wrong."""
    if plane is None:
        return
    height = quantile(points @ plane[:3] + plane[3], 0.5)
    if height < -ON_SUPPORT:
        turned = "is it what this object stands on, and does its normal n point away from that?"
        raise PlaneError(f"plane: expected one under the object, got one {-height:.3g} m above it: {turned}")


@dataclass(frozen=True)
class FitOptions:
    """Options of the surface fit.

    Attributes
    ----------
    noise
        Standard deviation of the depth noise, metres; None estimates it from the image.
    model_error
        How far the object may stray from a superquadric, metres.  None: 0 if a superquadric explains the image down to
        its noise; else 2.5 mm for objects on a plane, with a predicted hull, or all but explained by a superquadric,
        less where less than 6 cm of them are seen; for others what the best superquadric leaves over.
    plane
        (4,) support plane n.x + d = height in the optical frame, n pointing away from the support; None if the object
        floats.  A body does not reach below it, and is expected to lie on one of its faces.  It is taken at its word: a
        body on one that is a centimetre off ends where that is, and does not say so.  One that most of the object is
        behind is refused: other libraries' normals point to either side.
    expected
        A body in the optical frame, or a function that returns it, that limits how large the object may be where the
        image does not: the prediction of a network.  A wide prior with long tails; asked for only where it matters.
    hull
        What is known of the thing's convex hull (:mod:`sq_perception.fitting.priors`), or a function that returns
        it: asked for only where no superquadric explains the image down to its noise.
    nan_is_empty
        Whether a pixel without depth, outside the mask's convex hull, belongs to no part of the body, like one that saw
        farther; if not, it is unknown.  None: decided by the image, see :mod:`sq_perception.fitting.observation`.
    pixels
        Budget of object rays in the last stage; a quarter as many free rays come on top.  None: enough that noise
        averages out.
    time_budget
        Seconds after which no further start is tried; the best body so far is returned.
    """

    noise: float | None = None
    model_error: float | None = None
    plane: np.ndarray | None = None
    expected: Superquadric | Callable[[], Superquadric] | None = None
    hull: HullPrior | Callable[[], HullPrior | None] | None = None
    nan_is_empty: bool | None = None
    pixels: int | None = None
    time_budget: float = math.inf

    def __post_init__(self) -> None:
        if self.noise is not None and not (np.isfinite(self.noise) and self.noise > 0):
            raise ValueError(f"noise: expected positive metres, got {self.noise}")
        if self.model_error is not None and not (np.isfinite(self.model_error) and self.model_error >= 0):
            raise ValueError(f"model_error: expected metres, 0 or more, got {self.model_error}")
        if self.plane is not None:
            plane = np.asarray(self.plane, dtype=float)
            normal = plane[:3] if plane.shape == (4,) and np.isfinite(plane).all() else np.zeros(3)
            length = np.linalg.norm(normal)
            if not length > 0:
                raise ValueError(f"plane: expected 4 finite numbers n d with a normal, got {self.plane}")
            object.__setattr__(self, "plane", plane / length)
        if self.pixels is not None and self.pixels < MIN_PIXELS:
            raise ValueError(f"pixels: expected {MIN_PIXELS} or more, got {self.pixels}")
        if not self.time_budget > 0:
            raise ValueError(f"time_budget: expected positive seconds, got {self.time_budget}")

    def predicted_hull(self) -> HullPrior | None:
        """The hull that :attr:`hull` is, or returns if it is a function."""
        return self.hull() if callable(self.hull) else self.hull
