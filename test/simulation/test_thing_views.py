"""Views of things and of segments to train on: what images make of them, poses on the table, and their truth."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sq_perception import Camera, Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.union import DIRECTIONS, mirrored, support_of_union
from sq_perception.imaging import canonical_view
from sq_perception.imaging.canonical_view import COVERED, FLUSH, HIDDEN, NEAREST
from sq_perception.imaging.raycast import render
from sq_perception.imaging.segment_view import IMAGE, MEASURED, SEGMENT
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.simulation import segment_views
from sq_perception.simulation.household import KINDS, draw_thing
from sq_perception.simulation.rendering import render_things
from sq_perception.simulation.segment_views import NO, UNKNOWN, YES, SegmentViews, draw_segment_views
from sq_perception.simulation.thing_setting import Setting, draw_setting
from sq_perception.simulation.thing_views import draw_thing_views, support_in_view

NOTHING = Superquadric.stack([])


def alone(setting: Setting, camera: Camera | None = None) -> Setting:
    return Setting(setting.parts, setting.cavities, NOTHING, None, 10.0, camera or setting.camera)


def finer(camera: Camera, times: int) -> Camera:
    """The same image with more pixels: centres are those of the pixels' middles."""
    width, height, fx, fy = (times * each for each in (camera.width, camera.height, camera.fx, camera.fy))
    return Camera(width, height, fx, fy, (camera.cx + 0.5) * times - 0.5, (camera.cy + 0.5) * times - 0.5)


def flipped(bodies: Superquadric) -> Superquadric:
    """The mirror image of bodies, x to -x: each is symmetric, so that a rotation does it."""
    sign = np.array([-1.0, 1.0, 1.0])
    return Superquadric(bodies.size, bodies.shape, bodies.translation * sign, bodies.rotation * [1.0, -1.0, -1.0, 1.0])


def test_views_look_as_promised() -> None:
    views = draw_thing_views(30, np.random.default_rng(0))
    assert views.images.shape == (30, 64, 64)
    assert views.images.dtype == np.float32
    assert views.planes.shape == (30, 4)
    assert views.support.shape == (30, len(DIRECTIONS))
    assert views.planes.dtype == views.support.dtype == np.float32
    hidden = (views.images <= HIDDEN) & (views.images > COVERED)
    assert ((views.images >= FLUSH) | (hidden & (views.images >= 2 * HIDDEN)) | (views.images == COVERED)).all()
    # Half of the masks cover what is not measured; in a part of the views all is measured.
    assert 0.15 < (views.images == COVERED).any(axis=(1, 2)).mean() < 0.5
    assert (views.images <= 1).all()
    assert (views.images > 0).any(axis=(1, 2)).all()
    assert hidden.any(axis=(1, 2)).mean() > 0.5
    assert np.isfinite(views.support).all()
    assert np.abs(views.support).max() <= 3
    given = views.planes.any(axis=1)
    assert 0.6 < given.mean() < 0.95
    np.testing.assert_allclose(np.linalg.norm(views.planes[given, :3], axis=1), 1, atol=1e-6)
    assert set(views.kinds) <= set(range(len(KINDS)))


def test_things_are_seen_from_the_elevations_that_are_drawn() -> None:
    """Whatever the camera's roll, and however far off its axis: from above the table, often from straight above it."""
    rng = np.random.default_rng(4)
    settings = [draw_setting(draw_thing(rng, ["box"]), rng) for _ in range(400)]
    sines = []
    for setting in settings:
        if setting.table is not None:
            middle = setting.parts.translation.mean(axis=0)
            sines.append(-setting.table[:3] @ middle / np.linalg.norm(middle))
    degrees = np.rad2deg(np.arcsin(sines))
    assert degrees.min() > 2
    assert 0.15 < np.mean(degrees > 65) < 0.35
    assert 0.1 < np.mean(degrees < 20) < 0.25


