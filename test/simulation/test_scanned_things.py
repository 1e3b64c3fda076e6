"""Things of one's own: a mesh is seen as the body that it is made of, rests on its faces, and tells its hull."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from sq_perception import Camera, Superquadric, mesh
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.union import DIRECTIONS
from sq_perception.imaging import canonical_view, raycast
from sq_perception.learning.shard_training import THINGS, read_views, write_views
from sq_perception.simulation.rendering import Mesh, render_mesh
from sq_perception.simulation.thing import read_things
from sq_perception.simulation.thing_setting import draw_setting
from sq_perception.simulation.thing_views import draw_thing_views, support_in_view

CAMERA = Camera(640, 480, 554.0, 554.0, 319.5, 239.5)
BODY = Superquadric([0.06, 0.04, 0.03], [0.3, 0.7], [0.05, -0.03, 0.7], [0.3, -0.2, 0.5, 0.8])
EDGES = np.array([0.06, 0.09, 0.15])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of one box, away from the origin."""
    box = trimesh.creation.box(EDGES)
    box.apply_translation([0.3, -0.2, 0.1])
    box.export(tmp_path / "crate.ply")
    return tmp_path


def test_a_rasterised_superquadric_is_the_ray_cast_one() -> None:
    fine = mesh(BODY, 128)
    depth = render_mesh(Mesh(fine.vertices, fine.faces), CAMERA)
    expected, _ = raycast.render(BODY, CAMERA)
    seen, truly = np.isfinite(depth), np.isfinite(expected)
    assert (seen != truly).sum() <= 0.01 * truly.sum()
    # The facets lie inside the body, the more the flatter the ray: the median is what the sampling of the mesh costs.
    error = depth[seen & truly] - expected[seen & truly]
    assert error.min() > -1e-9
    assert np.median(error) < 5e-5


def test_neighbouring_triangles_leave_no_gap() -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.1)).subdivide().subdivide()
    vertices = box.vertices @ quaternions.to_matrix(quaternions.from_rotation_vector(np.array([0.4, 0.3, 0.2]))).T
    seen = np.isfinite(render_mesh(Mesh(vertices + [0, 0, 0.6], box.faces), CAMERA))
    for line in (*seen, *seen.T):
        inside = np.flatnonzero(line)
        assert len(inside) == 0 or len(inside) == inside[-1] - inside[0] + 1


def test_a_box_rests_on_its_faces_mostly_on_large_ones_and_a_ball_in_many_ways(folder: Path) -> None:
    (thing,) = read_things(folder)
    assert thing.name == "crate"
    np.testing.assert_allclose(thing.box[1] - thing.box[0], EDGES, atol=1e-4)
    heights: dict[float, float] = {}
    for rest in thing.rests:
        up = np.abs(quaternions.to_matrix(rest.turn)[2])
        assert up.max() == pytest.approx(1, abs=1e-6)
        height = float(np.round(EDGES[np.argmax(up)], 3))
        heights[height] = heights.get(height, 0.0) + rest.likely
    assert sum(heights.values()) == pytest.approx(1)
    assert heights[0.06] > heights[0.09] > heights[0.15]
    trimesh.creation.icosphere(radius=0.05).export(folder / "crate.ply")
    (thing,) = read_things(folder)
    assert len(thing.rests) > 100
    assert sum(rest.likely for rest in thing.rests) == pytest.approx(1)


def test_views_of_a_mesh_tell_its_hull(folder: Path) -> None:
    """What is seen lies within the true support function, and touches it in some direction."""
    (thing,) = read_things(folder)
    rng = np.random.default_rng(3)
    for _ in range(5):
        setting = draw_setting(thing, rng)
        depth, seen = setting.render()
        if not seen.any():
            continue
        rows, columns = np.nonzero(seen)
        reach = (setting.camera.unproject(columns, rows, depth[rows, columns]) @ DIRECTIONS.T).max(axis=0)
        truth = (setting.parts.translation @ DIRECTIONS.T).max(axis=0)
        assert (reach < truth + 1e-4).all()
        assert (truth - reach).min() < 0.005


def test_half_of_the_views_show_ones_own_things(folder, tmp_path, capsys) -> None:
    own = read_things(folder)
    write_views(tmp_path / "views", range(1), lambda rng: draw_thing_views(40, rng, own=own), 5)
    views = read_views(THINGS.none, [tmp_path / "views" / "00000.safetensors"])
    drawn = draw_thing_views(40, np.random.default_rng([5, 0]), own=own)
    np.testing.assert_array_equal(views.support, drawn.support)
    assert 8 <= (views.kinds == 6).sum() <= 32
    assert np.isfinite(views.support).all()
    assert capsys.readouterr().out.count("views\n") == 1


def test_a_long_thing_is_wholly_before_the_camera(tmp_path: Path) -> None:
    trimesh.creation.box([0.95, 0.06, 0.05]).export(tmp_path / "bat.ply")
    (thing,) = read_things(tmp_path)
    for seed in range(200):
        setting = draw_setting(thing, np.random.default_rng(seed))
        assert setting.surface is not None
        assert setting.surface.vertices[:, 2].min() > 0.04


def test_support_in_a_view_is_that_of_the_corners(folder: Path) -> None:
    (thing,) = read_things(folder)
    setting = draw_setting(thing, np.random.default_rng(8))
    depth, seen = setting.render()
    view = canonical_view.from_mask(depth, seen, setting.camera)
    assert setting.surface is not None
    directions = DIRECTIONS @ quaternions.to_matrix(view.rotation)
    expected = ((setting.surface.vertices @ directions.T).max(axis=0) - directions @ view.anchor) / view.extent
    assert support_in_view(setting.parts, view) == pytest.approx(expected, abs=1e-3)


def test_what_is_no_thing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected meshes"):
        read_things(tmp_path)
    trimesh.creation.box([60.0, 90.0, 150.0]).export(tmp_path / "millimetres.stl")
    with pytest.raises(ValueError, match="expected metres"):
        read_things(tmp_path)
    (tmp_path / "millimetres.stl").unlink()
    (tmp_path / "broken.ply").write_bytes(b"ply\nnothing")
    with pytest.raises(ValueError, match="no mesh with a volume"):
        read_things(tmp_path)
    sheet = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0.0]])
    trimesh.Trimesh(sheet, [[0, 1, 2], [0, 2, 3]], process=False).export(tmp_path / "broken.ply")
    with pytest.raises(ValueError, match=r"broken\.ply: no mesh with a volume"):
        read_things(tmp_path)


@pytest.mark.parametrize("sides", [32, 300])
def test_a_round_thing_lies_as_often_however_finely_it_is_divided(tmp_path: Path, sides: int) -> None:
    trimesh.creation.cylinder(0.03, 0.15, sections=sides).export(tmp_path / "can.ply")
    (thing,) = read_things(tmp_path)
    standing = sum(rest.likely for rest in thing.rests if abs(quaternions.to_matrix(rest.turn)[2, 2]) > 0.9)
    assert standing == pytest.approx(0.071, abs=0.02)


def test_points_of_no_face_are_no_part_of_a_thing_and_hidden_files_are_none(folder: Path) -> None:
    (folder / "._crate.ply").write_bytes(b"of a file system")
    box = trimesh.creation.box(EDGES)
    stray = trimesh.Trimesh(np.concatenate([box.vertices, [[0.5, 0.5, 0.5]]]), box.faces, process=False)
    stray.export(folder / "crate.ply")
    (thing,) = read_things(folder)
    np.testing.assert_allclose(thing.box[1] - thing.box[0], EDGES, atol=1e-4)
