"""Losses and soft images: hand-computed values, limits, what they cannot tell apart, gradients, bodies they find."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from unit_axis import cell_centres, grid, soft_images

from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.imaging import soft_render, unit_cube
from sq_perception.learning import losses
from sq_perception.learning.choices import LOSSES, UNSUPERVISED
from sq_perception.learning.losses import Objective
from sq_perception.simulation.rendering import render_views
from sq_perception.simulation.scenes import thesis_bodies

IDENTITY = [0.0, 0.0, 0.0, 1.0]
DOUBLE = torch.float64


def tensors(bodies: Superquadric) -> Superquadric:
    return Superquadric.from_flat(torch.tensor(bodies.to_flat()))


def body(*flat: float) -> Superquadric:
    return Superquadric.from_flat(torch.tensor([flat], dtype=DOUBLE))


def turned(angles: np.ndarray, axis: list[float], flat: list[float]) -> Superquadric:
    """One body (a, e, t) turned about an axis through its centre."""
    q = np.concatenate([np.sin(angles / 2)[:, None] * np.array(axis), np.cos(angles / 2)[:, None]], axis=1)
    return tensors(Superquadric.from_flat(np.concatenate([np.tile(flat, (len(angles), 1)), q], axis=1)))


class TestParameterLoss:
    def test_hand_computed(self) -> None:
        truth = body(0.2, 0.3, 0.4, 0.5, 0.6, 0.5, 0.5, 0.5, *IDENTITY)
        guess = body(0.3, 0.3, 0.4, 0.5, 0.8, 0.5, 0.5, 0.5, 0.0, 0.0, 1.0, 0.0)
        assert losses.parameter_loss(guess, truth).item() == pytest.approx((0.1**2 + 0.2**2) / 8)

    def test_a_training_minimises_it_and_validates_with_the_true_rotation(self) -> None:
        truth, guess = (tensors(thesis_bodies(4, np.random.default_rng(seed))) for seed in (3, 4))
        objective = Objective("mse")
        found = objective.loss(guess, torch.zeros(4, 1, 16, 16), truth, 0.5, torch.Generator())
        torch.testing.assert_close(found, losses.parameter_loss(guess, truth))
        shown = objective.with_given(guess, truth)
        assert (shown.rotation == truth.rotation).all()
        assert (shown.size == guess.size).all()


class TestOccupancyLoss:
    def test_hand_computed(self) -> None:
        """One point: at the centre of the truth (G = sigma(s)) and on the prediction's surface (G = 1/2)."""
        truth, moved = (body(0.2, 0.2, 0.2, 1, 1, x, 0, 0, *IDENTITY) for x in (0.0, 0.2))
        loss = losses.occupancy_loss(moved, truth, torch.zeros(1, 1, 3, dtype=DOUBLE), 3.0)
        assert loss.item() == pytest.approx((1 / (1 + np.exp(-3)) - 0.5) ** 2, rel=1e-5)


