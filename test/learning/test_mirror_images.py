"""A body in the mirror, and the mean of two answers, whichever of its forms each has."""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.raycast import render
from sq_perception.learning import mirror_images

CAMERA = unit_cube.camera(64)


def random(count: int, rng: np.random.Generator) -> Superquadric:
    return Superquadric(
        rng.uniform(0.1, 0.3, (count, 3)),
        rng.uniform(0.1, 1.0, (count, 2)),
        rng.uniform(0.4, 0.6, (count, 3)),
        quaternions.random(count, rng),
    )


def test_the_mirror_image_of_a_body_is_that_of_its_picture() -> None:
    """Both rendered in the unit cube; a pixel beside the outline may fall to either side."""
    bodies = random(6, np.random.default_rng(0))
    for body, other in zip(bodies, mirror_images.mirror(bodies), strict=True):
        seen, turned = (render(unit_cube.optical_from_cube(each), CAMERA)[0] for each in (body, other))
        alike = np.isclose(seen[:, ::-1], turned, atol=0.02) | (np.isinf(seen[:, ::-1]) & np.isinf(turned))
        assert alike.mean() > 0.99
    np.testing.assert_allclose(mirror_images.mirror(mirror_images.mirror(bodies)).to_flat(), bodies.to_flat())


def test_the_mean_of_forms_of_a_body_is_the_body() -> None:
    rng = np.random.default_rng(1)
    bodies = random(20, rng)
    forms = bodies.equivalent_forms()[rng.integers(8, size=20), np.arange(20)]
    signed = Superquadric(forms.size, forms.shape, forms.translation, -forms.rotation)
    for others in (forms, signed):
        np.testing.assert_allclose(mirror_images.mean(bodies, others).to_flat(), bodies.to_flat(), atol=1e-12)


def test_opposite_errors_cancel_and_different_answers_are_not_mixed() -> None:
    rng = np.random.default_rng(2)
    bodies = random(20, rng)
    turn = np.array([np.sin(0.05), 0.0, 0.0, np.cos(0.05)])
    back = turn * [-1, -1, -1, 1]
    larger = Superquadric(
        bodies.size * 1.1, bodies.shape, bodies.translation + 0.02, quaternions.multiply(bodies.rotation, turn)
    )
    smaller = Superquadric(
        bodies.size / 1.1, bodies.shape, bodies.translation - 0.02, quaternions.multiply(bodies.rotation, back)
    )
    mean = mirror_images.mean(larger, smaller)
    sign = np.sign((mean.rotation * bodies.rotation).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(mean.size, bodies.size)
    np.testing.assert_allclose(mean.translation, bodies.translation)
    np.testing.assert_allclose(sign * mean.rotation, bodies.rotation, atol=1e-12)
    aside = Superquadric(
        bodies.size,
        bodies.shape,
        bodies.translation,
        quaternions.multiply(bodies.rotation, np.array([np.sin(0.35), 0, 0, np.cos(0.35)])),
    )
    np.testing.assert_array_equal(mirror_images.mean(bodies, aside).size, bodies.size)
    np.testing.assert_allclose(mirror_images.mean(bodies, aside).rotation, bodies.rotation)


def test_a_network_is_shown_both_views_as_one_batch() -> None:
    """One that answers with the middle of what it sees sees it on the other side of the mirror image."""
    views = np.zeros((2, 8, 8), np.float32)
    views[0, 3, 1], views[1, 5, 6] = 1.0, 1.0
    shown = []

    def predict(batch: np.ndarray) -> Superquadric:
        shown.append(len(batch))
        _, _, columns = np.nonzero(batch)
        x = (columns + 0.5) / 8
        place = np.column_stack([x, np.full((len(batch), 2), 0.5)])
        ones = np.ones((len(batch), 1))
        return Superquadric(ones * [0.1, 0.2, 0.3], ones * [0.5, 0.5], place, ones * [0.0, 0.0, 0.0, 1.0])

    found = mirror_images.predict_with_mirror(predict, views)
    assert shown == [4]
    np.testing.assert_allclose(found.translation[:, 0], [1.5 / 8, 6.5 / 8])