def test_a_view_is_that_of_a_large_image() -> None:
    """Three times the pixels show the same thing, framed alike; the renderer agrees with the plain ray caster."""
    rng = np.random.default_rng(2)
    for kind in ("box", "can", "bottle", "round", "tool"):
        setting = alone(draw_setting(draw_thing(rng, [kind]), rng))
        depth, seen = setting.render()
        fine = finer(setting.camera, 3)
        plain, index = render(setting.parts, fine)
        plain = np.where(np.isfinite(plain), plain, 10.0)
        coarse_view = canonical_view.from_mask(depth, seen, setting.camera, missing_is_hidden=True)
        fine_view = canonical_view.from_mask(plain, index >= 0, fine, missing_is_hidden=True)
        assert coarse_view.extent == pytest.approx(fine_view.extent, rel=0.06)
        both = (coarse_view.image > 0) & (fine_view.image > 0)
        assert both.sum() > 0.8 * ((coarse_view.image > 0) | (fine_view.image > 0)).sum()
        assert np.median(np.abs(coarse_view.image - fine_view.image)[both]) < 0.02
        reaches = [support_in_view(setting.parts, view) for view in (coarse_view, fine_view)]
        assert np.abs(reaches[0] - reaches[1]).max() < 0.06


def test_the_truth_holds_what_the_view_shows() -> None:
    """Every point that a view shows is within the hull, and the nearest one touches it."""
    rng = np.random.default_rng(3)
    for kind in KINDS:
        setting = alone(draw_setting(draw_thing(rng, [kind]), rng))
        depth, seen = setting.render()
        view = canonical_view.from_mask(depth, seen, setting.camera, 48)
        rows, columns = np.nonzero(view.image > 0)
        points = np.stack([(columns + 0.5) / 48, 1 - (rows + 0.5) / 48, view.image[rows, columns]], axis=1)
        points -= [0.5, 0.5, NEAREST]
        reach = support_in_view(setting.parts, view)
        # A view pixel shows the image pixel next to it, so that steep sides are off by about a pixel of either.
        pixel = float(np.median(depth[seen])) / setting.camera.fx / view.extent
        assert ((points @ DIRECTIONS.T).max(axis=0) < reach + 1.5 * pixel + 1 / 48).all()
        assert reach[np.argmax(DIRECTIONS @ [0.0, 0.0, 1.0])] > -0.02


def test_a_mirrored_thing_has_the_mirrored_view() -> None:
    rng = np.random.default_rng(4)
    for kind in ("bottle", "union", "vessel"):
        setting = alone(draw_setting(draw_thing(rng, [kind]), rng))
        camera = setting.camera
        other = Setting(
            flipped(setting.parts), flipped(setting.cavities) if len(setting.cavities) else NOTHING, NOTHING, None,
            10.0, Camera(camera.width, camera.height, camera.fx, camera.fy, camera.width - 1 - camera.cx, camera.cy),
        )
        images, reaches = [], []
        for one in (setting, other):
            depth, seen = one.render()
            view = canonical_view.from_mask(depth, seen, one.camera)
            images.append(view.image)
            reaches.append(support_in_view(one.parts, view))
        np.testing.assert_allclose(reaches[1], reaches[0][mirrored(0)], atol=1e-4)
        # Nearest pixels may differ where two are as near.
        assert (np.abs(images[1][:, ::-1] - images[0]) < 1e-3).mean() > 0.97


def test_planes_move_into_the_view_with_their_points() -> None:
    rng = np.random.default_rng(5)
    setting = draw_setting(draw_thing(rng, ["box"]), np.random.default_rng(6))
    assert setting.table is not None
    depth, seen = alone(setting).render()
    view = canonical_view.from_mask(depth, seen, setting.camera)
    across = np.linalg.svd(setting.table[None, :3])[2][1:]
    points = -setting.table[3] * setting.table[:3] + rng.uniform(-0.1, 0.1, (20, 2)) @ across
    matrix = quaternions.to_matrix(view.rotation)
    moved = (points - view.anchor) @ matrix.T / view.extent + [0.5, 0.5, NEAREST]
    plane = view.plane_to_canonical(setting.table)
    np.testing.assert_allclose(moved @ plane[:3] + plane[3], 0, atol=1e-9)
    height = 0.03
    raised = (points + height * setting.table[:3] - view.anchor) @ matrix.T / view.extent + [0.5, 0.5, NEAREST]
    np.testing.assert_allclose(raised @ plane[:3] + plane[3], height / view.extent, atol=1e-9)


