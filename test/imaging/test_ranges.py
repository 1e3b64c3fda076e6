"""A support that bends like a sphere around the camera is told from a flat one, and from one that bends itself."""

import numpy as np
import pytest
from table_scenes import Table, noisy

from sq_perception.imaging.camera import Camera
from sq_perception.imaging.ranges import seem_ranges


def camera(degrees):
    focal = 160 / np.tan(np.radians(degrees / 2))
    return Camera(320, 240, focal, focal, 159.5, 119.5)


def seen(table, view, sag=0.0):
    """z of a table that is ``sag`` of a metre lower half a metre from its middle, with a box and a can on it."""
    bodies = [table.body(-0.1, 0.05, (0.05, 0.03, 0.08)), table.body(0.12, 0, (0.033, 0.033, 0.06), (0.1, 1.0))]
    depth, labels = table.see(bodies, camera=view)
    rays = view.rays(*np.meshgrid(np.arange(view.width), np.arange(view.height)))[1]
    z = depth
    for _ in range(8):  # the height at a point depends on the point
        x, y = np.moveaxis((rays * z[..., None] - table.origin) @ table.axes[:, :2], -1, 0)
        height = np.clip(-4 * sag * (x**2 + y**2), -0.1, 0.1)
        z = np.where(labels > 0, depth, (height - table.plane[3]) / (rays @ table.plane[:3]))
    return np.where((z > 0) & (z < 6), z, np.nan), np.linalg.norm(rays, axis=2)


@pytest.mark.parametrize("degrees", [55, 85])
@pytest.mark.parametrize("pitch", [0.4, 0.75, 1.5])
@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_ranges_are_noticed_and_depths_are_not(degrees, pitch, noise):
    view = camera(degrees)
    z, length = seen(Table(pitch), view)
    assert seem_ranges(noisy(z * length, noise), view)
    assert not seem_ranges(noisy(z, noise), view)


@pytest.mark.parametrize("degrees", [55, 85])
@pytest.mark.parametrize("sag", [-0.02, -0.01, 0.01, 0.02])
def test_a_table_that_bends_is_none_of_ranges(degrees, sag):
    view = camera(degrees)
    for pitch in (0.4, 0.75, 1.5):
        assert not seem_ranges(noisy(seen(Table(pitch), view, sag)[0], 0.002), view)


def test_what_shows_no_plane_says_nothing(rng):
    view = camera(85)
    assert not seem_ranges(rng.uniform(0.5, 2.0, (240, 320)), view)
    assert not seem_ranges(np.full((240, 320), np.nan), view)
    assert not seem_ranges(np.ones((240, 320)), view), "a wall"
    assert not seem_ranges(np.ones((2, 2)), Camera(2, 2, 2.0, 2.0, 0.5, 0.5))
