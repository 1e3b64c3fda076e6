"""Solids and meshes that enclose superquadrics: closed forms, and thousands of surface points that lie inside."""

from dataclasses import replace

import numpy as np
import pytest
from random_bodies import random_bodies as random_bodies_of_cloud

pytest.importorskip("shape_msgs", reason="message packages missing: install the extra 'ros' or source ROS 2")

from shape_msgs.msg import SolidPrimitive

from sq_msgs_py.shapes import BOX, CYLINDER, SPHERE, Primitive, enclosing_factor, mesh_message, primitive, primitives
from sq_perception.geometry.mesh import MARKER_RESOLUTION, mesh
from sq_perception.geometry.superquadric import Superquadric

SIZE = np.array([0.05, 0.04, 0.03])
ROUND = np.array([0.04, 0.04, 0.09])
HERE = np.array([0.0, 0.0, 0.0, 1.0])


def body(size: np.ndarray, shape: np.ndarray | list[float]) -> Superquadric:
    return Superquadric(size, np.asarray(shape, float), np.zeros(3), HERE)


def random_bodies(count: int, seed: int = 5) -> list[Superquadric]:
    rng = np.random.default_rng(seed)
    sizes = np.exp(rng.uniform(np.log(0.01), np.log(0.3), (count, 3)))
    sizes[::3, 1] = sizes[::3, 0]
    shapes = rng.uniform(0.05, 2.0, (count, 2))
    shapes[::4] = rng.choice([0.1, 0.5, 1.0, 1.5, 2.0], (len(shapes[::4]), 2))
    return [body(size, shape) for size, shape in zip(sizes, shapes, strict=True)]


def surface(one: Superquadric, rng: np.random.Generator) -> np.ndarray:
    """Points of the surface, those of the parametric form among them, which crowd in edges and corners."""
    eta, omega = rng.uniform(-np.pi / 2, np.pi / 2, 4000), rng.uniform(-np.pi, np.pi, 4000)
    directions = rng.normal(size=(4000, 3)) * one.size
    on_rays = directions / one.gauge(directions)[:, None]
    return np.concatenate([one.parametric_points(eta, omega), on_rays])


def overshoot(solid: Primitive, points: np.ndarray) -> float:
    """How far points (n, 3) leave a solid, relative to its size; 0 where none does."""
    if solid.kind == BOX:
        return float((2 * np.abs(points) / solid.dimensions).max() - 1)
    if solid.kind == CYLINDER:
        height, radius = solid.dimensions
        across = np.hypot(points[:, 0], points[:, 1]) / radius
        return float(max(across.max(), (2 * np.abs(points[:, 2]) / height).max()) - 1)
    return float(np.linalg.norm(points, axis=1).max() / solid.dimensions[0] - 1)


@pytest.mark.parametrize(
    ("size", "shape", "kind", "dimensions"),
    [
        (SIZE, (0.1, 0.1), BOX, (0.10, 0.08, 0.06)),
        (SIZE, (0.2, 0.3), BOX, (0.10, 0.08, 0.06)),
        (ROUND, (0.1, 1.0), CYLINDER, (0.18, 0.04)),
        (ROUND, (0.3, 1.0), CYLINDER, (0.18, 0.04)),
        (np.full(3, 0.07), (1.0, 1.0), SPHERE, (0.07,)),
        (np.array([0.06, 0.03, 0.09]), (0.1, 1.0), BOX, (0.12, 0.06, 0.18)),
        (np.array([0.02, 0.05, 0.09]), (1.0, 1.0), BOX, (0.04, 0.10, 0.18)),
    ],
)
def test_each_body_gets_the_solid_that_it_looks_like(size, shape, kind, dimensions, rng):
    array = replace(random_bodies_of_cloud(2, rng), size=np.stack([size] * 2), shape=np.stack([shape] * 2))
    for solid, precision in ((primitive(size, shape), 1e-12), *((one, 1e-6) for one in primitives(array))):
        assert solid.kind == kind
        assert solid.dimensions == pytest.approx(dimensions, rel=precision)


def test_messages_have_the_order_of_dimensions_that_shape_msgs_asks_for():
    box, can, ball = (primitive(*one).message for one in ((SIZE, (0.1, 0.1)), (ROUND, (0.1, 1)), ([0.1] * 3, (1, 1))))
    assert (box.type, can.type, ball.type) == (SolidPrimitive.BOX, SolidPrimitive.CYLINDER, SolidPrimitive.SPHERE)
    edges = [box.dimensions[k] for k in (SolidPrimitive.BOX_X, SolidPrimitive.BOX_Y, SolidPrimitive.BOX_Z)]
    assert edges == pytest.approx([0.10, 0.08, 0.06])
    assert can.dimensions[SolidPrimitive.CYLINDER_HEIGHT] == pytest.approx(0.18)
    assert can.dimensions[SolidPrimitive.CYLINDER_RADIUS] == pytest.approx(0.04)
    assert ball.dimensions[SolidPrimitive.SPHERE_RADIUS] == pytest.approx(0.1)


