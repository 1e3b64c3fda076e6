"""Cameras, ray casting, the unit cube, canonical views and soft rendering."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from python_process import run_python
from unit_axis import cell_centres, soft_images

from sq_perception.geometry import Superquadric, rotation
from sq_perception.imaging import canonical_view, raycast, soft_agreement, soft_render, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.simulation import rendering
from sq_perception.simulation.scenes import TABLE_CAMERA, plane_depth, table_scene, thesis_bodies

VGA = Camera(640, 480, 520.0, 530.0, 322.5, 238.0)


def tabletop_bodies(count: int, seed: int) -> Superquadric:
    """Bodies in front of a pinhole camera, some of them partly outside of the image."""
    rng = np.random.default_rng(seed)
    size, shape = rng.uniform(0.03, 0.15, (count, 3)), rng.uniform(0.1, 1.5, (count, 2))
    places = rng.uniform([-0.5, -0.4, 0.5], [0.5, 0.4, 1.5], (count, 3))
    return Superquadric(size, shape, places, rotation.random(count, rng))


def author_renders(shared_data: Path) -> list[tuple[np.ndarray, Superquadric]]:
    folder = shared_data / "author_renders"
    renders = []
    for line in (folder / "labels.txt").read_text().splitlines()[1:]:
        name, *numbers = line.split(",")
        v = np.array(numbers, dtype=float)
        body = Superquadric(v[:3] / 255, v[3:5], v[5:8] / 255, v[17:21])
        np.testing.assert_allclose(body.rotation_matrix, v[8:17].reshape(3, 3), atol=2e-5)
        renders.append((cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE), body))
    return renders


RENDERING = """
import os, threading
import numpy as np
from sq_perception.geometry import Superquadric, metrics
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
body, camera = Superquadric([0.1] * 3, [0.5, 0.5], [0, 0, 0.6], [0, 0, 0, 1.0]), Camera(320, 240, 250, 250, 160, 120)
seen = lambda: np.append(raycast.render(body, camera)[0].ravel(), metrics.volume_iou(body, body))
first = seen()
"""
FORKED = """
child = os.fork()
if not child:
    os._exit(not np.array_equal(seen(), first))
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
THREADED = """
calls = [threading.Thread(target=lambda: [seen() for _ in range(20)]) for _ in range(2)]
_ = [call.start() for call in calls], [call.join() for call in calls]
"""


class TestCamera:
    @pytest.mark.parametrize("camera", [VGA, Camera(64, 48, 200.0, 210.0, 30.0, 20.0, "orthographic")])
    def test_projection_undoes_unprojection(self, camera: Camera) -> None:
        rng = np.random.default_rng(0)
        u, v, depth = rng.uniform(0, camera.width, 50), rng.uniform(0, camera.height, 50), rng.uniform(0.1, 5, 50)
        points = camera.unproject(u, v, depth)
        np.testing.assert_allclose(points[:, 2], depth)
        np.testing.assert_allclose(camera.project(points), np.stack([u, v], axis=1), atol=1e-9)

    def test_pixel_centres_are_integers_and_points_behind_a_pinhole_have_none(self) -> None:
        np.testing.assert_allclose(VGA.unproject(322.5, 238.0, 2.0), [0, 0, 2])
        assert np.isnan(VGA.project(np.array([0.1, 0.1, -1.0]))).all()

    def test_cropping_keeps_the_rays(self) -> None:
        crop = VGA.cropped(100, 50, 30, 20)
        np.testing.assert_allclose(crop.unproject(3, 4, 1.0), VGA.unproject(103, 54, 1.0))

    def test_refuses_what_is_no_camera(self) -> None:
        wrong = {"fx": 0.0, "fy": -3.0, "cx": np.nan, "width": 0, "height": 4.0}
        words = ("focal", "focal", "finite", "1 x 1", "whole numbers")
        for (name, value), said in zip(wrong.items(), words, strict=True):
            with pytest.raises(ValueError, match=said):
                replace(VGA, **{name: value})

    def test_a_matrix_is_read_by_rows_and_refused_where_it_is_transposed(self) -> None:
        assert Camera.from_matrix(VGA.matrix, 640, 480) == VGA
        with pytest.raises(ValueError, match="transposed"):
            Camera.from_matrix(VGA.matrix.T, 640, 480)
        with pytest.raises(ValueError, match="expected 0 0 1 in its last row"):
            Camera.from_matrix(VGA.matrix * [[1], [1], [2]], 640, 480)

    def test_masked_readings_are_none_and_whole_numbers_no_metres(self) -> None:
        hidden = np.arange(VGA.width * VGA.height).reshape(VGA.height, VGA.width) % 3 == 0
        depth = np.ma.masked_array(np.full(hidden.shape, 0.5), hidden)
        np.testing.assert_array_equal(VGA.readings(depth), np.where(hidden, np.nan, 0.5))
        np.testing.assert_array_equal(np.isnan(VGA.points(depth)[..., 2]), hidden)
        for image in (np.full(hidden.shape, 500, np.uint16), depth[..., None], depth[0]):
            with pytest.raises(ValueError, match=r"depth: expected a float image \(height, width\) in metres, got"):
                VGA.readings(image)


