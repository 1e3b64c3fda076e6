"""Losses: hand-computed values, what they cannot tell apart, gradients, and that the views' losses find bodies."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from unit_axis import cell_centres, grid, soft_images

from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.imaging import soft_render
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
        seen = (lines - 0.5).abs().amax(dim=-1) < 0.18
        depth = torch.where(seen, 0.7, 0.0)[None].double()
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
