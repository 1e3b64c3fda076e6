"""Numbers of depth images to metres: what is a unit, what is no reading, and what seems to be ranges instead of z."""

import numpy as np
import pytest
from table_scenes import Table, noisy

from sq_perception.imaging.camera import Camera
from sq_perception.imaging.depth_units import UnitsError, metres, parse_scale, seem_ranges, wrong_unit, z_from_range

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)


@pytest.fixture
def table(rng):
    """Metres of a tilted plane with a box before it, with a sensor's noise."""
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    z = 1 / (0.9 + 0.004 * v + 0.0005 * u)
    z[40:70, 60:90] = 0.7
    return z + 0.001 * rng.standard_normal(z.shape)


HOLES = np.zeros((120, 160), bool)
HOLES[50:60, 70:78] = HOLES[90:100, 20:50] = HOLES[:, :4] = True


@pytest.mark.parametrize(
    ("mark", "dtype", "scale"),
    [
        *((65535, np.uint16, 1000), (65535, ">u2", 10000), (32767, np.int16, 1000), (65535, np.int32, 1000)),
        *((2**31 - 1, np.int32, 1000), (2047, np.uint16, 1000), (4095, np.uint16, 1000), (10_000, np.uint16, 1000)),
        *((5000, np.uint16, 1000), (255, np.uint8, 100), (10.0, np.float32, 1), (100.0, np.float64, 1)),
        *((65.535, np.float32, 1), (10.0, np.float16, 1), (65504.0, np.float16, 1000), (10_000.0, np.float32, 1000)),
    ],
)
def test_a_mark_of_nothing_measured_is_no_reading_and_is_named(table, mark, dtype, scale):
    numbers = (table * scale).astype(dtype)
    numbers[HOLES] = mark
    found = metres(numbers, None if scale in (1, 1000) and np.dtype(dtype).kind != "f" else scale)
    np.testing.assert_array_equal(np.isnan(found.depth), HOLES)
    np.testing.assert_allclose(found.depth[~HOLES], table[~HOLES], atol=0.02 if np.dtype(dtype).itemsize < 4 else 2e-3)
    (note,) = found.notes
    assert "is taken for no reading" in note
    assert f"{mark:.6g}" in note


def flat(wall, dtype=np.float32):
    """A wall at one distance behind two boxes, as a renderer draws it."""
    z = np.full((120, 160), wall)
    z[30:60, 20:50], z[50:100, 90:130] = 0.7, 0.9
    return z.astype(dtype)


@pytest.mark.parametrize(
    "numbers",
    [
        flat(2.0),
        flat(3.0),
        flat(0.95),
        (1000 * flat(2.5)).astype(np.uint16),
        np.full((120, 160), 10.0, np.float32),
        np.round(np.tile(np.linspace(0.5, 1.5, 160, dtype=np.float32), (120, 1)), 1),
        np.minimum(np.tile(np.linspace(0.5, 14, 160, dtype=np.float32), (120, 1)), 10.0),
        np.where(np.random.default_rng(0).random((120, 160)) < 0.1, 0, 800).astype(np.uint16),
    ],
    ids=["wall", "far wall", "floor from above", "millimetres", "nothing else", "quantised", "clipped", "flat, holes"],
)
def test_what_many_pixels_share_is_a_reading_where_it_may_be_one(numbers):
    found = metres(numbers)
    assert not found.notes
    np.testing.assert_array_equal(np.isfinite(found.depth), numbers > 0)


def test_other_holes_do_not_make_a_surface_a_mark():
    """What is left of the image of 10.0 m is a box that has nothing around it but holes."""
    (note,) = metres(flat(10.0)).notes
    assert note.startswith("10 m")


def test_raw_disparities_of_a_kinect_are_refused(table):
    raw = np.round((3.3309 - 1 / table) / 0.0030711).astype(np.uint16)
    raw[HOLES] = 2047
    with pytest.raises(UnitsError, match=r"raw disparities of a Kinect.*z = 1 / \(3\.3309"):
        metres(raw)
    assert np.isfinite(metres(raw, scale=1000.0).depth).any(), "the scale that is asked for goes before"


@pytest.mark.parametrize(
    ("value", "scale"),
    [(0.1, 1e4), (1.0, 1e3), (0.001, 1e3), (0.000125, 8e3), (0.00025, 4e3), (1e-4, 1e4), (5000.0, 5e3), (1000, 1e3)],
)
def test_conventions_of_a_stated_unit_are_told_apart_by_magnitude(value, scale):
    assert parse_scale(value, "depth_scale").scale == pytest.approx(scale)
    for none in (0.0, -value, np.inf, np.nan):
        with pytest.raises(ValueError, match="positive number"):
            parse_scale(none, "depth_scale")


def test_a_stated_unit_is_of_whole_numbers_and_the_callers_goes_before(table):
    known = parse_scale(0.1, "depth_scale")
    whole = np.round(1e4 * table).astype(np.uint16)
    found = metres(whole, known=known)
    np.testing.assert_allclose(found.depth, table, atol=1e-4)
    assert "10000 units are a metre: depth_scale = 0.1 (millimetres a unit)" in found.notes
    assert metres(whole, 1000.0, known).scale == 1000.0
    assert metres(table, known=known).scale == 1.0, "floats are metres"
    assert metres(1e4 * table, known=known).scale == 1e4, "unless they can hardly be"


def test_what_no_camera_measures_is_named(table):
    assert not wrong_unit(table)
    assert "for millimetres the depth scale is 1000" in wrong_unit(1000 * table)
    assert "for metres the depth scale is 1" in wrong_unit(table / 1000)


def test_ranges_become_z_along_the_axis(rng):
    points = CAMERA.points(rng.uniform(0.5, 2.0, (120, 160)).astype(np.float32))
    z = z_from_range(np.linalg.norm(points, axis=2).astype(np.float32), CAMERA)
    np.testing.assert_allclose(z, points[..., 2], rtol=1e-6)


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