class TestRaycast:
    @pytest.mark.parametrize(("code", "threads"), [(FORKED, "default"), (THREADED, "workqueue")])
    def test_forked_processes_and_threads_render_alike(self, code: str, threads: str) -> None:
        """GNU's OpenMP ends a forked process that calls it, numba's own threads one that calls them twice at a time."""
        run_python("-c", RENDERING + code, env={**os.environ, "NUMBA_THREADING_LAYER": threads})

    def test_rendered_depth_lies_on_the_surface(self) -> None:
        bodies = tabletop_bodies(30, 1)
        depth, index = raycast.render(bodies, VGA)
        cloud = VGA.points(np.where(np.isfinite(depth), depth, np.nan))
        assert (np.isfinite(depth) == (index >= 0)).all()
        for k, body in enumerate(bodies):
            points = cloud[index == k]
            np.testing.assert_allclose(body.gauge(points), 1, atol=1e-6)
            facing = (body.normals(points) * points).sum(axis=-1)
            assert (facing < 1e-6 * np.linalg.norm(points, axis=-1)).all(), "a visible point faces the camera"

    def test_a_batch_of_batches_is_refused(self) -> None:
        bodies = tabletop_bodies(2, 0)
        with pytest.raises(ValueError, match=r"batch \(n,\), got a batch of shape \(2, 2\)"):
            raycast.render(Superquadric.stack([bodies, bodies]), VGA)

    def test_nearest_body_wins(self) -> None:
        bodies = tabletop_bodies(12, 2)
        depth, _ = raycast.render(bodies, VGA)
        alone = np.stack([raycast.render(body, VGA)[0] for body in bodies])
        np.testing.assert_allclose(depth, alone.min(axis=0), rtol=1e-12)

    def test_sphere_in_closed_form(self) -> None:
        sphere = Superquadric(np.full(3, 0.2), np.ones(2), np.array([0.1, -0.05, 1.0]), np.array([0, 0, 0, 1.0]))
        depth, _ = raycast.render(sphere, VGA)
        v, u = np.indices(depth.shape)
        _, d = VGA.rays(u, v)
        b, c = d @ sphere.translation, (sphere.translation**2).sum() - 0.04
        root = b * b - c * (d * d).sum(-1)
        expected = np.where(root >= 0, (b - np.sqrt(np.maximum(root, 0))) / (d * d).sum(-1), np.inf)
        sure = np.abs(root) > 1e-7
        assert (np.isfinite(depth) == np.isfinite(expected))[sure].all()
        hit = sure & np.isfinite(expected)
        np.testing.assert_allclose(depth[hit], expected[hit], atol=1e-8)
        behind, index = raycast.render(Superquadric([0.1] * 3, [1, 1], [0, 0, -1.0], [0, 0, 0, 1]), VGA)
        assert np.isinf(behind).all()
        assert (index == -1).all()

    def test_reproduces_the_authors_renders(self, shared_data: Path) -> None:
        """The convention pin: at least 99.5 % of pixels equal; the others differ at silhouettes or by one level."""
        for image, body in author_renders(shared_data):
            depth, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera())
            grey = unit_cube.grey_from_depth(depth)
            assert (grey == image).mean() >= 0.9995
            both = (grey > 0) & (image > 0)
            assert np.abs(grey[both].astype(int) - image[both]).max() <= 1
            edge = cv2.morphologyEx((image > 0).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3)))
            assert ((grey > 0) != (image > 0))[edge == 0].sum() == 0