class TestDualLoss:
    POINTS = grid(24)

    def test_is_the_sum_of_its_parts_and_sees_each_parameter_in_one_of_them(self) -> None:
        truth, guess = (tensors(thesis_bodies(4, np.random.default_rng(seed))) for seed in (1, 2))
        dual = losses.dual_loss(guess, truth, self.POINTS, 10.0)
        rotation = losses.rotation_loss(guess, truth, self.POINTS, 10.0)
        torch.testing.assert_close(dual, losses.parameter_loss(guess, truth) + rotation)
        same_rotation = Superquadric(guess.size, guess.shape, guess.translation, truth.rotation)
        assert losses.rotation_loss(same_rotation, truth, self.POINTS, 10.0).max() == 0
        same_rest = losses.turn_truth(guess, truth)
        assert losses.parameter_loss(same_rest, truth).max() == 0
        torch.testing.assert_close(rotation, losses.occupancy_loss(same_rest, truth, self.POINTS, 10.0))

    def test_figure_6_2_is_the_same_curve_for_equal_sizes(self) -> None:
        """Turned for 360 degrees about each axis: zero at 0, 180 and 360, largest at 90 and 270, y > z > x."""
        flat = [0.1, 0.2, 0.3, 1, 1, 0.5, 0.5, 0.5]
        angles = np.deg2rad(np.arange(0, 361, 15))
        peaks = []
        for axis in np.eye(3).tolist():
            still = turned(0 * angles, axis, flat)
            curve, occupancy = (
                loss(turned(angles, axis, flat), still, self.POINTS, 20.0)
                for loss in (losses.dual_loss, losses.occupancy_loss)
            )
            torch.testing.assert_close(curve, occupancy)
            np.testing.assert_allclose(curve[[0, 12, 24]], 0, atol=1e-12)
            assert 5 <= curve[:13].argmax() <= 7
            assert 5 <= curve[12:].argmax() <= 7
            peaks.append(float(curve.max()))
        assert peaks[1] > peaks[2] > peaks[0]

    def test_a_box_with_its_axes_exchanged_is_a_trap(self) -> None:
        """Figure 6.4: with the sizes given, the loss has a valley at a quarter turn from the truth that is not zero."""
        flat = [0.2, 0.25, 0.3, 0.1, 0.1, 0.5, 0.5, 0.5]
        angles = np.deg2rad(np.arange(0, 181, 10))
        still, points = turned(0 * angles, [1, 0, 0], flat), grid(40)
        curve = losses.rotation_loss(turned(angles, [1, 0, 0], flat), still, points, 20.0)
        assert 0.02 < curve[7:12].min() < 0.85 * min(curve[:7].max(), curve[12:].max())

    def test_only_occupancy_accepts_the_other_order_of_the_axes(self) -> None:
        """All 8 forms are the same body, but L_DUAL and L_OC(q) accept only the 4 that keep a1 and a2 apart."""
        bodies = thesis_bodies(5, np.random.default_rng(3))
        truth = tensors(bodies)
        for k, form in enumerate(bodies.equivalent_forms()):
            guess = tensors(form)
            assert losses.occupancy_loss(guess, truth, self.POINTS, 10.0).max() < 1e-18
            for loss in (losses.dual_loss, losses.rotation_loss):
                value = loss(guess, truth, self.POINTS, 10.0)
                assert value.max() < 1e-18 if k < 4 else value.min() > 1e-6


class TestLeastSquares:
    def test_hand_computed(self) -> None:
        """A sphere of radius 0.2: points on it and at 1.5 radii (F^e1 - 1 = 1.25); background does not count."""
        sphere = body(0.2, 0.2, 0.2, 1, 1, 0.5, 0.5, 0.5, *IDENTITY)
        lines = torch.tensor([[0.5, 0.5], [0.8, 0.5], [0.1, 0.1]], dtype=DOUBLE)
        depth = torch.tensor([[0.7, 0.5, 0.0]], dtype=DOUBLE)
        found = losses.least_squares_loss(sphere, lines, depth).item()
        assert found == pytest.approx(np.sqrt(0.2**3) * 1.25**2 / 2)
        assert losses.least_squares_loss(sphere, lines, torch.zeros_like(depth)).item() == 0, "an empty view"

    def test_only_free_space_minds_what_lies_behind_the_points(self) -> None:
        """One face of a box, and the same face on a box twice as wide: the points lie on both."""
        narrow, wide = (body(a, 0.2, 0.2, 0.1, 0.1, 0.5, 0.5, 0.5, *IDENTITY) for a in (0.2, 0.4))
        steps = torch.linspace(0.05, 0.95, 19, dtype=DOUBLE)
        lines = torch.cartesian_prod(steps, steps)
        depth = torch.where((lines - 0.5).abs().amax(dim=-1) < 0.18, 0.7, 0.0)[None].double()
        for box in (narrow, wide):
            assert losses.least_squares_loss(box, lines, depth).item() < 2e-4
        assert losses.free_space_loss(narrow, lines, depth).item() < 1e-6
        assert losses.free_space_loss(wide, lines, depth).item() > 0.01


class TestRenderLoss:
    def test_hand_computed(self) -> None:
        """A body that no line meets renders to 0, and the loss is the mean of the image."""
        aside = body(0.05, 0.05, 0.05, 1, 1, 0.1, 0.1, 0.5, *IDENTITY)
        lines, depth = torch.tensor([[0.8, 0.8], [0.9, 0.5]], dtype=DOUBLE), torch.tensor([[0.6, 0.0]], dtype=DOUBLE)
        assert losses.render_loss(aside, lines, depth, 100.0, 200.0).item() == pytest.approx(0.3)

    def test_the_voxels_of_the_thesis_agree_with_their_limit(self) -> None:
        images, bodies = render_views(thesis_bodies(4, np.random.default_rng(4)), 48)
        view = torch.tensor(images).double()
        guess = tensors(Superquadric(bodies.size * 1.2, bodies.shape, bodies.translation, bodies.rotation))
        lines, depth = soft_render.of_view(view)
        voxels = voxel_loss(guess, view, 20.0, 40 / 48)
        limit = losses.render_loss(guess, lines, depth, 20.0, 40.0)
        torch.testing.assert_close(voxels, limit, rtol=0.05, atol=0)


