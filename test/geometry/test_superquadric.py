"""The superquadric: closed forms against each other, against sampling, and NumPy against torch and numba."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from python_process import run_python

from sq_perception.geometry import Superquadric, kernels, rotation

IDENTITY = np.array([0.0, 0, 0, 1])


def random_bodies(count: int, seed: int, e_low: float = 0.1, e_high: float = 1.9) -> Superquadric:
    rng = np.random.default_rng(seed)
    size, shape = rng.uniform(0.02, 0.4, (count, 3)), rng.uniform(e_low, e_high, (count, 2))
    return Superquadric(size, shape, rng.uniform(-1, 1, (count, 3)), rotation.random(count, rng))


def local(size: list[float], shape: list[float]) -> Superquadric:
    return Superquadric(np.array(size), np.array(shape), np.zeros(3), IDENTITY)


class TestEquation:
    def test_is_the_thesis_formula(self) -> None:
        """Equation 3.7, written out, where no term is extreme."""
        body = local([0.2, 0.3, 0.5], [0.4, 0.8])
        x, y, z = points = np.array([[0.1, 0.2, 0.3], [-0.3, 0.1, -0.2], [0.05, -0.4, 0.6]]).T
        expected = ((x / 0.2) ** 2) ** (1 / 0.8) + ((y / 0.3) ** 2) ** (1 / 0.8)
        expected = expected ** (0.8 / 0.4) + ((z / 0.5) ** 2) ** (1 / 0.4)
        np.testing.assert_allclose(body.inside_outside(points.T), expected, rtol=1e-12)
        np.testing.assert_allclose(body.adjusted_inside_outside(points.T), expected**0.4, rtol=1e-12)

    def test_sphere_and_box_limits(self) -> None:
        sphere = local([2, 2, 2], [1, 1])
        points = np.random.default_rng(0).standard_normal((50, 3))
        np.testing.assert_allclose(sphere.gauge(points), np.linalg.norm(points, axis=1) / 2, rtol=1e-12)
        box = local([1, 2, 3], [0.01, 0.01])
        np.testing.assert_allclose(box.gauge(points), np.abs(points / [1, 2, 3]).max(axis=1), rtol=0.02)

    def test_degree_one(self) -> None:
        bodies = random_bodies(20, 1)
        points = np.random.default_rng(1).standard_normal((20, 30, 3))
        away = bodies.translation[:, None] + 3 * (points - bodies.translation[:, None])
        np.testing.assert_allclose(bodies.gauge(away), 3 * bodies.gauge(points), rtol=1e-9)

    def test_no_overflow_at_the_smallest_exponents(self) -> None:
        body = local([0.1, 0.1, 0.1], [0.01, 0.01])
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            g = body.gauge(np.array([[1e3, 1.0, -2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 5.0], [0.1, 0.1, 0.1]]))
        np.testing.assert_allclose(g, [1e4, 0, 50, 1], rtol=0.01)


class TestSurface:
    @pytest.mark.parametrize(("e_low", "e_high"), [(0.1, 1.0), (0.01, 0.1), (1.0, 2.0)])
    def test_parametric_points_satisfy_the_equation(self, e_low: float, e_high: float) -> None:
        bodies = random_bodies(20, 2, e_low, e_high)
        rng = np.random.default_rng(3)
        points = bodies.parametric_points(rng.uniform(-np.pi / 2, np.pi / 2, 100), rng.uniform(-np.pi, np.pi, 100))
        np.testing.assert_allclose(bodies.gauge(points), 1, atol=1e-9)

    def test_samples_are_uniform_in_area(self) -> None:
        """Every face of a long, sharp box gets its share of the area, every octant of a body the same count."""
        box = local([0.1, 0.2, 0.8], [0.02, 0.02])
        on = np.argmax(np.abs(box.sample_surface(20000, np.random.default_rng(6)) / box.size), axis=1)
        area = np.array([0.2 * 0.8, 0.1 * 0.8, 0.1 * 0.2])
        np.testing.assert_allclose(np.bincount(on) / len(on), area / area.sum(), atol=0.01)
        octant = (local([0.1, 0.3, 0.2], [0.3, 0.9]).sample_surface(16000, np.random.default_rng(7)) > 0) @ [1, 2, 4]
        np.testing.assert_allclose(np.bincount(octant) / 2000, 1, atol=0.1)

    def test_normals_are_gradients_of_the_gauge(self) -> None:
        bodies = random_bodies(10, 8, 0.3, 1.7)
        points = bodies.sample_surface(40, np.random.default_rng(9))
        step, numeric = 1e-6, []
        for axis in np.eye(3):
            numeric.append((bodies.gauge(points + step * axis) - bodies.gauge(points - step * axis)) / (2 * step))
        np.testing.assert_allclose(bodies.gauge_gradient(points), np.stack(numeric, axis=-1), rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(np.linalg.norm(bodies.normals(points), axis=-1), 1, atol=1e-12)

    def test_sampson_distance_is_the_distance_nearby(self) -> None:
        bodies = random_bodies(10, 10, 0.5, 1.0)
        points = bodies.sample_surface(40, np.random.default_rng(11))
        away = points + 1e-5 * bodies.normals(points)
        np.testing.assert_allclose(bodies.sampson_distance(away), 1e-5, rtol=0.05)


class TestClosedForms:
    @pytest.mark.parametrize(
        ("shape", "expected"),
        [([1, 1], 4 / 3 * np.pi), ([2, 2], 4 / 3), ([1e-3, 1e-3], 8), ([1e-3, 1], 2 * np.pi), ([1e-3, 2], 4)],
    )
    def test_known_volumes(self, shape: list[float], expected: float) -> None:
        """Ellipsoid, octahedron, box, cylinder and square prism."""
        assert local([0.2, 0.3, 0.5], shape).volume() == pytest.approx(expected * 0.03, rel=3e-3)

    def test_the_volume_is_an_integral(self) -> None:
        bodies = random_bodies(8, 12)
        axis = (np.arange(80) + 0.5) / 40 - 1
        unit = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        for body in bodies:
            inside = body.gauge(body.to_parent(unit * body.size)) <= 1
            assert body.volume() == pytest.approx(inside.sum() * (np.prod(body.size) / 40**3), rel=0.01)

    def test_support_is_the_farthest_surface_point(self) -> None:
        bodies = random_bodies(12, 13)
        rng = np.random.default_rng(14)
        directions = rng.standard_normal((12, 20, 3))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        angles = np.linspace(-np.pi, np.pi, 721)
        eta, omega = (g.ravel() for g in np.meshgrid(angles[180:541:3], angles[::3]))
        points = bodies.parametric_points(eta, omega) - bodies.translation[:, None]
        farthest = (points @ np.swapaxes(directions, 1, 2)).max(axis=1)
        support = bodies.support(directions)
        assert (farthest <= support + 1e-12).all()
        np.testing.assert_allclose(farthest, support, rtol=0.01)

    def test_octahedra_have_the_support_of_their_corners(self) -> None:
        """The dual norm of e = 2 is a maximum; in NumPy, in torch and in kernels."""
        octahedron = local([0.2, 0.3, 0.5], [2.0, 2.0])
        directions = np.array([[1.0, 0, 0], [3, 2, 0], [15, 10, 6], [1, 2, 3]])
        corners = (np.abs(directions) * octahedron.size).max(axis=1)
        found = octahedron.support(directions)
        np.testing.assert_allclose(found, corners, rtol=1e-3)
        tensors = Superquadric.from_flat(torch.from_numpy(octahedron.to_flat().copy()))
        np.testing.assert_allclose(tensors.support(torch.from_numpy(directions)).numpy(), found, rtol=1e-12)
        in_kernels = [kernels.support(*direction, 0.2, 0.3, 0.5, 2.0, 2.0, 0.0, 0.0) for direction in directions]
        np.testing.assert_allclose(in_kernels, found, rtol=1e-6)

    def test_bounding_box_holds_the_samples(self) -> None:
        bodies = random_bodies(10, 15)
        points = bodies.sample_surface(2000, np.random.default_rng(16))
        lower, upper = bodies.bounding_box()
        assert (points >= lower[:, None] - 1e-12).all()
        assert (points <= upper[:, None] + 1e-12).all()


class TestSymmetry:
    def test_eight_forms_are_one_body(self) -> None:
        bodies = random_bodies(20, 17)
        forms = bodies.equivalent_forms()
        assert forms.batch_shape == (8, 20)
        points = np.random.default_rng(18).uniform(-1, 1, (20, 100, 3))
        expected = np.broadcast_to(bodies.gauge(points), (8, 20, 100))
        np.testing.assert_allclose(forms.gauge(points), expected, rtol=1e-9)
        flat = np.round(forms.to_flat() * np.sign(forms.rotation[..., 3:]), 9)
        assert all(len(np.unique(flat[:, k], axis=0)) == 8 for k in range(20))

    def test_canonical_form_is_the_same_for_all_eight(self) -> None:
        bodies = random_bodies(50, 19)
        expected = bodies.canonical_form().to_flat()
        for form in bodies.equivalent_forms():
            np.testing.assert_allclose(form.canonical_form().to_flat(), expected, atol=1e-9)
        assert (expected[:, 0] >= expected[:, 1]).all()
        assert (expected[:, 11] >= 0).all()

    def test_rigid_motion_and_scale_move_the_gauge_along(self) -> None:
        bodies = random_bodies(10, 20)
        rng = np.random.default_rng(21)
        q, t = rotation.random(1, rng)[0], rng.standard_normal(3)
        points = rng.uniform(-1, 1, (10, 30, 3))
        moved = 2.5 * points @ rotation.to_matrix(q).T + t
        np.testing.assert_allclose(bodies.transformed(q, t, 2.5).gauge(moved), bodies.gauge(points), rtol=1e-9)


class TestTorch:
    def test_equals_numpy(self) -> None:
        bodies = random_bodies(10, 22)
        tensors = Superquadric.from_flat(torch.tensor(bodies.to_flat()))
        points = np.random.default_rng(23).uniform(-1, 1, (10, 40, 3))
        for name in ("gauge", "inside_outside", "gauge_gradient", "support"):
            value = getattr(tensors, name)(torch.tensor(points)).numpy()
            np.testing.assert_allclose(value, getattr(bodies, name)(points), rtol=1e-9, err_msg=name)

    def test_gradcheck(self) -> None:
        bodies = random_bodies(4, 24, 0.3, 1.7)
        flat = torch.tensor(bodies.to_flat(), requires_grad=True)
        points = torch.tensor(bodies.sample_surface(5, np.random.default_rng(25)))
        assert torch.autograd.gradcheck(lambda f: Superquadric.from_flat(f).gauge(points), flat)

    @pytest.mark.parametrize("e", [0.01, 0.1, 1.0, 2.0])
    def test_gradients_are_finite_on_axes_planes_and_centre(self, e: float) -> None:
        flat = torch.tensor([[0.2, 0.2, 0.2, e, e, 0, 0, 0, 0, 0, 0, 1.0]], requires_grad=True)
        grid = torch.tensor([-0.2, 0.0, 0.2, 5.0])
        points = torch.cartesian_prod(grid, grid, grid)[None].requires_grad_()
        Superquadric.from_flat(flat).occupancy(points, 10.0).sum().backward()
        assert torch.isfinite(flat.grad).all()
        assert torch.isfinite(points.grad).all()


class TestKernels:
    def test_rays_meet_the_surface(self) -> None:
        rng = np.random.default_rng(28)
        hits = 0
        for body in random_bodies(200, 29, 0.05, 2.0):
            origin, direction = rng.standard_normal(3), rng.standard_normal(3)
            direction -= 0.8 * (origin + direction)
            form = *body.size, *body.shape, 0.0, 0.0
            hit, first, last = kernels.ray_interval(tuple(origin), tuple(direction), form)
            t = np.linspace(-5, 10, 4001)
            moved = Superquadric(body.size, body.shape, np.zeros(3), IDENTITY)
            g = moved.gauge(origin + t[:, None] * direction)
            if not hit:
                assert g.min() > 1 - 1e-3
                continue
            hits += 1
            ends = moved.gauge(origin + np.array([[first], [last]]) * direction)
            np.testing.assert_allclose(ends, 1, atol=1e-6)
            assert first <= last
            assert ((g < 1 - 1e-9) <= ((t >= first) & (t <= last))).all()
        assert hits > 20


class TestMisuse:
    @pytest.mark.parametrize(
        ("field", "value", "message"),
        [
            ("size", [1, 2], r"size: expected shape"),
            ("size", [1, 2, 0], "positive half sizes"),
            ("size", [1, 2, np.nan], "finite"),
            ("shape", [0.5, 2.5], "exponents"),
            ("shape", [0.0, 1.0], "exponents"),
            ("translation", [0, np.inf, 0], "finite"),
            ("rotation", [0, 0, 0, 0], "non-zero, finite length"),
            ("rotation", [0, 0, 0, 1e300], "non-zero, finite length"),
        ],
    )
    @pytest.mark.parametrize("batch", [(), (2,)])
    def test_says_what_was_expected(self, batch: tuple[int, ...], field: str, value: list[float], message: str) -> None:
        good = {"size": [1, 1, 1], "shape": [1, 1], "translation": [0, 0, 0], "rotation": [0, 0, 0, 1]}
        with pytest.raises(ValueError, match=message):
            Superquadric(**{**good, field: np.broadcast_to(np.array(value, dtype=float), (*batch, len(value)))})

    def test_flat_vectors_have_twelve_numbers(self) -> None:
        with pytest.raises(ValueError, match=r"\(\.\.\., 12\)"):
            Superquadric.from_flat(np.zeros(11))

    @pytest.mark.parametrize("index", [0, slice(None, None, -1), None])
    def test_a_single_body_has_no_parts(self, index: object) -> None:
        with pytest.raises(TypeError, match="a single Superquadric"):
            local([1, 2, 3], [1, 1])[index]


def test_kept_machine_code_is_bound_to_all_kernel_sources(tmp_path: Path) -> None:
    """A kernel compiled into another module's function: after an edit of its file alone, the new code must run."""
    package = tmp_path / "sq_perception"
    source = Path(kernels.__file__).parents[1]
    for name in ("files", "geometry"):
        shutil.copytree(source / name, package / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(source / "__init__.py", package)
    program = (
        "import numpy as np; from sq_perception.geometry.metrics import _column;"
        "body = np.append(np.ones(5), np.zeros(9));"
        "print(_column(body, np.eye(3), 0.0, 0.0, -2.0, 0.5, 9))"
    )
    edited = package / "geometry" / "kernels.py"
    answers = []
    for _ in range(2):
        answers.append(run_python("-c", program, cwd=tmp_path).stdout.strip())
        edited.write_text(edited.read_text().replace("return hit, first, -last", "return hit, first, first"))
    assert answers == ["(2, 6)", "(2, 2)"]


@pytest.mark.parametrize("batch", [(), (2,)])
def test_bodies_cannot_be_written_to(batch: tuple[int, ...]) -> None:
    given = np.full((*batch, 3), 0.1)
    body = Superquadric(given, np.ones((*batch, 2)), np.zeros((*batch, 3)), np.full((*batch, 4), 0.5))
    for part in (body.size, body.shape, body.translation, body.rotation):
        with pytest.raises(ValueError, match="read-only"):
            part[...] = 0.0
    given[...] = 0.2  # the caller's own array stays his
