"""Depth images as a camera with a real lens takes them: the ray of every raw pixel, met with a surface in closed form.

No image is resampled here, so that these are what rectified and distorted images have to agree with.
"""

import numpy as np

from sq_perception import Camera, Superquadric
from sq_perception.imaging.distortion import Distortion
from sq_perception.imaging.rectification import Rectification

RAW = Camera(640, 480, 525.0, 520.0, 318.2, 241.7)
WIDE = Camera(640, 480, 300.0, 301.0, 322.0, 236.5)
BARREL = Distortion("plumb_bob", (-0.28, 0.09, 0.001, -0.0015, -0.01))
PINCUSHION = Distortion("plumb_bob", (0.2, -0.1, 0.001, -0.0015))
RATIONAL = Distortion("rational_polynomial", (0.5, -2.7, 0.0007, -0.0001, 1.6, 0.38, -2.5, 1.5))
FISHEYE = Distortion("equidistant", (-0.03, 0.01, -0.005, 0.001))
LENSES = {"barrel": (RAW, BARREL), "pincushion": (RAW, PINCUSHION), "rational": (RAW, RATIONAL)} | {
    "fisheye": (WIDE, FISHEYE)
}


def rays(camera: Camera, lens: Distortion | None = None) -> np.ndarray:
    """Directions (height, width, 3) with z = 1 of the pixels."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    points = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    if lens is not None:
        points = lens.inverse(points)
    return np.concatenate([points, np.ones(u.shape + (1,))], axis=-1)


def share_seen(undone: Rectification) -> float:
    """Share of the raw pixels that the rectified image shows."""
    u, v, camera = undone.back.u, undone.back.v, undone.camera
    return float(((u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)).mean())


def plane_depth(directions: np.ndarray, normal: np.ndarray, distance: float) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = distance / (directions @ normal)
        return np.where((depth > 0.05) & (depth < 20), depth, np.nan)


def sphere_depth(directions: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    along, square = directions @ centre, (directions * directions).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        return (along - np.sqrt(along * along - square * (centre @ centre - radius * radius))) / square


def body_depth(directions: np.ndarray, body: Superquadric) -> np.ndarray:
    """Depth of a superquadric: its gauge is convex along a ray, so that Newton's method from outside finds g = 1."""
    depth = np.full(directions.shape[:-1], np.nan)
    start = sphere_depth(directions, body.translation, float(np.linalg.norm(body.size)))
    seen = np.isfinite(start)
    direction, t = directions[seen], start[seen]
    turned = direction @ body.rotation_matrix
    centred = Superquadric(body.size, body.shape, np.zeros(3), np.array([0, 0, 0, 1.0]))
    alive = np.ones(len(t), bool)
    for _ in range(60):
        points = body.to_object(t[:, None] * direction)
        slope = (centred.gauge_gradient(points) * turned).sum(axis=-1)
        missing = 1 - centred.gauge(points)
        alive &= (slope < 0) | (missing >= -1e-12)
        t = np.where(alive & (missing < 0), t + missing / np.minimum(slope, -1e-9), t)
    alive &= np.abs(1 - centred.gauge(body.to_object(t[:, None] * direction))) < 1e-9
    depth[seen] = np.where(alive, t, np.nan)
    return depth