def voxel_loss(guess: Superquadric, view: torch.Tensor, sharpness: float, tau: float) -> torch.Tensor:
    """L_DR (n,) as the thesis defines it: views (n, p, p), grids of p^3 voxels."""
    axis = cell_centres(view.shape[-1]).to(view)
    return (view - soft_images(guess, axis, sharpness, tau)).abs().mean(dim=(-2, -1))


def loss_of(name: str, views: torch.Tensor, truth: Superquadric) -> Callable[[torch.Tensor], torch.Tensor]:
    objective = Objective(name, points=40, stride=8)

    def loss(flat: torch.Tensor) -> torch.Tensor:
        generator = torch.Generator().manual_seed(0)
        labels = truth if objective.needs_labels else None
        return objective.loss(Superquadric.from_flat(flat), views, labels, 0.2, generator)

    return loss


class TestEveryLoss:
    @pytest.mark.parametrize("name", [name for name in LOSSES if name != "render"])
    def test_gradcheck(self, name: str) -> None:
        """All but the render loss, whose cells move with the body: its gradient is compared with that of voxels."""
        images, bodies = render_views(thesis_bodies(2, np.random.default_rng(5)), 32)
        views = torch.tensor(images, dtype=DOUBLE)[:, None]
        flat = (tensors(bodies).to_flat() + 0.03).requires_grad_()
        assert torch.autograd.gradcheck(loss_of(name, views, tensors(bodies)), flat)

    def test_gradcheck_of_the_voxels(self) -> None:
        images, bodies = render_views(thesis_bodies(2, np.random.default_rng(6)), 8)
        view = torch.tensor(images, dtype=DOUBLE)
        flat = (tensors(bodies).to_flat() + 0.03).requires_grad_()
        assert torch.autograd.gradcheck(lambda f: voxel_loss(Superquadric.from_flat(f), view, 8.0, 1.5), flat)

    @pytest.mark.parametrize("name", LOSSES)
    @pytest.mark.parametrize("shape", [0.1, 1.0])
    @pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
    def test_gradients_are_finite_on_axes_and_at_the_truth(self, name: str, shape: float, dtype: torch.dtype) -> None:
        """A body along the axes, compared with itself and with a smaller one."""
        flat = np.array([[0.2, 0.3, 0.4, shape, shape, 0.5, 0.5, 0.5, *IDENTITY]] * 2)
        flat[1, :3] *= 0.5
        images, bodies = render_views(Superquadric.from_flat(flat), 16)
        truth = Superquadric.from_flat(torch.tensor(bodies.to_flat(), dtype=dtype))
        guess = Superquadric.from_flat(torch.tensor(bodies[0:1].to_flat(), dtype=dtype).expand(2, 12))
        variable = guess.to_flat().clone().requires_grad_()
        value = loss_of(name, torch.tensor(images, dtype=dtype)[:, None], truth)(variable)
        value.sum().backward()
        assert torch.isfinite(value).all()
        assert torch.isfinite(variable.grad).all()

    def test_refuses_other_names(self) -> None:
        with pytest.raises(ValueError, match="render"):
            Objective("chamfer")


