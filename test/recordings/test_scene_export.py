"""Scenes for planners, read again: by MuJoCo, by a strict parse of XML, and as cuRobo reads its worlds."""

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
import trimesh
import yaml

from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.recordings.scene_export import SUFFIXES, Solid, inflate, solids, write

NAMES = ["box", "can", "ball", "egg", "odd"]
"""Best enclosed by a box, a cylinder, a sphere and a capsule, and a body that is none of them.

Two are pitched by a quarter turn, where the first and the last of three angles turn about one axis.
"""
PRECISION = 1e-7


def bodies(seed: int = 4) -> Superquadric:
    rng = np.random.default_rng(seed)
    size = np.array([[0.05, 0.02, 0.08], [0.03, 0.03, 0.06], [0.04] * 3, [0.02, 0.02, 0.09], [0.03, 0.05, 0.04]])
    shape = np.array([[0.1, 0.1], [0.1, 1.0], [1.0, 1.0], [1.0, 1.0], [0.6, 1.6]])
    turns, pitches = rotation.random(5, rng), np.array([1.0, -1.0])[:, None] * [0.0, np.pi / 2, 0.0]
    turns[:2] = rotation.multiply(turns[:2] * [0, 0, 1, 1], rotation.from_rotation_vector(pitches))
    return Superquadric(size, shape, rng.uniform(-1, 1, (5, 3)), turns)


def points_of(body: Superquadric, rng: np.random.Generator) -> np.ndarray:
    return body.parametric_points(rng.uniform(-np.pi / 2, np.pi / 2, 4000), rng.uniform(-np.pi, np.pi, 4000))


def distance_out(solid: Solid, points: np.ndarray) -> np.ndarray:
    """How far points of the parent frame lie outside of a solid; at most 0 inside."""
    local = (points - solid.position) @ rotation.to_matrix(solid.rotation)
    across, along = np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])
    if solid.kind == "box":
        return (np.abs(local) - np.divide(solid.measures["size"], 2)).max(axis=1)
    (radius,) = solid.measures["radius"]
    half = solid.measures.get("length", (0.0,))[0] / 2
    if solid.kind == "cylinder":
        return np.maximum(across - radius, along - half)
    return np.hypot(across, (along - half).clip(min=0)) - radius  # a sphere is a capsule without length


@pytest.mark.parametrize("form", SUFFIXES)
def test_no_point_of_a_body_is_outside_and_the_solid_is_the_smallest(form: str) -> None:
    rng, given = np.random.default_rng(0), bodies()
    found = solids(given, form)
    kinds = ["box", "cylinder", "sphere", "capsule", "box"]
    assert [one.kind for one in found[:4]] == [k if form != "urdf" or k != "capsule" else "cylinder" for k in kinds[:4]]
    for solid, body in zip(found, given, strict=True):
        out = distance_out(solid, points_of(body, rng)).max()
        assert -2e-3 < out < 1e-6, "they touch, and nothing is outside"
    many = Superquadric(
        rng.uniform(0.01, 0.2, (100, 3)), rng.uniform(0.05, 2, (100, 2)), np.zeros((100, 3)), rotation.random(100, rng)
    )
    for solid, body in zip(solids(many, form), many, strict=True):
        assert distance_out(solid, points_of(body, rng)).max() < 1e-6


def test_an_ellipsoid_of_revolution_touches_its_capsule_at_the_poles_alone() -> None:
    """Closed form: radius a, and segment half length c - a."""
    (egg,) = solids(bodies()[3:4], "mjcf")
    assert egg.kind == "capsule"
    np.testing.assert_allclose([egg.measures["radius"][0], egg.measures["length"][0]], [0.02, 0.14], rtol=1e-6)


@pytest.mark.parametrize("meshes", [False, True])
@pytest.mark.parametrize("form", ["mjcf", "urdf"])
def test_mujoco_reads_what_was_written(tmp_path: Path, form: str, meshes: bool) -> None:
    mujoco = pytest.importorskip("mujoco", reason="needs the extra 'picking'")
    given = bodies()
    path, *files = write(given, tmp_path / f"scene{SUFFIXES[form]}", form, names=NAMES, meshes=meshes)
    assert len(files) == (5 if meshes and form == "urdf" else 0)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    solid_geoms = [k for k in range(model.ngeom) if model.geom_contype[k] or form == "mjcf"]
    assert len(solid_geoms) == 5
    rng = np.random.default_rng(1)
    kinds = {"box": 6, "cylinder": 5, "sphere": 2, "capsule": 3, "mesh": 7}
    for k, solid, body in zip(solid_geoms, solids(given, form, names=NAMES, meshes=meshes), given, strict=True):
        assert model.geom_type[k] == kinds[solid.kind]
        turn, place = data.geom_xmat[k].reshape(3, 3), data.geom_xpos[k]
        if meshes:  # MuJoCo moves a mesh into the frame of its inertia
            mesh = model.geom_dataid[k]
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            hull = trimesh.Trimesh(model.mesh_vert[first : first + count] @ turn.T + place).convex_hull
            normals, offsets = hull.face_normals, np.einsum("ij,ij->i", hull.face_normals, hull.triangles[:, 0])
            assert -2e-3 < (points_of(body, rng) @ normals.T - offsets).max() < 1e-6
            continue
        np.testing.assert_allclose(place, solid.position, atol=PRECISION)
        np.testing.assert_allclose(turn, rotation.to_matrix(solid.rotation), atol=PRECISION)
        half = [one / 2 for one in solid.measures.get("length", ())]
        radius = solid.measures.get("radius", ())
        expected = np.divide(solid.measures["size"], 2) if solid.kind == "box" else [*radius, *half]
        np.testing.assert_allclose(model.geom_size[k][: len(expected)], expected, rtol=PRECISION)


