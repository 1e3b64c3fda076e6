"""Recovered bodies as obstacles for planners and simulators: URDF, SDF, MJCF, and the worlds of cuRobo.

| format | file | solids | reference |
| --- | --- | --- | --- |
| urdf | ``.urdf``, meshes as STL beside it | box, cylinder, sphere, mesh | http://wiki.ros.org/urdf/XML |
| sdf | ``.sdf`` 1.9, one static model, likewise | and capsule | http://sdformat.org/spec |
| mjcf | ``.xml``, meshes in it | and capsule | https://mujoco.readthedocs.io/en/stable/XMLreference.html |
| curobo | ``.yml``, meshes in it | and capsule | https://curobo.org, ``curobo.geom.types.WorldConfig`` |

Each body becomes the solid of the least volume that ENCLOSES it, or a mesh that does and fits closely: where a planner
sees free space, no body is.  Bodies are not known exactly: :func:`inflate` makes them larger by their deviations first.
Metres, in the frame that the bodies are given in; a URDF names that frame.

A superquadric lies within the body of revolution whose radius is its largest one, and that within the capsule (segment
of half length l, radius r) wherever its support function is at most r + l |n_z|.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import yaml

from sq_msgs_py.shapes import BOX, CYLINDER, Primitive, enclosing_factor, enclosing_solids, support
from sq_perception.files import output_file
from sq_perception.geometry import rotation
from sq_perception.geometry.mesh import MARKER_RESOLUTION, triangles
from sq_perception.geometry.superquadric import Superquadric

SUFFIXES = {"urdf": ".urdf", "sdf": ".sdf", "mjcf": ".xml", "curobo": ".yml"}  # of the file of each format
CAPSULE, MESH = "capsule", "mesh"


@dataclass(frozen=True, eq=False)
class Solid:
    """An obstacle: a box, cylinder, sphere, capsule (the axis is z) or mesh, by ``kind``.

    ``measures``, in metres, are ``size``, the full edges of a box, or ``length`` (of a capsule's cylinder) and
    ``radius``.  ``position`` (3,) and ``rotation`` (4,), x y z w, place its frame, in which ``mesh`` has its vertices.
    """

    name: str
    kind: str
    measures: dict[str, tuple[float, ...]]
    position: np.ndarray
    rotation: np.ndarray
    mesh: tuple[np.ndarray, np.ndarray] | None = None


def inflate(bodies: Superquadric, covariances: np.ndarray, sigmas: float) -> Superquadric:
    """Return bodies (n,) whose faces lie ``sigmas`` standard deviations farther out, by their covariances (n, 11, 11).

    A face moves with the size and with the centre, whose errors belong together: each half size grows by the larger
    deviation of its two faces.  Deviations of rotations are not looked at.  Raises ValueError for negative ``sigmas``,
    or a covariance that is not known: its body would not grow at all.
    """
    if not sigmas >= 0:
        raise ValueError(f"sigmas: expected a number from 0, got {sigmas}")
    if sigmas == 0:
        return bodies
    if not np.isfinite(covariances).all():
        raise ValueError("covariances: expected finite ones; methods without a fit's covariance have none to grow by")
    along = np.swapaxes(bodies.rotation_matrix, -1, -2)  # the centre along the body's axes
    jacobian = np.zeros((2, *bodies.batch_shape, 3, covariances.shape[-1]))  # of both sides
    jacobian[..., :3], jacobian[..., 5:8] = np.eye(3), [along, -along]
    variances = np.einsum("snij,njk,snik->sni", jacobian, covariances, jacobian)
    deviation = np.sqrt(variances.max(axis=0).clip(min=0))
    return replace(bodies, size=bodies.size + sigmas * deviation)


def solids(bodies: Superquadric, form: str, *, names: Sequence[str] | None = None, meshes: bool = False) -> list[Solid]:
    """Return what encloses each of n bodies, in a format's kinds of solids; ``names``: body_0, body_1 ... by default.
    Raises ValueError for a format that is none, or names that are not one a body and different."""
    if form not in SUFFIXES:
        raise ValueError(f"format: expected one of {', '.join(SUFFIXES)}, got {form!r}")
    names = [f"body_{k}" for k in range(len(bodies))] if names is None else list(names)
    if len(set(names)) != len(bodies):
        raise ValueError(f"names: expected {len(bodies)} different ones, got {names}")
    found = []
    for name, body in zip(names, bodies.untapered(), strict=True):  # which enclose those that taper
        turn = rotation.normalize(np.asarray(body.rotation, dtype=float))
        if meshes:
            vertices, faces = triangles(Superquadric.at_origin(body.size, body.shape), MARKER_RESOLUTION)
            close = vertices * enclosing_factor(vertices, faces, body.size, body.shape), faces
            found.append(Solid(name, MESH, {}, np.asarray(body.translation), turn, close))
            continue
        candidates = enclosing_solids(body.size, body.shape)
        candidates += _capsule(body.size, body.shape) if form != "urdf" else []
        _, least = min(candidates, key=lambda one: one[0])
        lengths = {"length": least.dimensions[:1]} if len(least.dimensions) == 2 else {}
        measures = {"size": least.dimensions} if least.kind == BOX else {**lengths, "radius": least.dimensions[-1:]}
        found.append(Solid(name, least.kind, measures, np.asarray(body.translation), turn))
    return found


def write(
    bodies: Superquadric, path: str | Path, form: str, *, names: Sequence[str] | None = None, frame: str = "world",
    meshes: bool = False,
) -> list[Path]:
    """Write n bodies (n,) as a scene; the files, those of meshes behind the scene's.  ValueError as :func:`solids`.

    ``form``: urdf, sdf, mjcf or curobo.  ``frame``: the link of a URDF that the bodies are fixed to.  ``meshes``: close
    meshes instead of the smallest enclosing solids.
    """
    import trimesh

    path = Path(path)
    scene = solids(bodies, form, names=names, meshes=meshes)
    files = {one.name: f"{path.stem}_{one.name}.stl" for one in scene if one.kind == MESH and form in ("urdf", "sdf")}
    if form == "curobo":
        text = yaml.safe_dump(_curobo(scene), default_flow_style=None, sort_keys=False)
    else:
        root = {"urdf": _urdf, "sdf": _sdf, "mjcf": _mjcf}[form](scene, path.stem, frame, files)
        Xml.indent(root)
        text = Xml.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
    for one in scene:
        if one.mesh is not None and one.name in files:
            with output_file.writing(path.with_name(files[one.name])) as partial:
                trimesh.Trimesh(*one.mesh, process=False).export(partial, file_type="stl")
    output_file.write(path, text.encode())
    return [path, *(path.with_name(file) for file in files.values())]


def _capsule(size: np.ndarray, shape: np.ndarray) -> list[tuple[float, Primitive]]:
    """Return the capsule about a body's z axis with its cylinder's radius, and its volume; none if it is flat."""
    (radius,) = (one.dimensions[1] for _, one in enclosing_solids(size, shape) if one.kind == CYLINDER)
    angle = np.linspace(0.0, np.pi / 2, 1001)[1:]  # from the equator to the pole
    normals = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    half = ((support(normals, np.array([radius, radius, size[2]]), shape) - radius) / normals[:, 2]).max()
    if half <= 0:
        return []
    volume = np.pi * radius**2 * (2 * half + 4 / 3 * radius)
    return [(volume, Primitive(CAPSULE, (2 * float(half), radius)))]


def _text(numbers: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{number:.9g}" for number in np.ravel(numbers))


def _roll_pitch_yaw(quaternion: np.ndarray) -> np.ndarray:
    """Angles about the fixed x, y and z axes, in that order; yaw is 0 where only its sum with roll is determined."""
    m = rotation.to_matrix(quaternion)
    across = np.hypot(m[0, 0], m[1, 0])
    pitch = np.arctan2(-m[2, 0], across)
    if across < np.finfo(float).eps ** 0.5:
        return np.array([np.arctan2(-m[1, 2], m[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(m[2, 1], m[2, 2]), pitch, np.arctan2(m[1, 0], m[0, 0])])


def _urdf(scene: Sequence[Solid], name: str, frame: str, files: dict[str, str]) -> Xml.Element:
    robot = Xml.Element("robot", name=name)
    Xml.SubElement(robot, "link", name=frame)
    for one in scene:
        link = Xml.SubElement(robot, "link", name=one.name)
        for part in ("visual", "collision"):
            geometry = Xml.SubElement(Xml.SubElement(link, part), "geometry")
            solid = Xml.SubElement(geometry, one.kind, {key: _text(value) for key, value in one.measures.items()})
            if one.kind == MESH:
                solid.set("filename", files[one.name])
        joint = Xml.SubElement(robot, "joint", name=f"{frame}_to_{one.name}", type="fixed")
        Xml.SubElement(joint, "parent", link=frame)
        Xml.SubElement(joint, "child", link=one.name)
        Xml.SubElement(joint, "origin", xyz=_text(one.position), rpy=_text(_roll_pitch_yaw(one.rotation)))
    return robot


def _sdf(scene: Sequence[Solid], name: str, frame: str, files: dict[str, str]) -> Xml.Element:
    root = Xml.Element("sdf", version="1.9")
    model = Xml.SubElement(root, "model", name=name)
    Xml.SubElement(model, "static").text = "true"
    for one in scene:
        link = Xml.SubElement(model, "link", name=one.name)
        pose = Xml.SubElement(link, "pose", rotation_format="quat_xyzw")
        pose.text = _text([*one.position, *one.rotation])
        for part in ("collision", "visual"):
            geometry = Xml.SubElement(Xml.SubElement(link, part, name=f"{one.name}_{part}"), "geometry")
            solid = Xml.SubElement(geometry, one.kind)
            for key, value in one.measures.items():
                Xml.SubElement(solid, key).text = _text(value)
            if one.kind == MESH:
                Xml.SubElement(solid, "uri").text = files[one.name]
    return root


def _mjcf(scene: Sequence[Solid], name: str, frame: str, files: dict[str, str]) -> Xml.Element:
    root = Xml.Element("mujoco", model=name)
    asset, world = Xml.SubElement(root, "asset"), Xml.SubElement(root, "worldbody")
    for one in scene:
        body = Xml.SubElement(
            world, "body", name=one.name, pos=_text(one.position), quat=_text(np.roll(one.rotation, 1))
        )
        geom = Xml.SubElement(body, "geom", name=f"{one.name}_geom", type=one.kind)
        if one.mesh is not None:
            vertices, faces = (_text(each) for each in one.mesh)
            Xml.SubElement(asset, "mesh", name=f"{one.name}_mesh", vertex=vertices, face=faces)
            geom.set("mesh", f"{one.name}_mesh")
        elif one.kind == BOX:
            geom.set("size", _text(np.divide(one.measures["size"], 2)))
        else:
            half = np.divide(one.measures.get("length", ()), 2)
            geom.set("size", _text([*one.measures["radius"], *half]))
    return root


def _curobo(scene: Sequence[Solid]) -> dict[str, dict[str, dict[str, list[float] | float]]]:
    world: dict[str, dict[str, dict[str, list[float] | float]]] = {}
    for one in scene:
        entry = {key: value[0] if len(value) == 1 else list(value) for key, value in one.measures.items()}
        if one.kind == BOX:
            entry = {"dims": entry["size"]}
        elif one.mesh is not None:
            entry = {key: each.tolist() for key, each in zip(("vertices", "faces"), one.mesh, strict=True)}
        elif one.kind == CYLINDER:
            entry = {"radius": entry["radius"], "height": entry["length"]}
        elif one.kind == CAPSULE:
            (length,) = one.measures["length"]
            entry = {"radius": entry["radius"], "base": [0.0, 0.0, -length / 2], "tip": [0.0, 0.0, length / 2]}
        entry["pose"] = [float(x) for x in (*one.position, *np.roll(one.rotation, 1))]
        world.setdefault("cuboid" if one.kind == BOX else one.kind, {})[one.name] = entry
    return world