class TestUnsupervised:
    @pytest.mark.parametrize("name", UNSUPERVISED)
    def test_descent_on_the_view_finds_the_body(self, name: str) -> None:
        """From 15 % off in size, 0.03 in place and 10 degrees: without labels, back to the body."""
        rng = np.random.default_rng(7)
        images, truth = render_views(thesis_bodies(12, rng), 32)
        views = torch.tensor(images)[:, None]
        variables = torch.cat(
            [
                torch.log(torch.tensor(truth.size * rng.choice([0.85, 1.15], (12, 3))).float()),
                torch.zeros(12, 2),
                torch.tensor(truth.translation + rng.choice([-0.03, 0.03], (12, 3))).float(),
                torch.tensor(np.deg2rad(6) * rng.standard_normal((12, 3))).float(),
            ],
            dim=1,
        ).requires_grad_()
        base = torch.tensor(truth.rotation).float()

        def bodies() -> Superquadric:
            turn = quaternions.from_rotation_vector(variables[:, 8:])
            shape = 0.1 + 0.9 * torch.sigmoid(variables[:, 3:5])
            return Superquadric(variables[:, :3].exp(), shape, variables[:, 5:8], quaternions.multiply(base, turn))

        def iou() -> float:
            flat = bodies().to_flat().detach().double().numpy()
            return float(volume_iou(Superquadric.from_flat(flat), truth, 32).mean())

        before = iou()
        objective, generator = Objective(name), torch.Generator().manual_seed(0)
        optimizer = torch.optim.Adam([variables], 0.02)
        for step in range(120):
            optimizer.param_groups[0]["lr"] = 0.02 * (1 - step / 120)
            optimizer.zero_grad()
            objective.loss(bodies(), views, None, 0.5 + step / 240, generator).sum().backward()
            optimizer.step()
        assert before < 0.75
        assert iou() > 0.85


SPHERE = Superquadric.from_flat(torch.tensor([[0.3, 0.3, 0.3, 1, 1, 0.5, 0.5, 0.5, *IDENTITY]], dtype=torch.float64))


def views(count: int, seed: int, pixels: int = 32) -> tuple[torch.Tensor, Superquadric]:
    """Double precision, so that searches are exact."""
    images, bodies = render_views(thesis_bodies(count, np.random.default_rng(seed)), pixels)
    return torch.tensor(images, dtype=torch.float64), Superquadric.from_flat(torch.tensor(bodies.to_flat()))


@pytest.mark.parametrize("shape", [0.1, 1.0])
@pytest.mark.parametrize("sharpness", [None, 5.0, 300.0], ids=["free space", "soft", "sharp"])
def test_gradients_are_finite_on_axes(shape: float, sharpness: float | None) -> None:
    """A body whose axes are those of the cube, seen through its middle and along its faces: every term is zero once."""
    flat = torch.tensor([[0.2, 0.3, 0.4, shape, shape, 0.5, 0.5, 0.5, *IDENTITY]], dtype=torch.float64).requires_grad_()
    steps = torch.linspace(0, 1, 11, dtype=torch.float64)
    lines, body = torch.cartesian_prod(steps, steps), Superquadric.from_flat(flat)
    if sharpness is None:
        image = soft_render.free_space_excess(body, lines, lines.new_zeros(1, 121))
    else:
        image = soft_render.soft_depth(body, lines, sharpness, 2 * sharpness)
    image.sum().backward()
    assert torch.isfinite(flat.grad).all()
    assert torch.isfinite(image).all()
    assert 0 <= image.min() <= image.max() <= 1


