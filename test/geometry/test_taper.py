"""Tapered superquadrics: closed forms, frusta, numerical derivatives, rays against a dense mesh, the two statements."""

import numpy as np
import pytest
from numba import njit
from scipy.spatial import cKDTree

from sq_perception import Camera, Superquadric, mesh
from sq_perception.geometry import kernels
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.imaging import raycast

SHARP = 0.01


def tapered(rng: np.random.Generator, largest: float = 0.8) -> Superquadric:
    size, shape, taper = rng.uniform(0.02, 0.08, 3), rng.uniform(0.1, 1, 2), rng.uniform(-largest, largest, 2)
    return Superquadric(size, shape, rng.normal(0, 0.1, 3), quaternions.random(1, rng)[0], taper)


def form_of(body: Superquadric) -> tuple[float, ...]:
    return tuple(float(x) for x in [*body.size, *body.shape, *body.taper])


def test_a_sharp_tapered_body_is_a_frustum() -> None:
    body = Superquadric.at_origin(np.array([2.0, 1.0, 3.0]), np.full(2, SHARP), np.array([0.5, -0.25]))
    corners = np.array([[x * (1 + 0.5 * z), y * (1 - 0.25 * z), z] for x in (-2, 2) for y in (-1, 1) for z in (-1, 1)])
    corners *= [1, 1, 3]
    directions = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(body.support(directions), (directions @ corners.T).max(axis=1), rtol=0.02)
    lower, upper = body.bounding_box()
    np.testing.assert_allclose((lower, upper), ([-3, -1.25, -3], [3, 1.25, 3]), rtol=1e-2)
    # A frustum: h/6 (A1 + 4 Am + A2), of full sections.
    assert body.volume() == pytest.approx(6 / 6 * (2 * 2.5 + 4 * 8 + 6 * 1.5), rel=0.02)


def test_surface_points_have_gauge_one_and_reach_as_far_as_the_support() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        body = tapered(rng)
        points = body.sample_surface(4000, rng)
        np.testing.assert_allclose(body.gauge(points), 1.0, atol=1e-9)
        directions = rng.normal(size=(20, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        reach = (directions @ (points - body.translation).T).max(axis=1)
        support = body.support(directions)
        assert (reach <= support + 1e-12).all()
        assert (support - reach < 0.1 * body.size.max()).all()
        local = directions @ body.rotation_matrix
        compiled = [kernels.support(*map(float, n), *form_of(body)) for n in local]
        np.testing.assert_allclose(compiled, support, rtol=1e-9)


def test_the_volume_is_that_of_a_dense_mesh() -> None:
    rng = np.random.default_rng(2)
    for _ in range(5):
        body = tapered(rng)
        assert mesh(body, 160).volume == pytest.approx(float(body.volume()), rel=0.01)


@pytest.mark.parametrize("name", ["gauge", "support"])
def test_derivatives_are_those_of_differences(name: str) -> None:
    value, derivatives = getattr(kernels, name), getattr(kernels, f"{name}_derivatives")
    rng = np.random.default_rng(3)
    for k in range(200):
        point = rng.normal(size=3)
        if name == "gauge" and k % 4 == 0:  # in a plane of symmetry
            point[rng.integers(3)] = 0.0
        shape = rng.uniform(0.2, 1.6 if name == "gauge" else 1.0, 2)
        at = np.array([*point, *rng.uniform(0.5, 1.5, 3), *shape, *rng.uniform(-0.7, 0.7, 2)])
        found = derivatives(*at)
        assert found[0] == pytest.approx(value(*at), rel=1e-12)
        for slope, k in zip(found[1:], [0, 1, 2, 6, 7, 8, 9], strict=True):
            step = 1e-6 * (np.arange(10) == k)
            assert slope == pytest.approx((value(*(at + step)) - value(*(at - step))) / 2e-6, abs=2e-6)


def test_the_gradient_is_that_of_the_kernel() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        body = tapered(rng)
        local = Superquadric.at_origin(body.size, body.shape, body.taper)
        points = rng.normal(size=(20, 3)) * body.size
        compiled = [kernels.gauge_derivatives(*map(float, p), *form_of(body))[:4] for p in points]
        found = np.column_stack([local.gauge(points), local.gauge_gradient(points)])
        np.testing.assert_allclose(found, compiled, rtol=1e-8, atol=1e-8)


def test_rays_meet_the_body_where_they_meet_a_dense_mesh() -> None:
    rng = np.random.default_rng(5)
    camera = Camera(120, 90, 110.0, 110.0, 59.5, 44.5)
    for _ in range(6):
        body = tapered(rng, largest=0.9)
        body = body.transformed(np.array([0, 0, 0, 1.0]), np.array([0, 0, 0.4]) - body.translation)
        depth, _ = raycast.render(body, camera)
        hit = np.isfinite(depth)
        points = camera.points(np.where(hit, depth, 1.0))[hit]
        np.testing.assert_allclose(body.gauge(points), 1.0, atol=1e-8)
        # No point before the hit is inside, and no ray that misses passes through the body.
        for share in np.linspace(0.3, 0.999, 60):
            before = camera.points(np.where(hit, share * depth, share * 0.6))
            assert (body.gauge(before.reshape(-1, 3)) >= 1 - 1e-9).all()
        distance, _ = cKDTree(mesh(body, 96).sample(100000, seed=0)).query(points[::10])
        assert distance.max() < 0.03 * body.size.max()


@njit
def first_hits(points: np.ndarray, form: tuple[float, ...]) -> np.ndarray:
    """Where rays from a camera far down x meet the body that they lead to points (n, 3) of, as shares of the way."""
    shares = np.empty(len(points))
    origin = np.array([-2.0, 0.1, 0.2])
    for i in range(len(points)):
        x, y, z = points[i] - origin
        hit, share = kernels.ray_entry((origin[0], origin[1], origin[2]), (x, y, z), form)
        shares[i] = share if hit else np.inf
    return shares


def test_a_million_rays_to_a_dense_surface_meet_it_there_or_before() -> None:
    """No ray passes through a body unseen, and what it meets is the surface."""
    rng = np.random.default_rng(8)
    for _ in range(8):
        body = tapered(rng, largest=0.9)
        body = Superquadric.at_origin(body.size, body.shape, body.taper)
        angles = rng.uniform([-np.pi / 2, -np.pi], [np.pi / 2, np.pi], (125_000, 2))
        points = np.asarray(body.parametric_points(angles[:, 0], angles[:, 1])).reshape(-1, 3)
        shares = first_hits(points, form_of(body))
        # An edge that a ray grazes by less than the sampling's error may be missed.
        assert np.mean(~(shares < 1 + 1e-6)) < 1e-4
        origin = np.array([-2.0, 0.1, 0.2])
        hit = np.isfinite(shares)
        met = origin + shares[hit, None] * (points[hit] - origin)
        np.testing.assert_allclose(body.gauge(met), 1.0, atol=1e-6)


def test_the_support_is_the_largest_of_all_sections() -> None:
    """Octahedra with unequal tapers too, whose sections have several maxima."""
    rng = np.random.default_rng(1)
    t = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 20001))
    for _ in range(100):
        shape, size, taper = rng.uniform(0.03, 2, 2), rng.uniform(0.02, 0.1, 3), rng.uniform(-0.9, 0.9, 2)
        body = Superquadric(size, shape, np.zeros(3), [0.0, 0.0, 0.0, 1.0], taper)
        ways = rng.normal(size=(20, 3))
        across = np.abs(ways[:, :2, None]) * size[:2, None] * (1 + taper[:, None] * t)
        dual = 2 / max(2 - shape[1], 1e-3)
        largest = across.max(axis=1)
        sections = largest * ((across / largest[:, None]) ** dual).sum(axis=1) ** (1 / dual)
        reach = ways[:, 2:] * size[2] * t + (1 - np.abs(t) ** (2 / shape[0])) ** (shape[0] / 2) * sections
        np.testing.assert_allclose(body.support(ways), reach.max(axis=1), rtol=1e-5)
        if (shape <= 1).all():
            compiled = [kernels.support(*way, *size, *shape, *taper) for way in ways]
            np.testing.assert_allclose(compiled, reach.max(axis=1), rtol=1e-5)


