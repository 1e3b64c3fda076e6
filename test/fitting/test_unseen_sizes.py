"""What tells the size that a camera did not see: symmetry of revolution, a prediction, and how much was seen at all."""

import math

import numpy as np
import pytest
from table_scenes import Table

from sq_perception.fitting import surface_fit
from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.quality import Alternative, seen_extents, spread
from sq_perception.fitting.surface_fit import FitOptions
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
TABLE = Table(math.radians(50), distance=0.62 / math.sin(math.radians(50)))
PLANE, NORMAL = TABLE.plane, TABLE.plane[:3]
NOISE = 0.0015


def standing(size: list[float], shape: list[float], turn: float = 0.0) -> Superquadric:
    """A body on the plane in the middle of the image, turned about the normal."""
    return TABLE.body(0, 0, size, shape, turn)


def fitted(body: Superquadric, seed: int = 3, **options: object) -> Fit:
    """The fit of a body on the plane as a noisy sensor sees it; real objects stray, so a model error is tolerated."""
    shown, _ = raycast.render(body, CAMERA)
    mask = np.isfinite(shown)
    depth = np.where(mask, shown, plane_depth(PLANE, CAMERA))
    depth = depth + np.random.default_rng(seed).normal(0, NOISE, depth.shape)
    settings = FitOptions(plane=PLANE, model_error=0.0025, **options)  # type: ignore[arg-type]
    return surface_fit.fit(depth.astype(np.float32), mask, CAMERA, options=settings)


def extent(body: Superquadric, direction: np.ndarray) -> float:
    return float(body.support(direction[None])[0])


# Bodies of revolution


def test_a_bottle_that_no_superquadric_explains_is_as_deep_as_it_is_wide() -> None:
    foot = standing([0.04, 0.04, 0.06], [0.1, 1.0])
    neck = Superquadric([0.015, 0.015, 0.11], [0.1, 1.0], foot.translation + 0.05 * NORMAL, foot.rotation)
    fit = fitted(Superquadric.stack([foot, neck]))
    first, second, _ = fit.superquadric.size
    assert first == pytest.approx(0.04, rel=0.2)
    assert fit.superquadric.shape[1] > 0.95
    assert first == pytest.approx(second, rel=0.04)


def test_what_is_seen_to_be_square_is_not_round() -> None:
    fit = fitted(standing([0.05, 0.05, 0.06], [0.1, 0.1], 0.6))
    assert fit.superquadric.shape.max() < 0.5


def test_an_oval_that_shows_both_of_its_sides_stays_oval() -> None:
    fit = fitted(standing([0.06, 0.03, 0.04], [0.3, 1.0], 0.6))
    size = np.sort(fit.superquadric.size)
    np.testing.assert_allclose(size, [0.03, 0.04, 0.06], rtol=0.12)


def test_how_open_a_free_body_is_counts_by_its_share_and_along_the_axes_it_shares() -> None:
    """Where a round body is chosen, the depth that the image leaves open stays open: the law of total variance."""
    round_ = State.of(Superquadric([0.04, 0.04, 0.07], [0.1, 1.0], [0.0, 0.0, 0.6], [0.0, 0.0, 0.0, 1.0]))
    about_x = quaternions.from_rotation_vector(np.array([np.pi / 2, 0.0, 0.0]))  # its z axis is -y, its y axis z
    free = State.of(Superquadric([0.04, 0.07, 0.02], [0.1, 1.0], [0.0, 0.01, 0.6], about_x))
    open_depth = np.diag([0.001, 0.002, 0.03, 0, 0, 0.004, 0.005, 0.006, 0, 0, 0]) ** 2
    moments = spread(round_, [Alternative(free, 0.25, open_depth)])
    expected = 0.25 * np.array([0.001**2, 0.03**2 + 0.02**2, 0.002**2])
    np.testing.assert_allclose(np.diag(moments)[:3], expected, rtol=1e-9)
    np.testing.assert_allclose(np.diag(moments)[5:8], 0.25 * np.array([0.004**2, 0.005**2 + 0.01**2, 0.006**2]))
    without = spread(round_, [Alternative(free, 0.25)])
    np.testing.assert_allclose(np.diag(without)[:3], 0.25 * np.array([0, 0.02**2, 0]), atol=1e-18)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_depth_that_only_roundness_tells_is_open_unless_the_body_explains_what_was_seen(seed: int) -> None:
    """A can's mantle tells its depth; what is left of a bottle beside its body leaves it to the odds of roundness."""
    foot = standing([0.04, 0.04, 0.06], [0.1, 1.0])
    neck = Superquadric([0.015, 0.015, 0.11], [0.1, 1.0], foot.translation + 0.05 * NORMAL, foot.rotation)
    bottle = fitted(Superquadric.stack([foot, neck]), seed)
    assert bottle.status is Status.WEAK
    can = fitted(standing([0.035, 0.035, 0.06], [0.1, 1.0]), seed)
    assert can.status is Status.CONVERGED


