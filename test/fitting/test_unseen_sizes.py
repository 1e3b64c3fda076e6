"""Sizes that a camera did not see: what revolution, a prediction and a plane tell, what border and rounding leave."""

import math

import numpy as np
import pytest
from table_scenes import VGA, Table

from sq_perception.fitting import surface_fit
from sq_perception.fitting.cost import Ray
from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.options import MODEL_ERROR, FitOptions
from sq_perception.fitting.priors import HullPrior
from sq_perception.fitting.quality import Alternative, seen_extents, spread
from sq_perception.fitting.valleys import faces_camera
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import DIRECTIONS
from sq_perception.imaging import raycast, unit_cube
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


def test_what_is_seen_to_be_square_is_not_round_and_an_oval_stays_oval() -> None:
    assert fitted(standing([0.05, 0.05, 0.06], [0.1, 0.1], 0.6)).superquadric.shape.max() < 0.5
    fit = fitted(standing([0.06, 0.03, 0.04], [0.3, 1.0], 0.6))
    np.testing.assert_allclose(np.sort(fit.superquadric.size), [0.03, 0.04, 0.06], rtol=0.12)


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
    assert fitted(Superquadric.stack([foot, neck]), seed).status is Status.WEAK
    assert fitted(standing([0.035, 0.035, 0.06], [0.1, 1.0]), seed).status is Status.CONVERGED


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


def test_the_seen_share_of_each_size_counts_points_outside_as_the_face_they_lie_beyond() -> None:
    body = standing([0.05, 0.03, 0.08], [0.4, 0.6])
    local = np.random.default_rng(1).uniform(-1, 1, (4000, 3)) * body.size
    local[:, 1] = np.abs(local[:, 1])
    points = local @ body.rotation_matrix.T + body.translation
    np.testing.assert_allclose(seen_extents(body, points), [1.0, 0.5, 1.0], atol=0.03)
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
    shown, _ = raycast.render(standing([0.04, 0.03, 0.07], [0.1, 0.1], 0.4), CAMERA)
    mask = np.isfinite(shown)
    depth = np.where(mask, shown, plane_depth(PLANE, CAMERA))
    rows = np.flatnonzero(mask.any(axis=1))
    hidden = np.arange(CAMERA.height)[:, None] > rows[0] + 0.6 * len(rows)
    depth = np.where(hidden, 0.3, depth) + np.random.default_rng(4).normal(0, NOISE, depth.shape)
    settings = FitOptions(plane=PLANE, model_error=0.0025)
    fit = surface_fit.fit(depth.astype(np.float32), mask & ~hidden, CAMERA, options=settings)
    lowest = NORMAL @ fit.superquadric.translation + PLANE[3] - extent(fit.superquadric, NORMAL)
    assert abs(lowest) < 0.006


CAN = (0.035, 0.035, 0.06), (0.1, 1.0)
BALL = (0.04, 0.04, 0.04), (1.0, 1.0)


def lower_half(size, shape, seed, as_thing=False, dark=0) -> tuple[Superquadric, Fit]:
    """A body of which the image shows the lower half, and its fit; of a thing, a hull is predicted that ends there.

    Above the image are ``dark`` rows without readings, as rectified ones have them.
    """
    table = Table(pitch=np.random.default_rng(seed).uniform(0.5, 1.1))
    body = table.body(0, 0, size, shape)
    depth, labels = table.see([body], noise=0.0007, seed=seed)
    rows = np.flatnonzero((labels == 1).any(axis=1))
    first = int(0.5 * (rows[0] + rows[-1]))
    depth[first - dark : first], labels[first - dark : first] = np.nan, 0
    first -= dark
    camera = VGA.cropped(0, first, VGA.width, VGA.height - first)
    options = FitOptions(plane=table.plane)
    if as_thing:
        shown = table.body(0, 0, (*size[:2], 0.65 * size[2]), shape)
        support = DIRECTIONS @ shown.translation + shown.support(DIRECTIONS)
        hull = HullPrior(DIRECTIONS, support, 0.003**2 * np.eye(len(support)), 2 * max(size[:2]))
        options = FitOptions(plane=table.plane, model_error=MODEL_ERROR, hull=hull)
    return body, surface_fit.fit(depth[first:], labels[first:] == 1, camera, options=options)