class TestUnitCube:
    def test_frames_are_inverse_and_larger_is_nearer(self) -> None:
        bodies = thesis_bodies(10, np.random.default_rng(4))
        back = unit_cube.cube_from_optical(unit_cube.optical_from_cube(bodies))
        np.testing.assert_allclose(back.to_flat()[:, :8], bodies.to_flat()[:, :8], atol=1e-12)
        np.testing.assert_allclose(rotation.geodesic_angle(back.rotation, bodies.rotation), 0, atol=1e-7)
        depth, _ = raycast.render(unit_cube.optical_from_cube(bodies[0]), unit_cube.camera())
        grey = unit_cube.grey_from_depth(depth)
        assert grey.ravel()[depth.argmin()] == grey.max()

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_grey_round_trip(self, dtype: type[np.unsignedinteger]) -> None:
        image = np.arange(256, dtype=dtype).reshape(16, 16)
        np.testing.assert_array_equal(unit_cube.grey_from_depth(unit_cube.depth_from_grey(image), dtype), image)

    def test_refuses_other_images(self) -> None:
        with pytest.raises(ValueError, match="uint8 or uint16"):
            unit_cube.depth_from_grey(np.zeros((4, 4), dtype=np.float32))


class TestCanonicalView:
    def test_inverse_is_exact(self) -> None:
        for body in tabletop_bodies(30, 5):
            depth, index = raycast.render(body, VGA)
            if (index >= 0).sum() < 50:
                continue
            view = canonical_view.from_mask(np.where(index >= 0, depth, np.nan), index >= 0, VGA)
            back = view.from_canonical(view.to_canonical(body))
            np.testing.assert_allclose(back.to_flat()[:8], body.to_flat()[:8], atol=1e-12)
            np.testing.assert_allclose(rotation.geodesic_angle(back.rotation, body.rotation), 0, atol=1e-7)

    @pytest.mark.parametrize("projection", ["pinhole", "orthographic"])
    def test_view_shows_the_body_it_maps(self, projection: str) -> None:
        """Every pixel of the view, put back, lies on the canonical body: the two halves of the map agree."""
        rng = np.random.default_rng(6)
        bodies = thesis_bodies(20, rng)
        camera = unit_cube.camera()
        if projection == "pinhole":
            places, camera = rng.uniform(-0.3, 0.3, (20, 3)) + [0, 0, 2], VGA
            bodies = Superquadric(bodies.size, bodies.shape, places, bodies.rotation)
        else:
            bodies = unit_cube.optical_from_cube(bodies)
        for body in bodies:
            depth, index = raycast.render(body, camera)
            view = canonical_view.from_mask(np.where(index >= 0, depth, np.nan), index >= 0, camera)
            canonical = view.to_canonical(body)
            n = len(view.image)
            rows, columns = np.nonzero(view.image > 1 / 255)
            points = np.stack([(columns + 0.5) / n, 1 - (rows + 0.5) / n, view.image[rows, columns]], axis=1)
            off = np.abs(canonical.sampson_distance(points))
            assert np.median(off) < 0.006
            assert np.quantile(off, 0.95) < 0.03
            assert 0.2 < (view.image > 0).mean() < 1
            assert view.image.max() <= 1
            assert np.abs(canonical.translation[:2] - 0.5).max() < 0.1

    def test_direct_rendering_is_the_view_of_the_image(self) -> None:
        bodies = thesis_bodies(20, np.random.default_rng(7))
        images, canonical = rendering.render_views(bodies, levels=np.full(20, 255.0))
        for k, body in enumerate(bodies):
            depth, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera(512))
            depth = np.where(np.isfinite(depth), depth, np.nan)
            view = canonical_view.from_mask(depth, np.isfinite(depth), unit_cube.camera(512))
            same = view.to_canonical(unit_cube.optical_from_cube(body))
            np.testing.assert_allclose(same.to_flat()[:8], canonical[k].to_flat()[:8], atol=0.03)
            assert ((view.image > 0) != (images[k] > 0)).mean() < 0.05
            assert np.abs(view.image - images[k])[(view.image > 0) & (images[k] > 0)].mean() < 0.03

    def test_direct_rendering_is_the_view_of_a_pinhole_image(self) -> None:
        """What a near camera cannot see is missing from both, although the direct way casts parallel rays."""
        rng = np.random.default_rng(10)
        off_near, off_far = [], []
        for body in thesis_bodies(20, rng):
            moved = Superquadric(body.size, body.shape, np.append(rng.uniform(-0.2, 0.2, 2), 1.5), body.rotation)
            depth, index = raycast.render(moved, VGA)
            view = canonical_view.from_mask(np.where(index >= 0, depth, np.nan), index >= 0, VGA)
            canonical = view.to_canonical(moved)
            eye = rotation.to_matrix(view.rotation) @ -view.anchor / view.extent + [0.5, 0.5, canonical_view.NEAREST]
            _, upper = canonical.bounding_box()
            batch = Superquadric.from_flat(canonical.to_flat()[None])
            near, same = rendering.render_views(batch, distance=eye[2:] - upper[2])
            far, _ = rendering.render_views(batch)
            np.testing.assert_allclose(same[0].to_flat()[:8], canonical.to_flat()[:8], atol=0.05)
            off_near.append(np.abs(view.image - near[0]).mean())
            off_far.append(np.abs(view.image - far[0]).mean())
        assert np.mean(off_near) < 0.015
        assert np.mean(np.array(off_near) < np.array(off_far)) >= 0.8

    @pytest.mark.parametrize("degrees", [90, 180, -90, 70, -155])
    def test_a_rolled_camera_has_the_same_view(self, degrees: float) -> None:
        """The support tells what is up, whatever is up in the image."""
        camera = Camera(480, 480, 520.0, 520.0, 239.5, 239.5)
        body = Superquadric([0.05, 0.08, 0.12], [0.3, 0.7], [0.02, -0.03, 0.9], [0.5, 0.2, -0.1, 0.8])
        plane = np.array([0.0, -0.61, -0.79, 0.9])
        roll = np.array([0.0, 0.0, np.sin(np.deg2rad(degrees) / 2), np.cos(np.deg2rad(degrees) / 2)])

        def seen(body: Superquadric, plane: np.ndarray) -> canonical_view.CanonicalView:
            depth, index = raycast.render(body, camera)
            depth = np.where(index >= 0, depth, np.nan)
            return canonical_view.from_mask(depth, index >= 0, camera, plane=plane, missing_is_hidden=True)

        rolled = body.transformed(roll, np.zeros(3)), np.append(rotation.to_matrix(roll) @ plane[:3], plane[3])
        view, same = seen(body, plane), seen(*rolled)
        np.testing.assert_allclose(same.plane_to_canonical(rolled[1]), view.plane_to_canonical(plane), atol=0.02)
        bodies = same.to_canonical(rolled[0]), view.to_canonical(body)
        np.testing.assert_allclose(*(each.to_flat()[:8] for each in bodies), atol=0.02)
        assert (view.hidden != same.hidden).mean() < 0.04
        assert np.abs(view.image - same.image)[(view.image > 0) & (same.image > 0)].mean() < 0.01

    @pytest.mark.parametrize("normal", [(0.06, 0.04, -0.997), (0.1, -0.7, -0.707)], ids=["from above", "hardly rolled"])
    def test_where_there_is_no_roll_to_undo_the_view_is_that_of_the_camera(self, normal: tuple[float, ...]) -> None:
        body = Superquadric([0.05, 0.08, 0.12], [0.3, 0.7], [0.0, 0.0, 0.9], [0.5, 0.2, -0.1, 0.8])
        depth, index = raycast.render(body, VGA)
        view = canonical_view.from_mask(depth, index >= 0, VGA, plane=np.array([*normal, 1.2]))
        np.testing.assert_array_equal(view.image, canonical_view.from_mask(depth, index >= 0, VGA).image)

    def test_what_is_beside_the_object_is_shown_by_how_much_nearer_it_is(self) -> None:
        """A card of 40 pixels square, so that one is 1 / (40 MARGIN) of the view; what is beside it in four strips."""
        camera = Camera(120, 120, 100.0, 100.0, 59.5, 59.5)
        depth, mask = np.full((120, 120), 5.0), np.zeros((120, 120), bool)
        mask[40:80, 40:80] = True
        depth[mask] = 1.0
        extent = canonical_view.from_mask(depth, mask, camera, missing_is_hidden=True).extent
        depth[40:50, 80:], depth[50:60, 80:] = 1.0, 1 - 0.25 * extent
        depth[60:70, 80:], depth[70:80, 80:] = 1 + 0.25 * extent, np.nan
        view = canonical_view.from_mask(depth, mask, camera, missing_is_hidden=True)
        rows, beyond = np.array([5, 15, 25, 35]), 40
        i = np.rint((0.5 + (rows - 19.5) / (40 * canonical_view.MARGIN)) * 64 - 0.5).astype(int)
        j = int((0.5 + (beyond - 19.5) / (40 * canonical_view.MARGIN)) * 64)
        flush, hidden, covered = canonical_view.FLUSH, canonical_view.HIDDEN, canonical_view.COVERED
        np.testing.assert_allclose(view.beside[i, j], [0, 0.25, -0.25, np.nan], atol=0.01)
        np.testing.assert_allclose(view.with_steps[i, j], [flush, 1.5 * hidden, 0.5 * flush, hidden], atol=0.02)
        np.testing.assert_array_equal(view.hidden[i, j], [False, True, False, True])
        assert view.with_steps[i[2], 1] == 0  # far behind
        np.testing.assert_array_equal(view.with_steps[view.image > 0], view.image[view.image > 0])
        np.testing.assert_array_equal(view.with_steps < flush - 1e-3, view.hidden)
        # Who drew a mask over pixels without a reading knows where the thing ends.
        depth[40:50, 40:50] = np.nan
        drawn = canonical_view.from_mask(depth, mask, camera, missing_is_hidden=True)
        assert (drawn.with_steps[i[0], i[0]], drawn.with_steps[i[3], j]) == (covered, 0)
        np.testing.assert_array_equal(drawn.with_steps[i[:3], j], view.with_steps[i[:3], j])

    def test_the_table_is_no_step(self) -> None:
        """It goes on beside all that stands on it, at any depth: its height is shown besides."""
        scene = table_scene(np.random.default_rng(3), 1)
        depth, index = raycast.render(scene.bodies, TABLE_CAMERA)
        image = np.minimum(depth, plane_depth(scene.plane, TABLE_CAMERA))
        image[~np.isfinite(image)] = np.nan
        view = canonical_view.from_mask(image, index == 0, TABLE_CAMERA, plane=scene.plane, missing_is_hidden=True)
        around = (view.image == 0) & ~view.hidden
        assert around.mean() > 0.2
        assert (view.with_steps[around] == 0).mean() > 0.98
        unknown = canonical_view.from_mask(image, index == 0, TABLE_CAMERA, missing_is_hidden=True)
        assert (unknown.with_steps[around] == 0).mean() < 0.9

    def test_empty_mask_is_misuse(self) -> None:
        with pytest.raises(ValueError, match="at least one pixel"):
            canonical_view.from_mask(np.full((48, 64), np.nan), np.ones((48, 64), bool), Camera(64, 48, 50, 50, 32, 24))


