"""Lines of sight: nearest approach, free space, and soft depth as the limit of the thesis' voxels."""

import numpy as np
import pytest
import torch
from unit_axis import cell_centres

from sq_perception.geometry import Superquadric
from sq_perception.imaging import soft_render, unit_cube
from sq_perception.simulation.rendering import render_views
from sq_perception.simulation.scenes import thesis_bodies

IDENTITY = [0.0, 0.0, 0.0, 1.0]
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
        view = torch.arange(16.0).reshape(1, 4, 4)
        lines, values = soft_render.of_view(view, 2, row=1, column=0)
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
