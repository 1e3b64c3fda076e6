"""Crowds: random superquadrics on a table that touch and occlude each other.

Most bodies are pushed along the table against another one until they touch.  Convex bodies A and B overlap where a
point of one's surface lies inside the other; the push ends where no sampled point does any more.

Frames and units as in :mod:`sq_perception.simulation.scenes`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import TABLE_CAMERA, Scene, inside_image, resting_body, table_plane

MOST = 12
DISTANCE = (0.5, 1.2)
PITCH = tuple(np.deg2rad([30.0, 65.0]))
RADIUS = 0.25
PUSHED = 0.7
"""Share of the bodies that touch another one."""


def draw_crowd(rng: np.random.Generator, count: int, camera: Camera = TABLE_CAMERA) -> Scene:
    """Draw ``count`` random bodies on a table seen from 0.5 to 1.2 m, most in contact, wholly inside the image.

    Raises
    ------
    ValueError
        If ``count`` is not 1 to 12, or the bodies do not fit into the image.
    """
    if not 1 <= count <= MOST:
        raise ValueError(f"count: expected 1 to {MOST} bodies, got {count}")
    for _ in range(10):
        plane = table_plane(rng, DISTANCE, PITCH)
        bodies: list[_Placed] = []
        for _ in range(200):
            drawn = resting_body(rng, plane, RADIUS)[0]
            if not inside_image(drawn, camera):
                continue
            body = _Placed.of(drawn, rng)
            if bodies and rng.random() < PUSHED:
                body = _push(body, bodies[rng.integers(len(bodies))], plane[:3])
            if not any(map(body.overlaps, bodies)) and inside_image(body.body, camera):
                bodies.append(body)
            if len(bodies) == count:
                return Scene(Superquadric.stack([placed.body for placed in bodies]), camera, plane)
    raise ValueError(f"no room for {count} bodies in an image of {camera.width} x {camera.height} pixels")


@dataclass(frozen=True)
class _Placed:
    """A body with points (n, 3) of its surface."""

    body: Superquadric
    surface: np.ndarray

    @classmethod
    def of(cls, body: Superquadric, rng: np.random.Generator) -> _Placed:
        return cls(body, body.sample_surface(1500, rng, oversampling=2))

    def move(self, by: np.ndarray) -> _Placed:
        return _Placed(self.body.transformed(np.array([0.0, 0.0, 0.0, 1.0]), by), self.surface + by)

    def overlaps(self, other: _Placed) -> bool:
        if np.linalg.norm(self.body.translation - other.body.translation) > np.linalg.norm(
            self.body.size
        ) + np.linalg.norm(other.body.size):
            return False
        return bool((self.body.gauge(other.surface) < 1).any() or (other.body.gauge(self.surface) < 1).any())


def _push(body: _Placed, other: _Placed, normal: np.ndarray) -> _Placed:
    """Push a body along the table, straight towards the other one or away from it, until they just touch."""
    way = body.body.translation - other.body.translation
    way = way - (way @ normal) * normal
    length = float(np.linalg.norm(way))
    way = way / length if length > 0 else np.cross(normal, [0.0, 0.0, 1.0])
    near, far = -length, float(np.linalg.norm(body.body.size) + np.linalg.norm(other.body.size))
    while far - near > 2e-4:
        middle = 0.5 * (near + far)
        near, far = (middle, far) if body.move(middle * way).overlaps(other) else (near, middle)
    return body.move(far * way)
