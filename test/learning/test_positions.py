"""Views and bodies in other positions, and the mean of several answers, whichever of its forms each has."""

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.learning import inference
from sq_perception.learning.dataset import draw_views
from sq_perception.simulation import view_rendering


def random(count: int, rng: np.random.Generator) -> Superquadric:
    size, shape = rng.uniform(0.1, 0.3, (count, 3)), rng.uniform(0.1, 1.0, (count, 2))
    return Superquadric(size, shape, rng.uniform(0.4, 0.6, (count, 3)), quaternions.random(count, rng))


def changed(bodies: Superquadric, growth: float, shift: float, turn: np.ndarray) -> Superquadric:
    rotation = quaternions.multiply(bodies.rotation, turn)
    return Superquadric(bodies.size * growth, bodies.shape, bodies.translation + shift, rotation)


def answers(*each: Superquadric) -> Superquadric:
    return Superquadric.from_flat(np.stack([one.to_flat() for one in each]))


def test_moved_images_are_images_of_the_moved_bodies() -> None:
    rng = np.random.default_rng(4)
    images, bodies = draw_views(48, rng)
    turns, mirror = np.arange(48) % 4, np.arange(48) // 4 % 2 == 0
    shown, moved = inference.move_images(images, turns, mirror), inference.move_bodies(bodies, turns, mirror)
    again, _ = view_rendering.render_views(moved)
    assert ((again > 0) != (shown > 0)).mean() < 0.001
    assert np.abs(again - shown)[(again > 0) & (shown > 0)].mean() < 0.004


def test_the_mean_of_forms_of_a_body_is_the_body() -> None:
    rng = np.random.default_rng(1)
    bodies = random(20, rng)
    forms = bodies.equivalent_forms()[rng.integers(8, size=20), np.arange(20)]
    signed = Superquadric(forms.size, forms.shape, forms.translation, -forms.rotation)
    found = inference.mean_body(answers(bodies, forms, signed))
    np.testing.assert_allclose(found.to_flat(), bodies.to_flat(), atol=1e-12)


def test_opposite_errors_cancel() -> None:
    bodies = random(20, np.random.default_rng(2))
    turn = np.array([np.sin(0.05), 0.0, 0.0, np.cos(0.05)])
    larger, smaller = changed(bodies, 1.1, 0.02, turn), changed(bodies, 1 / 1.1, -0.02, turn * [-1, -1, -1, 1])
    mean = inference.mean_body(answers(larger, smaller))
    sign = np.sign((mean.rotation * bodies.rotation).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(mean.size, bodies.size)
    np.testing.assert_allclose(mean.translation, bodies.translation)
    np.testing.assert_allclose(sign * mean.rotation, bodies.rotation, atol=1e-12)


def test_different_answers_are_not_mixed_and_the_one_that_has_most_counts() -> None:
    bodies = random(20, np.random.default_rng(3))
    aside = changed(bodies, 1.5, 0.0, np.array([np.sin(0.35), 0, 0, np.cos(0.35)]))
    for shown, expected in (((bodies, aside), bodies), ((aside, bodies, bodies), bodies), ((aside, bodies), aside)):
        found = inference.mean_body(answers(*shown))
        np.testing.assert_allclose(found.size, expected.size)
        np.testing.assert_allclose(found.rotation, expected.rotation)


def test_a_network_is_shown_four_positions_as_one_batch() -> None:
    """One that answers with the place of the pixel that it sees, whose answers are moved back."""
    views = np.zeros((2, 8, 8), np.float32)
    views[0, 3, 1], views[1, 5, 6] = 1.0, 1.0
    shown = []

    def predict(batch: np.ndarray) -> Superquadric:
        shown.append(len(batch))
        _, rows, columns = np.nonzero(batch)
        place = np.column_stack([(columns + 0.5) / 8, 1 - (rows + 0.5) / 8, np.full(len(batch), 0.5)])
        ones = np.ones((len(batch), 1))
        return Superquadric(ones * [0.1, 0.2, 0.3], ones * [0.5, 0.5], place, ones * [0.0, 0.0, 0.0, 1.0])

    found = inference.predict_in_positions(predict, views)
    assert shown == [8]
    np.testing.assert_allclose(found.translation[:, :2], [[1.5 / 8, 4.5 / 8], [6.5 / 8, 2.5 / 8]])
