"""Disturbed views: what an occluder, noise and a wrong mask may change, and what must stay true."""

import numpy as np
import pytest

from sq_perception import Camera, Superquadric
from sq_perception.imaging import canonical_view, raycast, regions
from sq_perception.imaging.canonical_view import HIDDEN
from sq_perception.learning.dataset import Disturbance, ViewPool, ViewSource, any_occluder, draw_views, wide_bodies
from sq_perception.simulation import rendering
from sq_perception.simulation.scenes import TABLE_CAMERA, plane_depth, table_scene, thesis_bodies

VGA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


def off_surface(views: np.ndarray, bodies: Superquadric) -> np.ndarray:
    """|g - 1| of every seen pixel of views (n, p, p), bodies in the views' frames."""
    body, row, column = np.nonzero(views > 0)
    pixels = views.shape[-1]
    points = np.stack([(column + 0.5) / pixels, 1 - (row + 0.5) / pixels, views[body, row, column]], axis=-1)
    return np.abs(bodies[body].gauge(points[:, None])[:, 0] - 1)


class TestOccluder:
    def test_hides_the_share_it_was_asked_for(self) -> None:
        rng = np.random.default_rng(1)
        bodies, share = thesis_bodies(60, rng), rng.uniform(0.1, 0.4, 60)
        occluder = any_occluder(share, rng)
        occluder.thickness[:] = np.inf
        whole, free = rendering.render_views(bodies)
        views, fitted = rendering.render_views(bodies, occluder=occluder)
        side = free.size[:, 0] / fitted.size[:, 0]
        area = (views > 0).sum(axis=(1, 2)) * side**2 / (whole > 0).sum(axis=(1, 2))
        assert np.abs(area - (1 - share)).max() < 0.06
        assert np.abs(area - (1 - share)).mean() < 0.015

    @pytest.mark.parametrize("pinhole_share", [0.0, 1.0])
    def test_the_rest_is_still_a_view_of_the_body(self, pinhole_share: float) -> None:
        source = ViewSource(64, pinhole_share, 0.3, Disturbance(occluded_share=1.0, noisy_share=1.0))
        views, bodies = draw_views(40, np.random.default_rng(2), source)
        # Depths come in steps of 1 / 255 of the cube that the bodies were drawn in: a few hundredths of a thin one.
        assert np.quantile(off_surface(views, bodies), 0.95) < 0.05
        assert np.median(off_surface(views, bodies)) < 0.01

    def test_view_is_fitted_to_what_is_visible(self) -> None:
        views, _ = draw_views(40, np.random.default_rng(3), ViewSource(disturbance=Disturbance(occluded_share=1.0)))
        for view in views:
            rows, columns = np.nonzero(view > 0)
            depth_range = view[view > 0].max() - view[view > 0].min()
            assert max(np.ptp(rows) / 64, np.ptp(columns) / 64, depth_range) > 0.85

    def test_without_one_nothing_changes(self) -> None:
        bodies = thesis_bodies(8, np.random.default_rng(4))
        nothing = any_occluder(np.zeros(8), np.random.default_rng(5))
        plain, plain_bodies = rendering.render_views(bodies)
        views, same = rendering.render_views(bodies, occluder=nothing, miss=np.zeros((8, 4)))
        np.testing.assert_array_equal(views, plain)
        np.testing.assert_array_equal(same.to_flat(), plain_bodies.to_flat())

    def test_whole_body_cannot_be_hidden(self) -> None:
        with pytest.raises(ValueError, match="below 1"):
            rendering.render_views(
                thesis_bodies(1, np.random.default_rng(0)), occluder=any_occluder(np.ones(1), np.random.default_rng(0))
            )


