"""The 8 positions of a view: quarter turns and reflections, and what they do to the body in it.

Position (k, mirror) is a reflection of x, where ``mirror``, and then k quarter turns counter-clockwise in x and y, all
about the middle (1/2, 1/2) of the view.  The image of the moved body is the moved image, for cropped views and for full
frames alike.

A mirrored image is the image of the mirrored body, which is a superquadric again: with M = diag(-1, 1, 1), M R M is a
rotation, and the body's own symmetry takes up the second M.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.superquadric import Superquadric


def moved_images(images: np.ndarray, turns: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Images (n, p, p) in positions (n,)."""
    images = np.where(mirror[:, None, None], images[:, :, ::-1], images)
    out = np.empty_like(images)
    for k in range(4):
        chosen = turns == k
        out[chosen] = np.rot90(images[chosen], k, axes=(1, 2))
    return out


def moved_bodies(bodies: Superquadric, turns: np.ndarray, mirror: np.ndarray) -> Superquadric:
    """The bodies (n,) of those images."""
    sign = np.where(mirror, -1.0, 1.0)
    centred = bodies.translation - 0.5
    centred = np.stack([sign * centred[:, 0], centred[:, 1], centred[:, 2]], axis=-1)
    rotation = bodies.rotation * np.stack([np.ones_like(sign), sign, sign, np.ones_like(sign)], axis=-1)
    angle = 0.5 * np.pi * turns
    turn = np.stack([np.zeros_like(angle), np.zeros_like(angle), np.sin(angle / 2), np.cos(angle / 2)], axis=-1)
    return Superquadric(bodies.size, bodies.shape, centred, rotation).transformed(turn, np.full(3, 0.5))


def at_random(images: np.ndarray, bodies: Superquadric, rng: np.random.Generator) -> tuple[np.ndarray, Superquadric]:
    """Images (n, p, p) and their bodies (n,), each in any of the 8 positions."""
    turns, mirror = rng.integers(4, size=len(images)), rng.random(len(images)) < 0.5
    return moved_images(images, turns, mirror), moved_bodies(bodies, turns, mirror)
