"""The compiled residuals against their torch statement: values, and derivatives against autograd."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
import residual_statement as statement
import torch

from sq_perception.fitting.cost import STEP_LENGTH, Ray, Terms
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.residuals import CLASSIC, RENDERED, SAMPSON, evaluate, penetration, surface_distance
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric

NO_RAYS = np.empty((0, len(Ray)))
PLAIN = Terms(huber=np.inf, outline_huber=np.inf)
SIGMA = 0.003


def random_body(rng, shape=None, taper=(0.0, 0.0)) -> Superquadric:
    exponents = rng.uniform(0.1, 1.0, 2) if shape is None else np.array(shape)
    size, centre = rng.uniform(0.03, 0.1, 3), rng.uniform(-0.1, 0.1, 3) + [0, 0, 0.6]
    return Superquadric(size, exponents, centre, quaternions.random(1, rng)[0], np.asarray(taper))


def rays_to(points: np.ndarray, pinhole: bool) -> np.ndarray:
    rays = np.zeros((len(points), len(Ray)))
    if pinhole:
        rays[:, [Ray.DIRECTION_X, Ray.DIRECTION_Y]] = points[:, :2] / points[:, 2:]
    else:
        rays[:, [Ray.ORIGIN_X, Ray.ORIGIN_Y]] = points[:, :2]
    rays[:, Ray.DEPTH] = points[:, 2]
    rays[:, Ray.STIFFNESS], rays[:, Ray.WEIGHT] = 1 / SIGMA, 1.0
    return rays


def torch_rays(rays: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    origin, direction = np.zeros((len(rays), 3)), np.ones((len(rays), 3))
    origin[:, :2], direction[:, :2] = rays[:, [Ray.ORIGIN_X, Ray.ORIGIN_Y]], rays[:, [Ray.DIRECTION_X, Ray.DIRECTION_Y]]
    return torch.tensor(origin), torch.tensor(direction), torch.tensor(rays[:, Ray.DEPTH])


def as_torch(body: Superquadric) -> Superquadric:
    return Superquadric.from_flat(torch.tensor(np.asarray(body.to_numbers(), dtype=float)))


def expected_sums(body: Superquadric, residuals: Callable[[Superquadric], torch.Tensor]) -> tuple[float, np.ndarray]:
    """Sum of squares and the normal equations of a residual vector, by autograd."""
    start = as_torch(body)
    zero = torch.zeros(STEP_LENGTH, dtype=torch.float64)
    values = residuals(statement.moved(start, zero)).detach().numpy()
    jacobian = torch.autograd.functional.jacobian(lambda step: residuals(statement.moved(start, step)), zero).numpy()
    return float(values @ values), np.concatenate([jacobian.T @ jacobian, (jacobian.T @ values)[None]])


def cost_of(stage, rays, free, terms, body) -> tuple[float, np.ndarray]:
    """The cost, and the normal equations with the gradient in their last row."""
    sums, state = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1)), State.of(body)
    depth = rays[:, Ray.DEPTH].copy()
    return evaluate(stage, rays, free, terms, state.parameters, state.rotation, depth, sums), sums


def assert_same(stage, rays, free, terms, body, expected, tolerance=1e-5) -> None:
    cost, sums = cost_of(stage, rays, free, terms, body)
    value, matrix = expected
    assert cost == pytest.approx(value, rel=tolerance, abs=1e-12)
    lower = np.tril(np.ones((STEP_LENGTH, STEP_LENGTH), bool))
    scale = np.sqrt(np.outer(np.diag(matrix[:STEP_LENGTH]), np.diag(matrix[:STEP_LENGTH]))) + 1e-6
    difference = np.abs(sums[:STEP_LENGTH, :STEP_LENGTH] - matrix[:STEP_LENGTH]) / scale
    assert difference[lower].max() < 10 * tolerance
    root = np.sqrt(np.diag(matrix[:STEP_LENGTH]) * max(value, 1e-12)) + 1e-6
    assert (np.abs(sums[STEP_LENGTH, :STEP_LENGTH] - matrix[STEP_LENGTH]) / root).max() < 10 * tolerance


LIMITS = (np.r_[[0.01] * 3, [0.1] * 2, [-1.0] * 3, [0.0] * 2], np.r_[[0.3] * 3, [1.0] * 2, [1.0] * 3, [0.0] * 2])
TAPERS = [(0.0, 0.0), (0.4, -0.3)]
SHAPES = [None, (0.1, 0.1), (0.02, 0.05), (1.0, 1.0), (0.1, 1.0), (1.0, 0.1), (1.8, 1.5)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("stage", [CLASSIC, SAMPSON])
@pytest.mark.parametrize("taper", TAPERS)
def test_point_residuals_and_derivatives(taper, stage, shape, rng) -> None:
    body = random_body(rng, shape, taper)
    points = body.sample_surface(60, rng) + rng.normal(0, 0.004, (60, 3))
    function = statement.classic if stage == CLASSIC else statement.sampson
    expected = expected_sums(body, lambda moved: function(moved, torch.tensor(points)) / SIGMA)
    assert_same(stage, rays_to(points, pinhole=False), NO_RAYS, PLAIN, body, expected)


@pytest.mark.parametrize("stage", [CLASSIC, SAMPSON])
def test_point_residuals_on_the_axes(stage: int, rng: np.random.Generator) -> None:
    body = random_body(rng)
    points = np.asarray(body.to_parent(np.concatenate([np.eye(3), -np.eye(3)]) * body.size * 1.02))
    function = statement.classic if stage == CLASSIC else statement.sampson
    expected = expected_sums(body, lambda moved: function(moved, torch.tensor(points)) / SIGMA)
    assert_same(stage, rays_to(points, pinhole=True), NO_RAYS, PLAIN, body, expected)


def visible_points(body: Superquadric, rng: np.random.Generator, pinhole: bool) -> np.ndarray:
    points = body.sample_surface(200, rng)
    normals = np.asarray(body.normals(points))
    view = points / points[:, 2:] if pinhole else np.array([0.0, 0.0, 1.0])
    return points[(normals * view).sum(-1) < -0.15]


@pytest.mark.parametrize("shape", SHAPES[:5])
@pytest.mark.parametrize(("pinhole", "taper"), zip([True, False], TAPERS, strict=True))
def test_rendered_depth_and_derivatives(pinhole, taper, shape, rng) -> None:
    body = random_body(rng, shape, taper)
    rays = rays_to(visible_points(body, rng, pinhole), pinhole)
    rays[:, Ray.DEPTH] += rng.normal(0, 0.003, len(rays))
    origin, direction, depth = torch_rays(rays)
    expected = expected_sums(
        body, lambda moved: statement.rendered(moved, origin, direction, depth, PLAIN.grazing) / SIGMA
    )
    # The kernel stops Newton's method at |g - 1| < 1e-4 and takes the last step in first order.
    assert_same(RENDERED, rays, NO_RAYS, PLAIN, body, expected, tolerance=1e-3 if shape != (0.02, 0.05) else 0.02)


@pytest.mark.parametrize(("pinhole", "taper"), zip([True, False], TAPERS, strict=True))
def test_free_space_and_derivatives(pinhole: bool, taper: tuple[float, float], rng: np.random.Generator) -> None:
    body = random_body(rng, taper=taper)
    around = body.translation + rng.uniform(-0.12, 0.12, (400, 3))
    free = rays_to(around, pinhole)
    free[:, Ray.DEPTH] = np.where(rng.random(400) < 0.5, 1e300, around[:, 2])
    free[:, Ray.STIFFNESS] = 1.0
    origin, direction, limit = torch_rays(free)
    terms = PLAIN._replace(outline_stiffness=1 / SIGMA, pinhole=float(pinhole))
    expected = expected_sums(body, lambda moved: torch.relu(statement.outline(moved, origin, direction, limit)) / SIGMA)
    assert expected[0] > 1
    assert_same(SAMPSON, NO_RAYS, free, terms, body, expected)
    state = State.of(body)
    depth = penetration(free, terms, state.parameters, state.rotation)
    assert depth @ depth == pytest.approx(expected[0] * SIGMA**2, rel=1e-5)


def test_pixels_of_the_object_that_miss_the_body_pull_its_outline(rng: np.random.Generator) -> None:
    body = Superquadric([0.05, 0.04, 0.03], [0.6, 0.8], [0.0, 0.0, 0.5], quaternions.random(1, rng)[0])
    angle = np.linspace(0, 2 * np.pi, 200)
    rim = np.stack([np.cos(angle), np.sin(angle)], 1)
    extent = np.asarray(body.support(np.concatenate([rim, np.zeros((200, 1))], 1)))
    rays = rays_to(np.concatenate([rim * extent[:, None] * 1.01, np.full((200, 1), 0.5)], 1), pinhole=False)
    cost, sums = cost_of(RENDERED, rays, NO_RAYS, PLAIN._replace(outline_stiffness=1 / SIGMA), body)
    assert cost > 0
    assert np.isfinite(cost)
    assert sums[STEP_LENGTH, :STEP_LENGTH][:3].min() < 0, "growing the body must lower the cost"


def test_plane_rest_and_proportion(rng: np.random.Generator) -> None:
    body = random_body(rng, taper=(0.3, -0.2))
    normal = np.array([0.1, -0.9, -0.3])
    normal /= np.linalg.norm(normal)
    plane = np.append(normal, -normal @ body.translation + 0.4 * body.size.min())
    target = torch.tensor(plane)
    terms = PLAIN._replace(plane=plane, plane_stiffness=200.0)
    expected = expected_sums(body, lambda moved: 200 * statement.lowest_height(moved, target)[None])
    assert_same(SAMPSON, NO_RAYS, NO_RAYS, terms, body, expected)

    lifted = plane + np.array([0, 0, 0, 3 * body.size.max()])
    height = float(statement.lowest_height(as_torch(body), torch.tensor(lifted))) * 40
    assert height > 0
    gap = terms._replace(plane=lifted, gap_stiffness=40.0)
    damped = 40 / np.sqrt(1 + height**2)
    _, matrix = expected_sums(body, lambda moved: damped * statement.lowest_height(moved, torch.tensor(lifted))[None])
    assert_same(SAMPSON, NO_RAYS, NO_RAYS, gap, body, (np.log1p(height**2), matrix))

    square = float(statement.leaning(as_torch(body), target).square().sum()) * 9
    rest = terms._replace(plane_stiffness=0.0, rest_stiffness=3.0)
    _, matrix = expected_sums(body, lambda moved: 3 * statement.leaning(moved, target) / np.sqrt(1 + square))
    assert_same(SAMPSON, NO_RAYS, NO_RAYS, rest, body, (np.log1p(square), matrix.copy()))

    even = PLAIN._replace(proportion_stiffness=2.0)
    assert_same(
        SAMPSON, NO_RAYS, NO_RAYS, even, body, expected_sums(body, lambda moved: 2 * statement.proportion(moved))
    )

    round_ = PLAIN._replace(roundness_stiffness=7.0)
    square = float(statement.roundness(as_torch(body)).square().sum()) * 49
    damped = 7 * np.sqrt(3 / (1 + square))
    _, matrix = expected_sums(body, lambda moved: damped * statement.roundness(moved))
    assert_same(SAMPSON, NO_RAYS, NO_RAYS, round_, body, (3 * np.log1p(square), matrix))

    sizes = np.array([0.02, 0.05, 0.08])
    expecting = PLAIN._replace(expected=sizes, expectation_stiffness=4.0)
    residual = 4 * np.log(body.size / sizes)
    scale = torch.tensor(4 / np.sqrt(1 + residual**2))
    _, matrix = expected_sums(body, lambda moved: scale * statement.surprise(moved, torch.tensor(sizes)))
    assert_same(SAMPSON, NO_RAYS, NO_RAYS, expecting, body, (np.log1p(residual**2).sum(), matrix))


def test_a_body_above_the_plane_pays_nothing(rng: np.random.Generator) -> None:
    terms = PLAIN._replace(plane=np.array([0.0, -1.0, 0.0, 1.0]), plane_stiffness=1000.0)
    assert cost_of(SAMPSON, NO_RAYS, NO_RAYS, terms, random_body(rng))[0] == 0


def test_huber_loss_grows_linearly(rng: np.random.Generator) -> None:
    ball = Superquadric([0.05] * 3, [1.0, 1.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    rays, state = rays_to(np.array([[0.0, 0.0, 0.44]]), pinhole=False), State.of(ball)
    residual = 0.01 / SIGMA
    for huber, loss in ((10.0, residual**2), (2.0, 2 * 2.0 * residual - 4.0)):
        assert cost_of(SAMPSON, rays, NO_RAYS, PLAIN._replace(huber=huber), ball)[0] == pytest.approx(loss)
    assert surface_distance(rays, state.parameters, state.rotation)[0] == pytest.approx(0.01)


def test_cost_never_rises_and_reaches_the_truth(rng: np.random.Generator) -> None:
    truth = random_body(rng)
    rays = rays_to(truth.sample_surface(300, rng), pinhole=False)
    step = rng.normal(0, 0.15, STEP_LENGTH) * np.r_[np.ones(5), [0.1] * 3, np.ones(3), [0.0] * 2]
    flat = np.asarray(statement.moved(as_torch(truth), torch.tensor(step)).to_numbers().numpy())
    flat[3:5] = np.clip(flat[3:5], 0.1, 1.0)
    state = State.of(Superquadric.from_flat(flat))
    costs = []
    for _ in range(60):
        state = minimize(SAMPSON, rays, NO_RAYS, PLAIN, state, LIMITS, 1, 0.0)
        costs.append(state.cost)
    assert all(after <= before * (1 + 1e-9) for before, after in itertools.pairwise(costs))
    assert costs[-1] < 1e-4 * costs[0]
    assert np.sort(state.body.size) == pytest.approx(np.sort(truth.size), rel=1e-3)


def test_bounds_hold(rng: np.random.Generator) -> None:
    truth = random_body(rng, (0.4, 0.5))
    rays = rays_to(truth.sample_surface(300, rng), pinhole=False)
    limits = (np.r_[[0.06] * 3, [0.6] * 2, [-1.0] * 3, [0.0] * 2], np.r_[[0.07] * 3, [1.0] * 2, [1.0] * 3, [0.0] * 2])
    state = minimize(SAMPSON, rays, NO_RAYS, PLAIN, State.of(truth), limits, 30, 1e-6)
    assert (state.parameters >= limits[0]).all()
    assert (state.parameters <= limits[1]).all()
    assert np.isfinite(state.cost)


def test_a_body_at_the_end_of_its_valley_takes_no_step(rng: np.random.Generator) -> None:
    """What a step promises tells that it is not worth a look: the body stays as it is, to the bit."""
    truth = random_body(rng, (0.4, 0.8))
    rays = rays_to(truth.sample_surface(300, rng) + rng.normal(0, SIGMA, (300, 3)), pinhole=False)
    there = minimize(SAMPSON, rays, NO_RAYS, PLAIN, State.of(truth), LIMITS, 100, 1e-12)
    again = minimize(SAMPSON, rays, NO_RAYS, PLAIN, there, LIMITS, 100, 1e-6)
    assert again.iterations == there.iterations + 1
    np.testing.assert_array_equal(again.parameters, there.parameters)
    np.testing.assert_array_equal(again.rotation, there.rotation)
    begun = minimize(SAMPSON, rays, NO_RAYS, PLAIN, State.of(truth), LIMITS, 100, 1e-6)
    assert begun.cost == pytest.approx(there.cost, rel=1e-5)


def test_a_search_leaves_its_rays_as_they_were(rng: np.random.Generator) -> None:
    """So that a cost does not depend on which bodies were looked at before."""
    truth = random_body(rng, (0.4, 0.8))
    rays = rays_to(visible_points(truth, rng, pinhole=True), pinhole=True)
    before = rays.copy()
    first, other = (minimize(RENDERED, rays, NO_RAYS, PLAIN, State.of(truth), LIMITS, 5, 1e-6) for _ in range(2))
    np.testing.assert_array_equal(rays, before)
    assert first.cost == other.cost
