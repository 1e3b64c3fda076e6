"""The view of a segment in its surroundings: what cells show, on which pixels they lie, and compact pieces of them."""

import numpy as np
import pytest

from sq_perception.imaging import segment_view
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.segment_view import (
    CHANNELS,
    GRAIN,
    HEIGHT,
    IMAGE,
    MEASURED,
    NEARNESS,
    OTHERS,
    PIXELS,
    PLANE,
    SCALE,
    SEGMENT,
    compact_pieces,
)

CAMERA = Camera(200, 150, 180.0, 180.0, 99.5, 74.5)
WINDOW = slice(50, 90), slice(60, 120)


def table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A block at 0.8 m before a wall at 1 m, another beside it, a hole; the wall is the plane."""
    depth, labels = np.full((150, 200), 1.0, np.float32), np.zeros((150, 200), np.int32)
    depth[WINDOW], labels[WINDOW] = 0.8, 1
    depth[60:80, 125:140], labels[60:80, 125:140] = 0.9, 2
    depth[65:70, 80:90] = np.nan
    return depth, labels, np.array([0.0, 0.0, -1.0, 1.0])


def view() -> segment_view.SegmentView:
    depth, labels, plane = table()
    return segment_view.from_segment(depth, labels, 1, WINDOW, CAMERA, plane)


def test_cells_show_the_pixels_under_their_middles() -> None:
    depth, labels, _ = table()
    shown = view()
    assert shown.image.shape == (PIXELS, PIXELS, CHANNELS)
    assert shown.side == 1.5 * 60 + 8
    grid = np.ix_(shown.rows, shown.columns)
    np.testing.assert_array_equal(shown.image[..., SEGMENT], labels[grid] == 1)
    np.testing.assert_array_equal(shown.image[..., OTHERS], labels[grid] == 2)
    np.testing.assert_array_equal(shown.image[..., MEASURED], np.isfinite(depth[grid]))
    scale = shown.side * 0.8 / CAMERA.fx
    known = np.isfinite(depth[grid])
    np.testing.assert_allclose(shown.image[known][:, NEARNESS], (0.8 - depth[grid][known]) / scale, atol=1e-6)
    np.testing.assert_allclose(shown.image[known][:, HEIGHT], (1.0 - depth[grid][known]) / scale, atol=1e-6)
    assert (shown.image[~known][:, [NEARNESS, HEIGHT]] == 0).all()
    assert (shown.image[..., [IMAGE, PLANE]] == 1).all()
    assert scale > 0.3
    np.testing.assert_allclose(shown.image[..., SCALE], np.log(0.3 / 0.2), rtol=1e-6)
    near = segment_view.from_segment(depth / 2, labels, 1, WINDOW, CAMERA, None)
    np.testing.assert_allclose(near.image[..., SCALE], np.log(scale / 2 / 0.2), rtol=1e-6)
    np.testing.assert_allclose(shown.image[..., GRAIN], np.log(shown.side / PIXELS), rtol=1e-6)


def test_a_sensor_s_noise_is_averaged_within_cells_and_not_across_steps() -> None:
    """Noise of nine independent readings is a third; a cell beside an edge shows one side of it."""
    times = 4
    rng = np.random.default_rng(3)
    depth, labels = (np.kron(each, np.ones((times, times), each.dtype)) for each in table()[:2])
    noise = (0.001 * rng.standard_normal(depth.shape)).astype(np.float32)
    camera = Camera(200 * times, 150 * times, 180.0 * times, 180.0 * times, 99.5 * times, 74.5 * times)
    window = slice(times * WINDOW[0].start, times * WINDOW[0].stop), slice(times * 60, times * 120)
    plane = table()[2]
    true, noisy = (segment_view.from_segment(each, labels, 1, window, camera, plane) for each in (depth, depth + noise))
    inside = true.image[..., MEASURED] > 0
    scale = true.side * 0.8 / camera.fx
    for channel in (NEARNESS, HEIGHT):
        errors = scale * (noisy.image - true.image)[inside][:, channel]
        assert abs(errors.std() / (0.001 / 3) - 1) < 0.15
    grid = np.ix_(true.rows, true.columns)
    np.testing.assert_allclose(true.image[inside][:, HEIGHT], (1.0 - depth[grid][inside]) / scale, atol=1e-6)


def test_beyond_the_image_there_is_nothing() -> None:
    depth, labels = np.full((150, 200), 1.0, np.float32), np.zeros((150, 200), np.int32)
    labels[:30, :40] = 1
    shown = segment_view.from_segment(depth, labels, 1, (slice(0, 30), slice(0, 40)), CAMERA, None)
    outside = (shown.rows < 0)[:, None] | (shown.columns < 0)
    assert outside.any()
    assert (shown.image[outside][:, [MEASURED, NEARNESS, HEIGHT, SEGMENT, OTHERS, IMAGE]] == 0).all()
    assert (shown.image[..., PLANE] == 0).all()


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_the_same_thing_at_another_grain_looks_alike(scale: float) -> None:
    """An image of ``scale`` times the pixels shows the same nearness and heights."""
    depth, labels, plane = table()
    times = int(scale)
    large = np.kron(depth, np.ones((times, times), np.float32)), np.kron(labels, np.ones((times, times), np.int32))
    camera = Camera(200 * times, 150 * times, 180.0 * times, 180.0 * times, 99.5 * times, 74.5 * times)
    window = tuple(slice(times * each.start, times * each.stop) for each in WINDOW)
    shown = segment_view.from_segment(*large, 1, (window[0], window[1]), camera, plane)
    inside = (shown.image[..., SEGMENT] > 0) & (shown.image[..., MEASURED] > 0)
    other = view()
    middle = (other.image[..., SEGMENT] > 0) & (other.image[..., MEASURED] > 0)
    np.testing.assert_allclose(shown.image[inside][:, HEIGHT].mean(), other.image[middle][:, HEIGHT].mean(), rtol=0.08)


@pytest.mark.parametrize("axis", [0, 1])
def test_pixels_that_are_not_square_show_the_same_shape(axis: int) -> None:
    """Every pixel twice along an axis: cells show what they did, and their values come back to the right pixels."""
    depth, labels, plane = table()
    times = np.array([2, 1]) if axis == 0 else np.array([1, 2])
    camera = Camera(200 * times[1], 150 * times[0], 180.0 * times[1], 180.0 * times[0], 0.0, 0.0)
    window = tuple(slice(k * each.start, k * each.stop) for k, each in zip(times.tolist(), WINDOW, strict=True))
    images = (np.repeat(image, 2, axis) for image in (depth, labels))
    shown = segment_view.from_segment(*images, 1, (window[0], window[1]), camera, plane)
    other = view()
    for along in (0, 1):
        extent, before = (each.image[..., SEGMENT].any(axis=along).sum() for each in (shown, other))
        assert abs(extent - before) < 4, "the margin of eight pixels is another share of it"
    inside = shown.image[..., SEGMENT].astype(np.float32)
    back = shown.at_pixels(inside, (slice(0, camera.height), slice(0, camera.width))) > 0.5
    true = np.repeat(labels, 2, axis) == 1
    assert np.count_nonzero(back & true) > 0.93 * np.count_nonzero(back | true)


def test_values_of_cells_come_back_to_their_pixels() -> None:
    """A linear ramp over the cells is a linear ramp over the pixels, at the places that the cells have."""
    shown = view()
    ramp = (shown.left + shown.side * (np.arange(PIXELS) + 0.5) / PIXELS)[None, :].repeat(PIXELS, axis=0)
    back = shown.at_pixels(ramp.astype(np.float32), WINDOW)
    assert back.shape == (40, 60)
    np.testing.assert_allclose(back, np.arange(60, 120)[None, :].repeat(40, axis=0) + 0.5, atol=0.05)


def test_the_rest_of_a_segment_is_other_segments_to_a_part() -> None:
    shown = view()
    cells = shown.image[..., SEGMENT] > 0
    left = cells & (np.arange(PIXELS) < PIXELS // 2)
    part = shown.of_part(left)
    np.testing.assert_array_equal(part[..., SEGMENT], left)
    np.testing.assert_array_equal(part[..., OTHERS] > 0, (shown.image[..., OTHERS] > 0) | (cells & ~left))
    same = [channel for channel in range(CHANNELS) if channel not in (SEGMENT, OTHERS)]
    np.testing.assert_array_equal(part[..., same], shown.image[..., same])
    np.testing.assert_array_equal(shown.of_part(cells), shown.image)


def square(side: int) -> np.ndarray:
    cells = np.zeros((40, 40), bool)
    cells[4 : 4 + side, 7 : 7 + side] = True
    return cells


@pytest.mark.parametrize("count", [1, 3, 4, 6])
def test_they_are_a_partition(count: int) -> None:
    cells = square(24)
    found = compact_pieces(cells, count, (0.0, 0.0))
    np.testing.assert_array_equal(found >= 0, cells)
    sizes = np.bincount(found[cells])
    assert len(sizes) == count
    assert sizes.min() > 0.5 * np.count_nonzero(cells) / count


def test_four_pieces_of_a_square_are_its_quarters_and_there_are_no_more_than_cells() -> None:
    found = compact_pieces(square(24), 4, (0.0, 0.0))
    assert np.bincount(found[found >= 0]).tolist() == [144] * 4
    for number in range(4):
        rows, columns = np.nonzero(found == number)
        assert np.ptp(rows) == np.ptp(columns) == 11
    cells = square(1)
    assert compact_pieces(cells, 4, (20.0, 20.0))[cells].tolist() == [0]