def test_one_sees_into_a_cup() -> None:
    """From above, the middle of an open cup is its floor; beside the cavity nothing changes."""
    body = Superquadric([[0.04, 0.04, 0.05]], [[0.1, 1.0]], [[0.0, 0.0, 0.5]], [[0.0, 0.0, 0.0, 1.0]])
    hole = Superquadric([[0.035, 0.035, 0.09]], [[0.1, 1.0]], [[0.0, 0.0, 0.45]], [[0.0, 0.0, 0.0, 1.0]])
    camera = Camera(81, 81, 300.0, 300.0, 40.0, 40.0)
    closed, _ = render_things(body, np.zeros(1), NOTHING, np.zeros(0), camera)
    opened, thing = render_things(body, np.zeros(1), hole, np.zeros(1), camera, behind=2.0)
    assert closed[40, 40] == pytest.approx(0.45)
    assert (opened[40, 40], opened[40, 15]) == (pytest.approx(0.54), pytest.approx(closed[40, 15]))
    assert thing[40, 15] == 0
    assert opened[0, 0] == 2.0
    assert thing[0, 0] == -1


def test_table_and_wall_hide_what_is_behind_them() -> None:
    ball = Superquadric([[0.05, 0.05, 0.05]], [[1.0, 1.0]], [[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.0, 1.0]])
    camera = Camera(41, 41, 200.0, 200.0, 20.0, 20.0)
    table = np.array([0.0, -1.0, 0.0, 0.0]) + [0, 0, 0, 0.02]  # y = 0.02, seen from above
    depth, thing = render_things(ball, np.zeros(1), NOTHING, np.zeros(0), camera, table, behind=3.0)
    assert thing[20, 20] == 0
    assert depth[0, 0] == 3.0
    below = (np.arange(41) - 20) / 200
    assert thing[40, 20] == -1
    assert depth[40, 20] == pytest.approx(0.02 / below[40])


@pytest.mark.parametrize("columns", [2, 6])
def test_pixels_without_a_reading_are_hidden_where_asked_for(columns: int) -> None:
    """Beside the object, on it and beyond the image; else the view stays as it was."""
    camera = Camera(60, 60, 100.0, 100.0, 30.0, 30.0)
    body = Superquadric([[0.05, 0.05, 0.05]], [[1.0, 1.0]], [[0.0, 0.0, 0.5]], [[0.0, 0.0, 0.0, 1.0]])
    depth, index = render(body, camera)
    depth = np.where(np.isfinite(depth), depth, 1.0)
    mask = index >= 0
    left = int(np.nonzero(mask)[1].min())
    depth[:, : left + columns] = np.nan
    mask &= np.isfinite(depth)
    plain = canonical_view.from_mask(depth, mask, camera, find_hidden=True)
    marked = canonical_view.from_mask(depth, mask, camera, missing_is_hidden=True)
    np.testing.assert_array_equal(plain.image, marked.image)
    assert (plain.hidden <= marked.hidden).all()
    assert marked.hidden.sum() > plain.hidden.sum()
    assert not (marked.hidden & (marked.image > 0)).any()
    # What the image does not show at all.
    window = np.s_[:, left + 3 :]
    shown = depth[window], mask[window], camera.cropped(left + 3, 0, 57 - left, 60)
    assert canonical_view.from_mask(*shown, missing_is_hidden=True).hidden[:, 0].all()
    assert not canonical_view.from_mask(*shown).hidden.any()


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_view_frames_the_whole_mask_though_not_all_of_it_was_measured(share: float) -> None:
    """A card, so that all of it is as deep as what was measured."""
    camera = Camera(80, 80, 100.0, 100.0, 39.5, 39.5)
    depth, mask = np.full((80, 80), 2.0), np.zeros((80, 80), bool)
    mask[25:55, 20:60] = True
    depth[mask] = 1.0
    whole = canonical_view.from_mask(depth, mask, camera, missing_is_hidden=True)
    depth[:, 20 : 20 + round(40 * share)] = np.nan
    view = canonical_view.from_mask(depth, mask, camera, missing_is_hidden=True)
    assert view.extent == pytest.approx(whole.extent, rel=1e-3)
    np.testing.assert_allclose(view.anchor, whole.anchor, atol=1e-3)
    covered = view.with_steps == COVERED
    np.testing.assert_array_equal(covered | (view.image > 0), whole.image > 0)
    assert np.count_nonzero(covered) / np.count_nonzero(whole.image) == pytest.approx(share, abs=0.03)
    of_depth = canonical_view.from_mask(depth, mask & np.isfinite(depth), camera, missing_is_hidden=True)
    assert of_depth.extent == pytest.approx(whole.extent * max(1 - share, 30 / 40), rel=0.02)
    assert not (of_depth.with_steps == COVERED).any()


