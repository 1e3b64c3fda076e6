"""What a network predicts of views and of their mirror images, made one: two errors, of which the mean is smaller.

A view (b, p, p) whose columns run the other way shows the body in the mirror x' = 1 - x.  A superquadric is symmetric,
so that its mirror image is one too: half sizes and exponents stay, and a turn by q becomes the one by
(q_x, -q_y, -q_z, q_w).  Parameters are averaged in that of the 8 equivalent forms in which both turns are nearest:
sizes as logarithms.  Where they are far apart, the two are different answers, and the view's own counts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sq_perception.geometry.superquadric import Superquadric

_FARTHEST = float(np.cos(np.deg2rad(15.0)))
"""Cosine of half of the largest angle between two turns that are averaged."""
_TURN = np.array([1.0, -1.0, -1.0, 1.0])


def predict_with_mirror(predict: Callable[[np.ndarray], Superquadric], views: np.ndarray) -> Superquadric:
    """Bodies (n,) of views (n, p, p), of which ``predict`` gives those of any number of views."""
    both = predict(np.concatenate([views, views[:, :, ::-1]]))
    return mean(both[: len(views)], mirror(both[len(views) :]))


def mirror(bodies: Superquadric) -> Superquadric:
    """The mirror images of bodies (n,) of the unit cube, x' = 1 - x."""
    translation = np.concatenate([1 - bodies.translation[:, :1], bodies.translation[:, 1:]], axis=1)
    return Superquadric(bodies.size, bodies.shape, translation, bodies.rotation * _TURN)


def mean(bodies: Superquadric, others: Superquadric) -> Superquadric:
    """The means of bodies (n,) and others (n,); see the module."""
    forms = others.equivalent_forms()
    cosines = np.einsum("kni,ni->kn", forms.rotation, bodies.rotation)
    each = np.arange(len(bodies))
    nearest = np.argmax(np.abs(cosines), axis=0)
    other, cosine = forms[nearest, each], cosines[nearest, each][:, None]
    alike = np.abs(cosine) > _FARTHEST
    turn = bodies.rotation + np.where(alike, np.sign(cosine), 0.0) * other.rotation
    return Superquadric(
        np.where(alike, np.sqrt(bodies.size * other.size), bodies.size),
        np.where(alike, 0.5 * (bodies.shape + other.shape), bodies.shape),
        np.where(alike, 0.5 * (bodies.translation + other.translation), bodies.translation),
        turn / np.linalg.norm(turn, axis=1, keepdims=True),
    )
