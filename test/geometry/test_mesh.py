"""Meshes: closed, convex, on the surface, and of the right volume."""

import numpy as np
import pytest
import trimesh

from sq_perception.geometry import rotation
from sq_perception.geometry.mesh import COLOURS, export, mesh, outline, sample
from sq_perception.geometry.superquadric import Superquadric


def body(size=(0.1, 0.2, 0.3), shape=(1.0, 1.0), seed=0) -> Superquadric:
    rng = np.random.default_rng(seed)
    return Superquadric(np.array(size), np.array(shape), rng.normal(size=3), rotation.random(1, rng)[0])


@pytest.mark.parametrize("e1", [0.01, 0.1, 0.5, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("e2", [0.01, 0.1, 0.5, 1.0, 1.5, 2.0])
def test_volume_tends_to_the_closed_form_from_below(e1, e2):
    one = body(shape=(e1, e2))
    exact = float(one.volume())
    fine, coarse = mesh(one, 96).volume, mesh(one, 48).volume
    assert coarse <= fine * (1 + 1e-9)
    assert fine <= exact * (1 + 1e-9)
    assert fine >= 0.995 * exact


@pytest.mark.parametrize("seed", range(30))
def test_random_bodies_are_watertight_convex_and_on_the_surface(seed):
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-3, 0, 3)
    shape = rng.choice([0.01, 0.1, 0.37, 1.0, 1.3, 2.0], 2)
    one = Superquadric(size, shape, rng.normal(size=3), rotation.random(1, rng)[0])
    made = mesh(one, 16)
    assert made.is_watertight
    assert made.is_winding_consistent
    assert made.volume > 0
    assert made.euler_number == 2
    np.testing.assert_allclose(one.gauge(made.vertices), 1, atol=1e-9)
    outwards = np.einsum("ij,ij->i", made.face_normals, made.triangles_center - one.translation)
    assert (outwards[made.area_faces > 1e-12 * made.area] > 0).all()


def test_a_box_has_its_corners():
    box = Superquadric(np.array([1.0, 2.0, 3.0]), np.array([0.01, 0.01]), np.zeros(3), np.array([0, 0, 0, 1.0]))
    np.testing.assert_allclose(mesh(box, 16).bounds, [[-1, -2, -3], [1, 2, 3]], rtol=1e-6)
    assert mesh(box, 16).volume == pytest.approx(48, rel=0.02)


def test_outline_lies_on_the_surface_and_is_the_edges_of_a_box():
    lines = outline(body(shape=(0.4, 1.0)))
    assert lines.shape[1:] == (2, 3)
    np.testing.assert_allclose(body(shape=(0.4, 1.0)).gauge(lines.reshape(-1, 3)), 1, atol=1e-9)
    box = Superquadric(np.array([1.0, 2.0, 3.0]), np.array([0.01, 0.01]), np.zeros(3), np.array([0, 0, 0, 1.0]))
    near_face = np.abs(np.abs(outline(box)) / box.size - 1) < 0.02
    assert (near_face.sum(axis=-1) >= 2).all(), "every point of a box's edges lies on two faces"


def test_export_writes_scenes_that_read_back(tmp_path):
    bodies = [body(seed=1), body(size=(0.3, 0.1, 0.1), seed=2)]
    total = sum(float(one.volume()) for one in bodies)
    merged = trimesh.load_mesh(export(bodies, tmp_path / "bodies.ply"))
    assert merged.volume == pytest.approx(total, rel=0.02)
    np.testing.assert_allclose(merged.visual.vertex_colors[0, :3] / 255, COLOURS[0], atol=0.005)
    scene = trimesh.load_scene(export(Superquadric.stack(bodies), tmp_path / "bodies.glb"))
    assert sorted(scene.graph.nodes_geometry) == ["body_0", "body_1"]
    upright = scene.to_mesh().bounds.mean(axis=0)
    np.testing.assert_allclose(upright, merged.bounds.mean(axis=0) * [1, -1, -1], atol=1e-5)
    for suffix in ("stl", "obj"):
        scene = trimesh.load_scene(export(bodies, tmp_path / f"bodies.{suffix}"))
        np.testing.assert_allclose(scene.bounds, merged.bounds, atol=1e-5)
        assert scene.to_mesh().volume == pytest.approx(merged.volume, rel=1e-4)


def test_sampled_points_are_on_the_surface_and_the_same_for_a_seed():
    points = sample(body(), 200)
    np.testing.assert_allclose(body().gauge(points), 1, atol=1e-9)
    np.testing.assert_array_equal(points, sample(body(), 200))
    assert points.shape == (200, 3)


def test_misuse_is_refused(tmp_path):
    with pytest.raises(ValueError, match="multiple of 8"):
        mesh(body(), 10)
    with pytest.raises(ValueError, match="single body"):
        mesh(Superquadric.stack([body(), body()]))
    with pytest.raises(ValueError, match=r"\.glb, \.ply, \.stl, \.obj"):
        export(body(), tmp_path / "body.off")
    with pytest.raises(ValueError, match="no body"):
        export([], tmp_path / "none.glb")
    with pytest.raises(ValueError, match="names: expected 2 different ones"):
        export([body(), body()], tmp_path / "two.glb", names=["a", "a"])


@pytest.mark.parametrize("colours", [[], [1.0, 0.0, 0.0], [[255, 0, 0]], [[1.0, 0.0, 0.0, 0.5]], [[np.nan, 0, 0]]])
def test_colours_that_are_none_are_refused(tmp_path, colours):
    """Bytes would wrap: 255 times 255 is 1."""
    with pytest.raises(ValueError, match=r"colours: expected red, green, blue \(n, 3\) in \[0, 1\], got"):
        export(body(), tmp_path / "one.glb", colours=colours)


def test_any_two_colours_differ_to_every_eye():
    """CIE 1976 differences as normal, deuteranopic and protanopic eyes see them (Machado et al. 2009, severity 1)."""
    deuteranopic = [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]]
    protanopic = [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    linear = np.where(COLOURS <= 0.04045, COLOURS / 12.92, ((COLOURS + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]]
    )
    for eye in (np.eye(3), deuteranopic, protanopic):
        share = np.clip(linear @ np.transpose(eye), 0, 1) @ to_xyz.T / to_xyz.sum(axis=1)
        x, y, z = np.where(share > (6 / 29) ** 3, np.cbrt(share), share / (3 * (6 / 29) ** 2) + 4 / 29).T
        lab = np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)
        assert (np.linalg.norm(lab[:, None] - lab, axis=-1) + 100 * np.eye(len(lab))).min() > 25, eye


def test_markers_have_the_colours_of_meshes():
    """sq_msgs_py stands alone, so that it has a table of its own."""
    pytest.importorskip("visualization_msgs", reason="needs the extra 'ros'")
    from sq_msgs_py.markers import PALETTE

    np.testing.assert_array_equal(PALETTE, COLOURS)
