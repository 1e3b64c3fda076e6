"""A predicted support function in the fit: its derivatives, and the unseen side that it tells."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sq_perception.fitting import priors, quality, surface_fit
from sq_perception.fitting.cost import RAY_COLUMNS, STEP_LENGTH, Rays, Terms
from sq_perception.fitting.levenberg_marquardt import State, minimize, move
from sq_perception.fitting.observation import Crop
from sq_perception.fitting.priors import MODEL_SHARE, HullPrior, prior_cost
from sq_perception.fitting.quality import covariance_at
from sq_perception.fitting.surface_fit import FitOptions
from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import DIRECTIONS
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
BODY = Superquadric([0.03, 0.04, 0.06], [0.3, 0.6], [0.01, -0.02, 0.5], [0.3, 0.2, -0.1, 0.9])


def told(body: Superquadric, sigma: float) -> HullPrior:
    """The support function of a body, each direction with the same deviation in metres."""
    support = DIRECTIONS @ body.translation + body.support(DIRECTIONS)
    return HullPrior(DIRECTIONS, support, sigma**2 * np.eye(len(DIRECTIONS)), 0.1)


def terms_of(prior: HullPrior) -> Terms:
    return Terms(
        hull_directions=np.array(prior.directions),
        hull_support=prior.support,
        hull_root=prior.root,
        hull_freedom=float(prior.freedom),
    )


def test_the_root_whitens_what_was_predicted_and_what_no_superquadric_reaches(rng: np.random.Generator) -> None:
    spread = rng.normal(size=(42, 42))
    prior = HullPrior(DIRECTIONS, np.zeros(42), 1e-5 * spread @ spread.T, 0.2)
    whole = prior.covariance + (MODEL_SHARE * 0.2) ** 2 * np.eye(42)
    assert prior.root @ whole @ prior.root.T == pytest.approx(np.eye(42), abs=1e-8)


def test_a_bottle_is_as_long_wide_and_high_as_its_hull_is_predicted() -> None:
    up = np.array([0.0, -0.8, -0.6])
    turn = rotation.from_matrix(np.stack([[1.0, 0.0, 0.0], np.cross(up, [1.0, 0.0, 0.0]), up], axis=1))
    parts = [
        Superquadric(np.array(size), np.array([0.2, 0.6]), np.array([0.0, 0.0, 0.6]) + height * up, turn)
        for size, height in (((0.045, 0.03, 0.05), 0.05), ((0.035, 0.024, 0.02), 0.11), ((0.015, 0.015, 0.03), 0.15))
    ]
    rendered, index = raycast.render(Superquadric.stack(parts), CAMERA)
    mask, plane = index >= 0, np.append(up, 0.36)
    depth = np.where(mask, rendered, plane_depth(plane, CAMERA)).astype(np.float32)
    support = np.max([DIRECTIONS @ part.translation + part.support(DIRECTIONS) for part in parts], axis=0)
    hull = HullPrior(DIRECTIONS, support, 0.01**2 * np.eye(len(DIRECTIONS)), 0.18)
    found = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane, model_error=0.0025, hull=hull))
    body = found.superquadric
    ends = body.rotation_matrix.T
    half = np.sort(body.support(ends) + body.support(-ends)) / 2
    np.testing.assert_allclose(half, [0.03, 0.045, 0.09], atol=0.004)
    # It tapers towards the neck, and knows how much.
    along = np.sign(body.rotation_matrix[:, 2] @ up) * body.taper
    assert (along < -0.15).all()
    assert (np.abs(along) > 2 * found.sigma_taper).all()


def test_the_true_body_costs_nothing_and_others_by_their_distance() -> None:
    prior, sums = told(BODY, 0.004), np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    state = State.of(BODY)
    assert prior_cost(terms_of(prior), state.parameters, state.rotation, sums) == pytest.approx(0.0, abs=1e-12)
    moved = state.parameters.copy()
    moved[5] += 0.01
    error = prior.root @ (DIRECTIONS[:, 0] * 0.01)
    assert prior_cost(terms_of(prior), moved, state.rotation, sums) == pytest.approx(float(error @ error))


@pytest.mark.parametrize("taper", [(0.0, 0.0), (0.3, -0.4)])
def test_the_gradient_is_that_of_the_cost(taper: tuple[float, float]) -> None:
    terms = terms_of(told(BODY, 0.004))._replace(taper_stiffness=3.0)
    state = State.of(Superquadric([0.035, 0.03, 0.05], [0.5, 0.4], [0.0, -0.01, 0.51], [0.2, 0.3, -0.1, 0.9], taper))
    sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    prior_cost(terms, state.parameters, state.rotation, sums)
    wide = (np.full(10, -10.0), np.full(10, 10.0))
    spare = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    for k in range(STEP_LENGTH):
        costs = []
        for sign in (1, -1):
            step = np.zeros(STEP_LENGTH)
            step[k] = sign * 1e-6
            parameters, rotation = np.empty(10), np.empty((3, 3))
            move(state.parameters, state.rotation, step, *wide, parameters, rotation)
            costs.append(prior_cost(terms, parameters, rotation, spare))
        slope = (costs[0] - costs[1]) / 2e-6
        assert 2 * sums[STEP_LENGTH, k] == pytest.approx(slope, rel=1e-4, abs=1e-4)


@pytest.fixture(scope="module")
def rays_of_body() -> Rays:
    shown, _ = raycast.render(BODY, CAMERA)
    crop = Crop.around(shown, np.isfinite(shown), CAMERA, 0.002)
    assert crop is not None
    return Rays(crop.observe(0.0, None).object_rays(200), np.empty((0, RAY_COLUMNS)))


def covariance_of(state: State, rays: Rays, terms: Terms) -> np.ndarray:
    outline = terms._replace(outline_stiffness=1 / 0.002)
    return covariance_at(*rays, outline, state.parameters, state.rotation)


def test_a_body_beside_its_predicted_hull_is_as_much_less_sure(rays_of_body: Rays) -> None:
    """Every end of it is 3 mm off; what the rays say of it stays as sure as it is."""
    prior, state = told(BODY, 0.004), State.of(BODY)
    beside = replace(prior, support=prior.support + 0.003)
    on, off = (covariance_of(state, rays_of_body, terms_of(hull)) for hull in (prior, beside))
    more = np.zeros(11)
    more[[0, 1, 2, 5, 6, 7]] = 0.003**2
    assert off - on == pytest.approx(np.diag(more), abs=1e-12)


def test_the_farther_off_the_vaguer_a_hull_of_long_tails(rays_of_body: Rays) -> None:
    prior, state = told(BODY, 0.004), State.of(BODY)
    beside = replace(prior, support=prior.support + 0.003, freedom=3.0)
    square = float(np.square(prior.root @ np.full(len(DIRECTIONS), 0.003)).sum())
    root = beside.root / math.sqrt(1 + square / 3.0)
    vaguer = terms_of(beside)._replace(hull_root=root, hull_freedom=math.inf)
    found = covariance_of(state, rays_of_body, terms_of(beside))
    assert found == pytest.approx(covariance_of(state, rays_of_body, vaguer), rel=1e-6, abs=1e-12)


@pytest.fixture(scope="module")
def box_from_the_front() -> tuple[np.ndarray, np.ndarray, Superquadric, np.ndarray]:
    """A box that shows its front and a little of its top; its depth, 60 mm, is for the prediction to tell."""
    tilt = math.radians(12.0)
    normal = np.array([0.0, -math.cos(tilt), -math.sin(tilt)])
    axes = np.stack([[1.0, 0.0, 0.0], np.cross(normal, [1.0, 0.0, 0.0]), normal], axis=1)
    body = Superquadric([0.04, 0.03, 0.06], [0.1, 0.1], [0.0, 0.02, 0.55], rotation.from_matrix(axes))
    plane = np.append(normal, -normal @ (body.translation - 0.06 * normal))
    shown, _ = raycast.render(body, CAMERA)
    mask = np.isfinite(shown)
    noise = np.random.default_rng(5).normal(0, 0.002, shown.shape)
    # Round corners and a bulge, as no superquadric has them.
    bulge = 0.004 * np.cos(np.linspace(-1.5, 1.5, shown.shape[1]))[None]
    return np.where(mask, shown + noise - bulge, 1.5).astype(np.float32), mask, body, plane


@pytest.mark.parametrize("deep", [0.02, 0.03, 0.05])
def test_a_prediction_tells_the_depth_behind_a_front(box_from_the_front, deep) -> None:
    depth, mask, body, plane = box_from_the_front
    front = body.translation[2] - 0.03
    told_body = Superquadric([0.04, deep, 0.06], body.shape, [*body.translation[:2], front + deep], body.rotation)
    options = FitOptions(plane=plane, model_error=0.0025, hull=told(told_body, 0.004))
    found = surface_fit.fit(depth, mask, CAMERA, options=options)
    reach = found.superquadric.support(np.array([[0.0, 0.0, 1.0]]))[0]
    assert reach == pytest.approx(float(told_body.support(np.array([[0.0, 0.0, 1.0]]))[0]), abs=0.007)
    assert found.superquadric.support(plane[None, :3])[0] == pytest.approx(0.06, abs=0.005)


def test_a_vague_prediction_leaves_the_size_open(box_from_the_front) -> None:
    """What is predicted less surely comes out less surely: the deviation is that of the posterior."""
    depth, mask, body, plane = box_from_the_front
    widest = []
    for sigma in (0.003, 0.03):
        options = FitOptions(plane=plane, model_error=0.0025, hull=told(body, sigma))
        widest.append(surface_fit.fit(depth, mask, CAMERA, options=options).sigma_size.max())
    assert widest[1] > 1.5 * widest[0]


def test_a_thing_that_floats_is_fitted_as_one_on_a_plane_is(box_from_the_front, monkeypatch) -> None:
    """No superquadric explains it: none is sought from everywhere, and its far side is the predicted one."""
    _, mask, body, _ = box_from_the_front
    shown, _ = raycast.render(body, CAMERA)
    dents = 0.004 * np.sin(np.linspace(0, 40, shown.shape[1]))[None]
    depth = np.where(mask, shown + dents, 1.5).astype(np.float32)
    tried, states = [], surface_fit.starts.states
    monkeypatch.setattr(surface_fit.starts, "states", lambda *given: tried.append(given) or states(*given))
    found = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(hull=told(body, 0.004)))
    assert len(tried) <= 1
    ahead = np.array([[0.0, 0.0, 1.0]])
    far = found.superquadric.translation[2] + found.superquadric.support(ahead)[0]
    assert far == pytest.approx(body.translation[2] + body.support(ahead)[0], abs=0.007)
    assert found.superquadric.size.max() == pytest.approx(0.06, abs=0.01)


def test_a_thing_cut_short_is_no_surer_than_one_with_time(box_from_the_front) -> None:
    """What no superquadric fits counts as fewer rays, whether or not there is time to go on."""
    depth, mask, body, plane = box_from_the_front
    dents = 0.012 * np.sin(np.linspace(0, 40, depth.shape[1], dtype=np.float32))
    options = FitOptions(plane=plane, model_error=0.0025, hull=told(body, 0.02))
    patient, hasty = (
        surface_fit.fit(depth + dents * mask, mask, CAMERA, options=replace(options, time_budget=budget))
        for budget in (math.inf, 1e-9)
    )
    assert "time budget" in hasty.message
    by_length = [fit.sigma_size[np.argsort(fit.superquadric.size)] for fit in (hasty, patient)]  # z may be another axis
    assert (by_length[0] > 0.9 * by_length[1]).all()


def test_no_form_of_a_hull_is_compiled_for(box_from_the_front) -> None:
    """A camera would wait for it: 12 s for single precision and read only arrays, 2 s for a whole number."""
    depth, mask, body, plane = box_from_the_front
    usual = told(body, 0.004)
    single = replace(usual, directions=usual.directions.astype(np.float32), support=usual.support.astype(np.float32))
    fixed = replace(usual, support=usual.support.copy(), freedom=3)
    fixed.support.flags.writeable = False
    forms = []
    for hull in (usual, single, fixed):
        surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane, model_error=0.0025, hull=hull))
        forms.append([len(form.signatures) for form in (minimize, quality.covariance_at, priors.hull_distances)])
    assert forms[0] == forms[1] == forms[2]