class TestHiddenPixels:
    """Of images: the pixels of the body's own silhouette that another body covers, and no free ones."""

    def test_marks_where_the_body_goes_on_and_no_background(self) -> None:
        behind = Superquadric([0.06, 0.05, 0.05], [0.3, 0.8], [0, 0, 0.8], [0.2, 0.3, 0.1, 0.9])
        before = Superquadric([0.03, 0.08, 0.02], [0.1, 0.1], [0.05, 0, 0.65], [0, 0, 0, 1])
        depth, index = raycast.render(Superquadric.stack([behind, before]), VGA)
        wall = np.where(np.isfinite(depth), depth, 2.0)
        view = canonical_view.from_mask(wall, index == 0, VGA, find_hidden=True)
        np.testing.assert_array_equal(view.marked[view.hidden], np.float32(HIDDEN))
        alone = raycast.render(behind, VGA)[1] >= 0
        whole = canonical_view.from_mask(np.where(alone, depth, 2.0), alone & (index >= 0), VGA)
        assert not whole.hidden.any()
        # Free pixels lie beyond both bodies; the view's own pixels tell where they are.
        uv = np.rint(VGA.project(view_points(view))).astype(int)
        inside = (uv >= 0).all(axis=-1) & (uv < [VGA.width, VGA.height]).all(axis=-1)
        what = np.full(view.image.shape, -1)
        what[inside] = index[uv[inside][:, 1], uv[inside][:, 0]]
        assert view.hidden[what == 1].mean() > 0.97
        assert view.hidden[what == -1].mean() < 0.03
        assert view.hidden.any()

    def test_table_hides_nothing_once_it_is_known(self) -> None:
        scene = table_scene(np.random.default_rng(6), 1)
        depth, index = raycast.render(scene.bodies, TABLE_CAMERA)
        image = np.minimum(depth, plane_depth(scene.plane, TABLE_CAMERA))
        image[~np.isfinite(image)] = np.nan
        known = canonical_view.from_mask(image, index == 0, TABLE_CAMERA, find_hidden=True, plane=scene.plane)
        assert known.hidden.mean() < 0.005

    def test_holes_count_and_the_empty_surroundings_do_not(self) -> None:
        body = Superquadric([0.05] * 3, [0.2] * 2, [0, 0, 0.8], [0.2, 0.3, 0.1, 0.9])
        depth, index = raycast.render(body, VGA)
        depth = np.where(index >= 0, depth, np.nan)
        rows, columns = np.nonzero(index >= 0)
        row, column = int(rows.mean()) - 8, int(columns.mean()) - 8
        depth[row : row + 16, column : column + 16] = np.nan
        view = canonical_view.from_mask(depth, index >= 0, VGA, find_hidden=True)
        view_pixels_per_pixel = depth[row, column - 1] / VGA.fx / view.extent * 64
        assert view.hidden.sum() == pytest.approx((16 * view_pixels_per_pixel) ** 2, rel=0.15)


class TestWear:
    def test_seeded_and_off_by_default(self) -> None:
        views, _ = draw_views(16, np.random.default_rng(7))
        assert Disturbance().apply(views, np.random.default_rng(0)) is views
        worn = Disturbance(noisy_share=1.0)
        first, second = (worn.apply(views, np.random.default_rng(1)) for _ in range(2))
        np.testing.assert_array_equal(first, second)
        assert (first != views).any(axis=(1, 2)).mean() > 0.9

    def test_stays_a_view(self) -> None:
        views, _ = draw_views(64, np.random.default_rng(8), ViewSource(disturbance=Disturbance(occluded_share=0.5)))
        worn = Disturbance(noisy_share=1.0).apply(views, np.random.default_rng(2))
        assert worn.dtype == np.float32
        assert np.isin(worn[worn <= 0], [0, np.float32(HIDDEN)]).all()
        assert worn.max() <= 1
        assert (worn[views == np.float32(HIDDEN)] == np.float32(HIDDEN)).mean() > 0.9
        seen, before = (worn > 0).sum(axis=(1, 2)), (views > 0).sum(axis=(1, 2))
        assert (seen > 0.5 * before).all()
        assert (seen < 1.3 * before).all()

    def test_noise_has_the_size_it_says(self) -> None:
        """The typical change is the median of a log-uniform sigma, times that of |normal|."""
        views, _ = draw_views(200, np.random.default_rng(9))
        worn = Disturbance(noisy_share=1.0).apply(views, np.random.default_rng(3))
        both = (views > 0) & (worn > 0)
        change = np.array([np.median(np.abs(w - v)[b]) for w, v, b in zip(worn, views, both, strict=True)])
        assert 0.5 < np.median(change) / (np.sqrt(0.03 / 2000) * 0.6745) < 2


def test_a_pool_pairs_views_with_their_bodies() -> None:
    images, bodies = ViewPool(np.random.default_rng(5), ViewSource(32), capacity=32).batch(16)
    again, _ = rendering.render_views(bodies, 32)
    assert np.abs(again - images).mean() < 0.01


def test_wide_bodies_have_the_proportions_they_say() -> None:
    bodies = wide_bodies(3000, np.random.default_rng(10))
    ratio = bodies.size.max(axis=1) / bodies.size.min(axis=1)
    assert ratio.max() < 6
    assert (ratio > 3).mean() > 0.3
    assert 0.1 <= bodies.shape.min() <= bodies.shape.max() <= 1.0


def view_points(view: canonical_view.CanonicalView) -> np.ndarray:
    """The points (n, n, 3) of the optical frame behind the view's pixels, at the height of its nearest known one."""
    n = view.image.shape[0]
    filled = view.image.ravel()[regions.nearest(view.image > 0)]
    x, y = np.meshgrid((np.arange(n) + 0.5) / n, 1 - (np.arange(n) + 0.5) / n)
    places, ones = np.stack([x, y, filled], axis=-1), np.ones((n, n, 1))
    dots = Superquadric(0.01 * np.repeat(ones, 3, axis=2), ones * [1.0, 1.0], places, ones * [0.0, 0.0, 0.0, 1.0])
    return view.from_canonical(dots).translation
