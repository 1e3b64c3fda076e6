"""The description length of a depth image by superquadrics: what decides between one body and two.

Equation
--------
The image is described as a list of bodies and what they leave over, in nats:

    L = sum_pixels a l  +  sum_bodies (11 / 2) ln n,        l = min(r^2 / 2, L_out),   r = (z - z_bodies) / sigma(z)

with z_bodies the nearest surface along the pixel's ray.  L_out is what a pixel costs that no body describes: one of the
objects that no body reaches, one that saw something far from its body, and one beside the objects at which a body
stands in front of what was measured.  A body behind what was measured is hidden there and costs nothing.

    sigma(z)^2 = (sigma_1 z^2)^2 + (2.5 mm)^2

is the noise and how far real objects stray from superquadrics.  Both are alike for neighbouring pixels, so that a
pixel counts as the share a of an independent one: its area across the line of sight over 1 cm^2.  n is the sum of a
over the objects' pixels; (1 / 2) ln n nats describe a parameter as precisely as n observations determine it.

L depends on the bodies as a set: they have no order.

References: J. Rissanen, Modeling by shortest data description, Automatica 14 (1978); A. Leonardis, A. Jaklic and
F. Solina, Superquadrics for segmenting and modeling range data, IEEE PAMI 19(11), 1997, whose choice among models is
the same trade of covered pixels, their residuals and parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, regions
from sq_perception.imaging.camera import Camera

PARAMETERS = 11
OUTLIER = 6.0
"""Nats of a pixel that no body explains; residuals of 3.5 standard deviations cost as much."""
CORRELATION_LENGTH = 0.01
MODEL_ERROR = 0.0025
_IN_FRONT = 3.0
"""A body is seen to be absent where it stands so many standard deviations in front of what was measured."""
_MARGIN = 0.25


@dataclass(frozen=True, eq=False)
class Evidence:
    """The part of an image that some objects are described in.

    Attributes
    ----------
    depth : (h, w)
        Metres, NaN where nothing was measured; a crop, to which ``camera`` belongs.
    objects : bool (h, w)
        Measured pixels that are to be explained.
    sigma : (h, w)
        Standard deviation of each, metres.
    weight : (h, w)
        Independent observations that a pixel counts for.
    """

    depth: np.ndarray
    objects: np.ndarray
    sigma: np.ndarray
    weight: np.ndarray
    camera: Camera

    @classmethod
    def of(cls, depth: np.ndarray, objects: np.ndarray, camera: Camera, sigma: float) -> Evidence:
        """The surroundings of some objects.

        Parameters
        ----------
        depth : float (height, width)
            Metres, not finite where nothing was measured.
        objects : bool (height, width)
        camera
            A pinhole camera.
        sigma
            Noise of the depth at one metre, metres; it grows with the square of the depth.

        Raises
        ------
        ValueError
            If the images do not fit the camera, or this is no pinhole.
        """
        camera.check_image(depth)
        camera.check_image(objects)
        if not camera.is_pinhole:
            raise ValueError("camera: expected a pinhole camera, got an orthographic one")
        left, top, width, height = regions.box(np.ascontiguousarray(objects))
        margin = int(np.ceil(_MARGIN * max(width, height)))
        right, bottom = min(left + width + margin, camera.width), min(top + height + margin, camera.height)
        left, top = max(left - margin, 0), max(top - margin, 0)
        window = slice(top, bottom), slice(left, right)
        z = np.where(depth[window] > 0, depth[window], np.nan).astype(float)
        level = np.hypot(sigma * z * z, MODEL_ERROR)
        area = z * z / (camera.fx * camera.fy)
        weight = np.nan_to_num(np.minimum(area / CORRELATION_LENGTH**2, 1.0))
        seen = objects[window] & np.isfinite(z)
        return cls(z, seen, level, weight, camera.cropped(left, top, right - left, bottom - top))

    @property
    def observations(self) -> float:
        """n, the independent observations of the objects."""
        return float(self.weight[self.objects].sum())


def price(evidence: Evidence) -> float:
    """Nats that describe one body."""
    return 0.5 * PARAMETERS * float(np.log(max(evidence.observations, 2.0)))


def unexplained(evidence: Evidence, bodies: Sequence[Superquadric]) -> float:
    """Nats that describe what the bodies leave over."""
    return float((pixel_costs(evidence, bodies) * evidence.weight).sum())


def pixel_costs(evidence: Evidence, bodies: Sequence[Superquadric]) -> np.ndarray:
    """l of each pixel (h, w)."""
    surface = np.full(evidence.depth.shape, np.inf)
    if bodies:
        surface, _ = raycast.render(Superquadric.stack(list(bodies)), evidence.camera)
    with np.errstate(invalid="ignore"):
        off = (evidence.depth - surface) / evidence.sigma
        cost = np.where(evidence.objects, np.minimum(0.5 * off * off, OUTLIER), np.where(off > _IN_FRONT, OUTLIER, 0.0))
    return np.where(np.isfinite(evidence.depth), cost, 0.0)