# A prediction


def face_on(**options: object) -> Fit:
    """A box in the air that shows one face only."""
    body = Superquadric([0.06, 0.05, 0.04], [0.1, 0.1], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    shown, _ = raycast.render(body, CAMERA)
    depth = np.where(np.isfinite(shown), shown, 1.2) + np.random.default_rng(5).normal(0, 0.001, shown.shape)
    settings = FitOptions(model_error=0.0025, **options)  # type: ignore[arg-type]
    return surface_fit.fit(depth.astype(np.float32), np.isfinite(shown), CAMERA, options=settings)


@pytest.mark.parametrize("depth", [0.04, 0.09])
def test_an_open_size_follows_the_prediction_and_the_seen_face_stays(depth: float) -> None:
    asked = []

    def predicted() -> Superquadric:
        asked.append(1)
        # The same box with its axes in another order.
        quarter = quaternions.from_rotation_vector(np.array([0.0, np.pi / 2, 0.0]))
        return Superquadric([depth, 0.05, 0.06], [0.2, 0.2], [0.0, 0.0, 0.5], quarter)

    fit = face_on(expected=predicted)
    assert asked == [1]
    view = np.array([0.0, 0.0, 1.0])
    assert extent(fit.superquadric, view) == pytest.approx(depth, rel=0.15)
    assert fit.superquadric.translation[2] - extent(fit.superquadric, view) == pytest.approx(0.46, abs=0.003)
    assert "prediction" in fit.message
    hidden = int(np.argmax(np.abs(fit.superquadric.rotation_matrix[2])))
    assert 0.05 * depth < fit.sigma_size[hidden] < depth


def test_what_the_image_tells_a_wrong_prediction_does_not_change() -> None:
    wrong = Superquadric([0.3, 0.3, 0.3], [0.2, 0.2], [0.0, 0.0, 0.7], [0.0, 0.0, 0.0, 1.0])
    fit = face_on(expected=wrong)
    for k, truth in ((0, 0.06), (1, 0.05)):
        assert extent(fit.superquadric, np.eye(3)[k]) == pytest.approx(truth, rel=0.06)


def test_nothing_is_asked_where_nothing_is_open() -> None:
    def never() -> Superquadric:
        raise AssertionError("asked for a prediction")

    body = Superquadric([0.05, 0.04, 0.03], [0.5, 0.7], [0.0, 0.0, 0.45], [0.3, 0.4, 0.2, 0.8])
    shown, _ = raycast.render(body, CAMERA)
    depth = np.where(np.isfinite(shown), shown, 1.0).astype(np.float32)
    surface_fit.fit(depth, np.isfinite(shown), CAMERA, options=FitOptions(expected=never))


# Seen and inferred


def test_the_seen_share_of_each_size() -> None:
    body = standing([0.05, 0.03, 0.08], [0.4, 0.6])
    local = np.random.default_rng(1).uniform(-1, 1, (4000, 3)) * body.size
    local[:, 1] = np.abs(local[:, 1])
    points = local @ body.rotation_matrix.T + body.translation
    np.testing.assert_allclose(seen_extents(body, points), [1.0, 0.5, 1.0], atol=0.03)


def test_points_outside_count_as_the_face_they_lie_beyond() -> None:
    body = Superquadric([0.05, 0.03, 0.08], [0.4, 0.6], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    points = np.random.default_rng(2).uniform(-1, 1, (2000, 3)) * 0.2
    np.testing.assert_allclose(seen_extents(body, points), 1.0)


def test_a_can_from_above_shows_all_of_its_width() -> None:
    fit = fitted(standing([0.04, 0.04, 0.05], [0.1, 1.0]))
    assert fit.seen.shape == (3,)
    assert (fit.seen > 0.85).all()
    assert (face_on().seen > 0.9).sum() == 2
    assert face_on().seen.min() < 0.2


def test_a_hidden_foot_is_thought_to_reach_the_plane() -> None:
    truth = standing([0.04, 0.03, 0.07], [0.1, 0.1], 0.4)
    shown, _ = raycast.render(truth, CAMERA)
    mask = np.isfinite(shown)
    depth = np.where(mask, shown, plane_depth(PLANE, CAMERA))
    rows = np.flatnonzero(mask.any(axis=1))
    hidden = np.arange(CAMERA.height)[:, None] > rows[0] + 0.6 * len(rows)
    depth = np.where(hidden, 0.3, depth) + np.random.default_rng(4).normal(0, NOISE, depth.shape)
    settings = FitOptions(plane=PLANE, model_error=0.0025)
    fit = surface_fit.fit(depth.astype(np.float32), mask & ~hidden, CAMERA, options=settings)
    lowest = NORMAL @ fit.superquadric.translation + PLANE[3] - extent(fit.superquadric, NORMAL)
    assert abs(lowest) < 0.006