def test_what_a_thing_stands_on_touches_it() -> None:
    """The table, or the top of what is between: as high as its lowest point."""
    heights = []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        setting = draw_setting(draw_thing(rng), rng)
        if setting.table is None:
            assert setting.under is None
            continue
        normal, offset = setting.under[:3], setting.under[3]
        assert setting.table[3] > 0, "the plane faces the camera"
        assert len(setting.others) or setting.height == 0
        assert abs(offset - support_of_union(setting.parts, -normal[None])[0]) < 1e-6
        heights.append(float(setting.table[3] - setting.under[3]))
    assert 0.02 < np.mean(np.array(heights) > 0) < 0.25
    assert max(heights) > 0.02


def test_what_is_around_a_thing_does_not_go_through_itself() -> None:
    rng = np.random.default_rng(12)
    pairs = 0
    for _ in range(150):
        others = draw_setting(draw_thing(rng), rng).others
        surfaces = [other.sample_surface(200, rng, oversampling=2) for other in others]
        for i, other in enumerate(others):
            for j, points in enumerate(surfaces):
                if i != j:
                    assert other.gauge(points).min() > 0.97
                    pairs += 1
    assert pairs > 20


@pytest.fixture(scope="module")
def drawn() -> SegmentViews:
    return draw_segment_views(10, np.random.default_rng(4))


def test_truth_is_known_where_measured_most_of_a_segment_is_its_object_and_borders_cut_some(drawn) -> None:
    """Cut ones have cells outside of the image beside cells of the segment."""
    assert len(drawn.images) == len(drawn.truth) > 10
    np.testing.assert_array_equal(drawn.truth == UNKNOWN, drawn.images[..., MEASURED] == 0)
    inside = (drawn.images[..., SEGMENT] > 0) & (drawn.truth != UNKNOWN)
    assert np.median((inside & (drawn.truth == YES)).sum(axis=(1, 2)) / inside.sum(axis=(1, 2))) > 0.85
    assert (drawn.truth[inside] == NO).any()
    outside = drawn.images[..., IMAGE] == 0
    beside = (outside[:, 1:] & (drawn.images[:, :-1, :, SEGMENT] > 0)) | (
        outside[:, :-1] & (drawn.images[:, 1:, :, SEGMENT] > 0)
    )
    assert 0 < np.count_nonzero(beside.any(axis=(1, 2))) < len(drawn.images)


def test_scenes_without_segments_give_an_empty_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = FrameEvidence(np.zeros((1, 1), np.int32))
    monkeypatch.setattr(segment_views.segments, "segment", lambda *_: nothing)
    assert draw_segment_views(1, np.random.default_rng(1)).truth.shape == (0, 64, 64)


def test_pieces_of_merged_things_show_one_thing_each_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    find = segment_views.segments.segment

    def merged(*image: Any) -> FrameEvidence:
        found = find(*image)
        return replace(found, labels=(found.labels > 0).astype(np.int32), ids=(1,) if found.ids else ())

    monkeypatch.setattr(segment_views.segments, "segment", merged)
    scenes = 3
    drawn = draw_segment_views(scenes, np.random.default_rng(2))
    inside = (drawn.images[..., SEGMENT] > 0) & (drawn.truth != UNKNOWN)
    pure = (inside & (drawn.truth == YES)).sum(axis=(1, 2)) / inside.sum(axis=(1, 2))
    assert np.count_nonzero((pure > 0) & (pure < 0.7)) <= scenes
    assert np.count_nonzero(pure >= 0.7) > 2 * scenes