@pytest.mark.parametrize("dark", [0, 20])
@pytest.mark.parametrize("as_thing", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_a_can_may_be_longer_than_the_search_made_it(seed: int, as_thing: bool, dark: int) -> None:
    body, fit = lower_half(*CAN, seed, as_thing, dark)
    along = int(np.argmax(np.abs(fit.superquadric.rotation_matrix.T @ body.rotation_matrix[:, 2])))
    error = abs(fit.superquadric.size[along] - body.size[2])
    assert error < 3 * fit.sigma_size[along]
    assert fit.status == Status.WEAK or error < 0.1 * body.size[2]


@pytest.mark.parametrize("seed", range(3))
def test_the_curvature_of_a_ball_tells_how_large_it_is(seed: int) -> None:
    body, fit = lower_half(*BALL, seed)
    assert fit.status == Status.CONVERGED
    np.testing.assert_allclose(fit.superquadric.size, body.size, rtol=0.03)


def test_one_depth_in_common_makes_a_face(rng: np.random.Generator) -> None:
    step = 1 / 256
    rays = np.zeros((1000, len(Ray)))
    rays[:, Ray.DEPTH] = np.round(rng.uniform(0.2, 0.8, 1000) / step) * step
    assert not faces_camera(rays, step)
    rays[:100, Ray.DEPTH] = 128 * step
    assert faces_camera(rays, step)


@pytest.mark.parametrize("hidden", [30, 45, 65])
@pytest.mark.parametrize("spin", [0.2, 0.7])
def test_the_hidden_half_size_of_a_face_lies_within_its_deviation(hidden: float, spin: float) -> None:
    body = Superquadric(
        np.array([60, 40, hidden]) / 255, [0.12, 0.15], [0.5, 0.5, 0.5], [0.0, 0.0, np.sin(spin), np.cos(spin)]
    )
    depth, _ = raycast.render(body, unit_cube.camera())
    grey = unit_cube.grey_from_depth(depth)
    fit = surface_fit.fit(unit_cube.depth_from_grey(grey), grey > 0, unit_cube.camera())
    along = int(np.argmax(np.abs(fit.superquadric.rotation_matrix[2])))
    assert abs(fit.superquadric.size[along] - hidden / 255) < 2.5 * fit.sigma_size[along]
    assert fit.sigma_size[along] > 3 * np.delete(fit.sigma_size, along).max()


def test_where_two_faces_are_seen_nothing_is_open() -> None:
    body = Superquadric([0.2, 0.15, 0.25], [0.12, 0.15], [0.5, 0.5, 0.5], [0.35, 0.3, 0.1, 0.85])
    depth, _ = raycast.render(body, unit_cube.camera())
    grey = unit_cube.grey_from_depth(depth)
    fit = surface_fit.fit(unit_cube.depth_from_grey(grey), grey > 0, unit_cube.camera())
    assert (fit.sigma_size < 0.01 * fit.superquadric.size).all()
    np.testing.assert_allclose(np.sort(fit.superquadric.size), [0.15, 0.2, 0.25], rtol=0.01)


def test_a_body_that_passes_readings_at_more_than_half_a_step_is_not_the_last() -> None:
    body = unit_cube.optical_from_cube(
        Superquadric(
            [0.160507, 0.150236, 0.170657],
            [0.884777, 0.915079],
            [0.379145, 0.402456, 0.529095],
            [-0.671346, 0.200430, -0.628333, -0.338112],
        )
    )
    depth, _ = raycast.render(body, unit_cube.camera())
    grey = unit_cube.grey_from_depth(depth)
    measured = unit_cube.depth_from_grey(grey)
    fit = surface_fit.fit(measured, grey > 0, unit_cube.camera())
    passed, _ = raycast.render(fit.superquadric, unit_cube.camera())
    assert np.mean(np.abs(passed - measured)[grey > 0] > 0.6 / 255) < 0.01
    assert volume_iou(fit.superquadric, body) > 0.98