def test_solids_enclose_their_bodies_and_touch_them():
    rng = np.random.default_rng(6)
    kinds = set()
    for one in random_bodies(120):
        solid = primitive(one.size, one.shape)
        kinds.add(solid.kind)
        assert -0.01 < overshoot(solid, surface(one, rng)) <= 1e-12
        volume = {BOX: np.prod(2 * one.size)}
        if solid.kind == CYLINDER:
            volume[CYLINDER] = np.pi * solid.dimensions[1] ** 2 * solid.dimensions[0]
        if solid.kind == SPHERE:
            volume[SPHERE] = 4 / 3 * np.pi * solid.dimensions[0] ** 3
        assert float(one.volume()) <= volume[solid.kind] * (1 + 1e-12)
        assert volume[solid.kind] <= volume[BOX] * (1 + 1e-12)
    assert kinds == {BOX, CYLINDER, SPHERE}


def test_grown_meshes_enclose_their_bodies_and_hardly_grow():
    rng = np.random.default_rng(9)
    factors = []
    for one in random_bodies(60, seed=10):
        made = mesh(one, MARKER_RESOLUTION)
        vertices, faces = np.asarray(made.vertices), np.asarray(made.faces)
        factor = enclosing_factor(vertices, faces, one.size, one.shape)
        factors.append(factor)
        corners = (factor * vertices)[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        kept = np.linalg.norm(normals, axis=1) > 1e-9 * one.size.max() ** 2
        normals = normals[kept] / np.linalg.norm(normals[kept], axis=1, keepdims=True)
        planes = np.einsum("ij,ij->i", normals, corners[kept, 0])
        # The mesh is convex: what is behind every face is inside.
        assert (surface(one, rng) @ normals.T <= planes + 1e-9 * one.size.max()).all()
        if one.shape.max() < 2:
            assert (one.support(normals) / planes).max() == pytest.approx(1, abs=1e-6)
    assert max(factors) < 1.03


def test_an_octahedron_is_its_own_mesh():
    vertices = np.concatenate([np.diag(SIZE), -np.diag(SIZE)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    assert enclosing_factor(vertices, np.array(faces), SIZE, (2.0, 2.0)) == pytest.approx(1, abs=1e-12)
    # The ball through its six corners reaches sqrt(3) beyond the middle of its faces.
    assert enclosing_factor(vertices, np.array(faces), SIZE, (1.0, 1.0)) == pytest.approx(np.sqrt(3))
    with pytest.raises(ValueError, match="outwards"):
        enclosing_factor(vertices, np.array(faces)[:, ::-1], SIZE, (2.0, 2.0))
    with pytest.raises(ValueError, match="outwards"):
        enclosing_factor(vertices + [1.0, 0, 0], np.array(faces), SIZE, (2.0, 2.0))


def test_a_mesh_message_holds_what_it_was_made_of():
    made = mesh(body(SIZE, (0.3, 0.7)), 8)
    message = mesh_message(made.vertices, made.faces)
    assert [[p.x, p.y, p.z] for p in message.vertices] == np.asarray(made.vertices).tolist()
    assert [list(t.vertex_indices) for t in message.triangles] == np.asarray(made.faces).tolist()


@pytest.mark.parametrize("size", [(0.1, 0.0, 0.1), (0.1, np.nan, 0.1), (0.1, 0.1)])
@pytest.mark.parametrize("shape", [(0, 1), (1, 2.1), (1, np.nan)])
def test_what_is_no_body_is_refused(size, shape):
    with pytest.raises(ValueError, match="size: expected three half sizes above 0"):
        primitive(np.array(size), np.ones(2))
    with pytest.raises(ValueError, match="shape: expected two exponents"):
        primitive(np.ones(3), np.array(shape, float))


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], "vertices"),
        (np.zeros((3, 3)), [[0, 1, 3]], "indices 0 to 2"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "finite"),
        (np.zeros((3, 3)), [[0, 1]], "faces"),
    ],
)
def test_what_is_no_mesh_is_refused(vertices, faces, words):
    with pytest.raises(ValueError, match=words):
        mesh_message(vertices, np.array(faces))
