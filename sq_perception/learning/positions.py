"""The positions of a view, and what a network predicts of four of them, made one: four errors have a smaller mean.

Positions
---------
A view has 8 positions, quarter turns and reflections.  Position (k, mirror) is a reflection of x, where ``mirror``, and
then k quarter turns counter-clockwise in x and y, all about the middle (1/2, 1/2) of the view.  The image of the moved
body is the moved image, for cropped views and for full frames alike.

A mirrored image is the image of the mirrored body, which is a superquadric again: with M = diag(-1, 1, 1), M R M is a
rotation, and the body's own symmetry takes up the second M.

Mean
----
Parameters are averaged in that of the 8 equivalent forms whose turn is nearest, sizes as logarithms.  Turns far apart
are different answers: averaged are those near to one of them, to the one that has the most.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sq_perception.geometry.superquadric import Superquadric


def predict_in_positions(predict: Callable[[np.ndarray], Superquadric], views: np.ndarray) -> Superquadric:
    """Bodies (n,) of views (n, p, p), of which ``predict`` gives those of any number of views."""
    # Positions that a network is shown, each of which undoes itself.
    positions = ((0, False), (0, True), (2, False), (2, True))
    turns, mirror = (np.repeat(each, len(views)) for each in zip(*positions, strict=True))
    shown = move_images(np.concatenate([views] * len(positions)), turns, mirror)
    flat = move_bodies(predict(shown), turns, mirror).to_flat()
    return mean(Superquadric.from_flat(flat.reshape(len(positions), len(views), -1)))


def move_images(images: np.ndarray, turns: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Images (n, p, p) in positions (n,)."""
    images = np.where(mirror[:, None, None], images[:, :, ::-1], images)
    out = np.empty_like(images)
    for k in range(4):
        chosen = turns == k
        out[chosen] = np.rot90(images[chosen], k, axes=(1, 2))
    return out


def move_bodies(bodies: Superquadric, turns: np.ndarray, mirror: np.ndarray) -> Superquadric:
    """The bodies (n,) of those images."""
    sign = np.where(mirror, -1.0, 1.0)
    centred = bodies.translation - 0.5
    centred = np.stack([sign * centred[:, 0], centred[:, 1], centred[:, 2]], axis=-1)
    rotation = bodies.rotation * np.stack([np.ones_like(sign), sign, sign, np.ones_like(sign)], axis=-1)
    angle = 0.5 * np.pi * turns
    turn = np.stack([np.zeros_like(angle), np.zeros_like(angle), np.sin(angle / 2), np.cos(angle / 2)], axis=-1)
    return Superquadric(bodies.size, bodies.shape, centred, rotation).transformed(turn, np.full(3, 0.5))


def mean(answers: Superquadric) -> Superquadric:
    """The means (n,) of answers (k, n); see the module."""
    # Cosine of half of the largest angle between two turns that are averaged.
    farthest = float(np.cos(np.deg2rad(15.0)))
    forms = answers.equivalent_forms()
    cosines = np.einsum("fkni,rni->fkrn", forms.rotation, answers.rotation)
    each = np.arange(answers.batch_shape[1])
    chosen = np.argmax((np.abs(cosines).max(axis=0) > farthest).sum(axis=0), axis=0)
    cosines = cosines[:, :, chosen, each]
    nearest = np.argmax(np.abs(cosines), axis=0)
    near = forms[nearest, np.arange(len(answers))[:, None], each]
    cosine = np.take_along_axis(cosines, nearest[None], axis=0)[0]
    weights = ((np.abs(cosine) > farthest) / (np.abs(cosine) > farthest).sum(axis=0))[..., None]
    turn = (weights * np.sign(cosine)[..., None] * near.rotation).sum(axis=0)
    return Superquadric(
        np.exp((weights * np.log(near.size)).sum(axis=0)),
        (weights * near.shape).sum(axis=0),
        (weights * near.translation).sum(axis=0),
        turn / np.linalg.norm(turn, axis=1, keepdims=True),
    )