class TestSoftRender:
    def test_projection_of_a_hand_made_column(self) -> None:
        """Two empty voxels, then solid: A = 1, 1, e^-tau, e^-2tau; T counts what lies before the surface."""
        column = torch.tensor([[[0.0, 0.0, 1.0, 1.0]]], dtype=torch.float64)
        tau = 2.0
        expected = 1 - (2 + np.exp(-tau) + np.exp(-2 * tau)) / 4
        assert soft_render.depth_projection(column, tau).item() == pytest.approx(expected)

    def test_matches_the_ray_caster_at_the_thesis_parameters(self) -> None:
        """Mean absolute error at most the thesis' 0.0056 at s = 117.3, tau = 4.82 on 64^3 (figure 7.6)."""
        bodies = thesis_bodies(10, np.random.default_rng(8))
        tensors = Superquadric.from_flat(torch.tensor(bodies.to_flat()))
        axis = soft_render.grid_points(64)
        soft = soft_images(tensors, axis, soft_agreement.THESIS_SHARPNESS, soft_agreement.THESIS_TAU).numpy()
        for body, image in zip(bodies, soft, strict=True):
            depth, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera(64))
            assert np.abs(image - np.where(np.isfinite(depth), 1 - depth, 0)).mean() < 0.0056

    @pytest.mark.parametrize(("s", "tau"), [(soft_agreement.THESIS_SHARPNESS, soft_agreement.THESIS_TAU), (8.0, 0.5)])
    def test_the_compiled_agreement_is_that_of_the_soft_image(self, s: float, tau: float) -> None:
        """Bodies against images of others, as of themselves; sharp and soft, thick and thin to the light."""
        bodies = thesis_bodies(4, np.random.default_rng(10))
        tensors = Superquadric.from_flat(torch.tensor(bodies.to_flat()))
        rendered = soft_images(tensors, cell_centres(64), s, tau)
        images = (0.7 * rendered + 0.3 * rendered.roll(1, dims=0)).float()
        seen, shown = images[:, ::3, ::3].double(), rendered[:, ::3, ::3]
        expected = 1 - (seen - shown).abs().sum(dim=(1, 2)) / torch.maximum(seen, shown).sum(dim=(1, 2))
        for body, image, value in zip(bodies, images.numpy(), expected.tolist(), strict=True):
            parameters = np.concatenate([body.size, body.shape, body.translation, body.taper])
            got = soft_agreement.agreement(image, 3, parameters, body.rotation_matrix, s, tau)
            assert got == pytest.approx(value, abs=1e-9)

    @pytest.mark.parametrize(("s", "tau"), [(0.0, 1.0), (1.0, -1.0)])
    def test_refuses_nonsense(self, s: float, tau: float) -> None:
        bodies = Superquadric.from_flat(torch.tensor(thesis_bodies(1, np.random.default_rng(0)).to_flat()))
        with pytest.raises(ValueError, match="positive"):
            soft_images(bodies, cell_centres(4), s, tau)