class TestLines:
    def test_pixels_lie_where_the_canonical_view_says(self) -> None:
        lines, values = soft_render.of_view(torch.arange(16.0).reshape(1, 4, 4), 2, row=1, column=0)
        assert values.tolist() == [[4, 6, 12, 14]]
        assert lines.tolist() == [[0.125, 0.625], [0.625, 0.625], [0.125, 0.125], [0.625, 0.125]]

    def test_pixels_of_full_frames_lie_where_the_camera_of_the_cube_has_them(self) -> None:
        camera = unit_cube.camera(5)
        lines, _ = soft_render.of_view(torch.zeros(1, 5, 5), framing="full")
        v, u = np.indices((5, 5)).reshape(2, -1)
        points = camera.unproject(u, v, np.full(25, 0.5))
        expected = np.stack([points[:, 0], 1 - points[:, 1]], axis=1)
        np.testing.assert_allclose(lines.numpy(), expected, atol=1e-7)

    def test_nearest_approach_of_ellipsoids_in_closed_form(self) -> None:
        """g^2 = p' M p with M = R diag(1/a^2) R' is least where its derivative along z, (M p)_z, is zero."""
        _, bodies = views(20, 0)
        ellipsoids = Superquadric(bodies.size, torch.ones_like(bodies.shape), bodies.translation, bodies.rotation)
        lines = torch.rand(30, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        r = ellipsoids.rotation_matrix
        m = r @ torch.diag_embed(ellipsoids.size**-2) @ r.mT
        lateral = lines - ellipsoids.translation[:, None, :2]
        z = ellipsoids.translation[:, 2:] - (lateral * m[:, None, 2, :2]).sum(-1) / m[:, 2:, 2]
        inside_extent = (z - ellipsoids.translation[:, 2:]).abs() < ellipsoids.support(lines.new_tensor([[0, 0, 1.0]]))
        found = soft_render.nearest_approach(ellipsoids, lines)
        np.testing.assert_allclose(found[inside_extent], z[inside_extent], atol=1e-9)

    def test_lines_miss_where_the_ray_caster_says_so(self) -> None:
        images, bodies = views(20, 1)
        lines, depth = soft_render.of_view(images)
        least = soft_render.gauge(bodies, lines, soft_render.nearest_approach(bodies, lines))
        assert ((least < 1) != (depth > 0)).float().mean() < 1e-3


class TestFreeSpace:
    @pytest.mark.parametrize(
        ("x", "end", "excess"),
        [
            (0.65, 0.0, 0.5),  # background, half a radius beside the centre: g is 1/2 there
            (0.65, 0.7599, 0.0),  # ends on the front, sqrt(0.3^2 - 0.15^2) before the centre
            (0.65, 0.2402, 0.5),  # ends on the back: the body stands in the empty space before it
            (0.65, 0.6, 1 - np.hypot(0.15, 0.1) / 0.3),  # ends inside: as deep as where it ends
            (0.95, 0.0, 0.0),  # misses
        ],
    )
    def test_hand_computed_on_a_sphere(self, x: float, end: float, excess: float) -> None:
        line = torch.tensor([[x, 0.5]], dtype=torch.float64)
        found = soft_render.free_space_excess(SPHERE, line, torch.tensor([[end]], dtype=torch.float64))
        assert found.item() == pytest.approx(excess, abs=1e-3)


class TestSoftDepth:
    @pytest.mark.parametrize(("s", "density"), [(10.0, 20.0), (40.0, 100.0), (117.3, 308.5)])
    def test_is_the_limit_of_fine_voxels_with_its_gradient(self, s: float, density: float) -> None:
        voxels = 2000
        images, bodies = views(6, 3)
        lines, _ = soft_render.of_view(images, 5, 2, 2)
        z = cell_centres(voxels).flip(0)
        points = torch.cat(
            [lines[:, None].expand(-1, voxels, 2), z[None, :, None].expand(len(lines), -1, 1)], dim=-1
        ).reshape(-1, 3)
        weights = torch.rand(6, len(lines), generator=torch.Generator().manual_seed(1), dtype=torch.float64)

        def voxel_depth(body: Superquadric) -> torch.Tensor:
            occupancy = body.occupancy(points, s).reshape(6, len(lines), voxels)
            return soft_render.depth_projection(occupancy, density / voxels)

        def limit(body: Superquadric) -> torch.Tensor:
            return soft_render.soft_depth(body, lines, s, density, 12)

        found, gradients = [], []
        for render in (voxel_depth, limit):
            flat = bodies.to_flat().requires_grad_()
            found.append(render(Superquadric.from_flat(flat)))
            (found[-1] * weights).sum().backward()
            gradients.append(flat.grad)
        assert (found[0] - found[1]).abs().max() < 0.03
        assert (found[0] - found[1]).abs().mean() < 0.002
        assert ((gradients[0] - gradients[1]).abs() / gradients[0].abs().amax(dim=0)).max() < 0.05

    def test_approaches_the_exact_image(self) -> None:
        images, bodies = views(10, 4)
        lines, depth = soft_render.of_view(images)
        errors = [(soft_render.soft_depth(bodies, lines, s, 2 * s) - depth).abs().mean() for s in (25, 100, 400)]
        assert errors[0] > 3 * errors[1] > 9 * errors[2]
        assert errors[2] < 0.003
        away = torch.tensor([[0.05, 0.95]], dtype=torch.float64)
        assert soft_render.soft_depth(SPHERE, away, 100.0, 200.0).item() == pytest.approx(0, abs=1e-9), "nothing seen"

    @pytest.mark.parametrize(("s", "density", "cells"), [(0.0, 1.0, 8), (1.0, -1.0, 8), (1.0, 1.0, 0)])
    def test_refuses_nonsense(self, s: float, density: float, cells: int) -> None:
        with pytest.raises(ValueError, match="positive"):
            soft_render.soft_depth(SPHERE, torch.zeros(1, 2, dtype=torch.float64), s, density, cells)