def test_curobo_s_world_has_the_fields_of_its_types(tmp_path: Path) -> None:
    """Names and order as in curobo.geom.types: pose is x y z qw qx qy qz."""
    given = bodies()
    (path,) = write(given, tmp_path / "scene.yml", "curobo", names=NAMES)
    world = yaml.safe_load(path.read_text())
    expected = {"cuboid": {"dims"}, "cylinder": {"radius", "height"}, "sphere": {"radius"}}
    expected["capsule"] = {"radius", "base", "tip"}
    assert set(world) == set(expected)
    for kind, things in world.items():
        for name, thing in things.items():
            assert set(thing) == {"pose", *expected[kind]}
            body = given[NAMES.index(name)]
            np.testing.assert_allclose(thing["pose"], [*body.translation, *np.roll(body.rotation, 1)], atol=PRECISION)
    assert world["cuboid"]["box"]["dims"] == pytest.approx([0.1, 0.04, 0.16])
    assert world["cylinder"]["can"]["height"] == pytest.approx(0.12)
    assert world["capsule"]["egg"]["tip"] == pytest.approx([0.0, 0.0, 0.07])
    (path,) = write(given[:1], tmp_path / "mesh.yml", "curobo", meshes=True)
    thing = yaml.safe_load(path.read_text())["mesh"]["body_0"]
    assert trimesh.Trimesh(thing["vertices"], thing["faces"]).is_watertight


MODEL = {
    "sdf": {"model"}, "model": {"static", "link"}, "link": {"pose", "collision", "visual"}, "collision": {"geometry"},
    "visual": {"geometry"}, "geometry": {"box", "cylinder", "sphere", "capsule", "mesh"}, "box": {"size"},
    "cylinder": {"length", "radius"}, "capsule": {"length", "radius"}, "sphere": {"radius"}, "mesh": {"uri"},
}  # fmt: skip
"""What each element may hold, in SDFormat 1.9; an element that is not here holds text."""


@pytest.mark.parametrize("meshes", [False, True])
def test_sdf_holds_what_its_specification_knows(tmp_path: Path, meshes: bool) -> None:
    given = bodies()
    path, *files = write(given, tmp_path / "scene.sdf", "sdf", names=NAMES, meshes=meshes)
    root = Xml.parse(path).getroot()  # noqa: S314 - our own
    assert (root.tag, root.attrib) == ("sdf", {"version": "1.9"})
    for element in root.iter():
        assert {child.tag for child in element} <= MODEL.get(element.tag, set())
        assert bool((element.text or "").strip()) == (element.tag not in MODEL)
    links = root.findall("./model/link")
    assert [link.get("name") for link in links] == NAMES
    for link, solid in zip(links, solids(given, "sdf", names=NAMES, meshes=meshes), strict=True):
        pose = link.find("pose")
        assert pose is not None
        assert pose.get("rotation_format") == "quat_xyzw"
        expected = [*solid.position, *solid.rotation]
        np.testing.assert_allclose(np.fromstring(pose.text, sep=" "), expected, atol=PRECISION)
        for part in ("collision", "visual"):
            shape = link.find(f"{part}/geometry/{solid.kind}")
            assert shape is not None
            for key, value in solid.measures.items():
                np.testing.assert_allclose(np.fromstring(shape.findtext(key), sep=" "), value, atol=PRECISION)
            if meshes:
                assert tmp_path / shape.findtext("uri") in files


def test_a_body_grows_by_the_errors_of_its_faces() -> None:
    """Size and centre along an axis: the deviation of the farther face, also where errors of both cancel at one."""
    quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])  # the body's x is the frame's y
    body = Superquadric(np.full((1, 3), 0.05), np.full((1, 2), 0.2), np.zeros((1, 3)), quarter[None])
    covariance = np.zeros((1, 11, 11))
    covariance[0, 0, 0], covariance[0, 6, 6] = 0.003**2, 0.004**2
    np.testing.assert_allclose(inflate(body, covariance, 2.0).size, [[0.06, 0.05, 0.05]], atol=1e-9)
    covariance[0, 0, 6] = covariance[0, 6, 0] = -0.003 * 0.004
    np.testing.assert_allclose(inflate(body, covariance, 1.0).size, [[0.057, 0.05, 0.05]], atol=1e-9)
    assert inflate(body, covariance, 0.0) is body
    with pytest.raises(ValueError, match="covariances: expected finite ones"):
        inflate(body, np.full((1, 11, 11), np.nan), 1.0)
    with pytest.raises(ValueError, match="sigmas"):
        inflate(body, covariance, -1.0)


def test_what_is_no_format_and_no_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected one of urdf, sdf, mjcf, curobo, got 'usd'"):
        write(bodies(), tmp_path / "scene.usd", "usd")
    with pytest.raises(ValueError, match="names: expected 5 different ones"):
        write(bodies(), tmp_path / "scene.xml", "mjcf", names=["a"] * 5)
    assert not list(tmp_path.iterdir())