def test_all_forms_are_the_same_body_and_the_untapered_one_encloses_it() -> None:
    rng = np.random.default_rng(6)
    body = tapered(rng)
    points = body.sample_surface(200, rng)
    for form in [*body.equivalent_forms(), body.canonical_form(), Superquadric.stack([body]).canonical_form()[0]]:
        np.testing.assert_allclose(form.gauge(points), 1.0, atol=1e-9)
    rng = np.random.default_rng(7)
    body = tapered(rng)
    around = body.untapered()
    assert not around.is_tapered
    assert (around.gauge(body.sample_surface(2000, rng)) <= 1 + 1e-9).all()
    axes = np.concatenate([body.rotation_matrix.T, -body.rotation_matrix.T])
    np.testing.assert_allclose(around.support(axes) >= body.support(axes) - 1e-12, True)
    np.testing.assert_allclose(around.with_taper(body.taper).to_numbers(), body.to_numbers())


def test_iou_counts_the_taper() -> None:
    body = Superquadric.at_origin(np.full(3, 0.1), np.full(2, 0.1), np.array([0.5, 0.5]))
    straight = Superquadric.at_origin(np.full(3, 0.1), np.full(2, 0.1))
    assert volume_iou(body, body) == 1.0
    # The straight body has the tapered one inside below, and is inside it above: frusta of sections 1/4, 1 and 9/4.
    below, above = (0.25 + 0.5 + 1) / 3, (1 + 1.5 + 2.25) / 3
    assert float(volume_iou(body, straight, 96)) == pytest.approx((below + 1) / (1 + above), abs=0.02)


def test_flat_parameters_refuse_a_taper() -> None:
    body = Superquadric.at_origin(np.ones(3), np.ones(2), np.array([0.1, 0.0]))
    with pytest.raises(ValueError, match="to_numbers"):
        body.to_flat()
    np.testing.assert_array_equal(Superquadric.from_flat(body.to_numbers()).taper, [0.1, 0.0])


@pytest.mark.parametrize("taper", [[1.0, 0.0], [0.0, np.nan], [0.0, -0.96]])
def test_impossible_tapers_are_refused(taper: list[float]) -> None:
    with pytest.raises(ValueError, match="taper"):
        Superquadric.at_origin(np.ones(3), np.ones(2), np.array(taper))
