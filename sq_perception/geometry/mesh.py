"""Triangle meshes and outlines of superquadrics.

A superquadric with e1, e2 <= 2 is convex, so the convex hull of surface points is its mesh.  The points are those of
the parametric form (thesis, equation 3.5) on a uniform grid of angles, which crowds them where the surface bends.  The
hull is computed at unit size and then stretched by the half sizes, which keeps convexity and spares the hull algorithm
the nearly flat input of a thin body.  A taper moves the vertices, and may leave the mesh not quite convex.

Metres, in the frame that the body is given in.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sq_perception.geometry.superquadric import Superquadric

if TYPE_CHECKING:
    import trimesh

MARKER_RESOLUTION = 16  # resolution of markers: coarse enough to be serialised at camera rate, about 35 kB per body

COLOURS = np.array(
    [
        (0.02, 0.58, 0.97),
        (0.96, 0.75, 0.05),
        (0.02, 0.68, 0.46),
        (0.53, 0.19, 0.61),
        (0.77, 0.17, 0.07),
        (0.35, 0.77, 0.97),
        (0.69, 0.88, 0.48),
        (0.55, 0.10, 0.15),
    ]
)
"""Red, green, blue in [0, 1]: the k-th body has colour k modulo the length, in meshes, markers and pictures alike.

Found by a random search for the greatest least difference (CIE 1976) of any two, and of each from the greys of the
depth pictures, to normal, deuteranopic and protanopic eyes (Machado et al. 2009): 28.
"""

FORMATS = ("glb", "ply", "stl", "obj")  # suffixes of the files that :func:`export` writes


def triangles(body: Superquadric, resolution: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Return the closed triangle mesh of one body as arrays.

    resolution: Points around and rows from pole to pole; a multiple of 8, so that the corners of a box are among the
        points.

    Returns vertices (n, 3) on the surface, in the body's parent frame, and faces (m, 3) of indices of vertices:
    watertight, outwards, convex without a taper.
    """
    from scipy.spatial import ConvexHull  # here: a node that recovers does without

    _check_single(body)
    if resolution < 8 or resolution % 8:
        raise ValueError(f"resolution: expected a positive multiple of 8, got {resolution}")
    eta, omega = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, resolution + 1), np.linspace(-np.pi, np.pi, resolution, endpoint=False),
        indexing="ij",
    )
    unit = Superquadric.at_origin(np.ones(3), body.shape)
    points = unit.parametric_points(eta.ravel(), omega.ravel())
    _, kept = np.unique(np.round(points, 12), axis=0, return_index=True)
    points = points[np.sort(kept)]
    hull = ConvexHull(points, qhull_options="QbB Pp Qt")
    used = np.full(len(points), -1)
    used[hull.vertices] = np.arange(len(hull.vertices))
    vertices, faces = points[hull.vertices], used[hull.simplices]
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    vertices[:, :2] *= 1 + body.taper * vertices[:, 2:]
    return body.to_parent(vertices * body.size), faces


def mesh(body: Superquadric, resolution: int = 32) -> trimesh.Trimesh:
    """Return the mesh of :func:`triangles` as a trimesh object."""
    # Imported where it is needed: a node that starts again and needs only the arrays does not wait for it.
    import trimesh

    return trimesh.Trimesh(*triangles(body, resolution), process=False)


def outline(body: Superquadric, resolution: int = MARKER_RESOLUTION) -> np.ndarray:
    """Return line segments (j, 2, 3) in the parent frame that show the shape: the twelve edges of a box.

    Two rings at eta = +-45 degrees and the four meridians between them.  As e1 and e2 go to zero, these become the
    edges; on a cylinder they are its rims and four lines of its side, on an ellipsoid a cage.  Each edge has about
    ``resolution / 4`` segments.
    """
    _check_single(body)
    per_edge = max(2, resolution // 4)
    around = np.linspace(-np.pi, np.pi, 4 * per_edge + 1)
    quarter = np.pi / 4
    along = np.linspace(-quarter, quarter, per_edge + 1)
    lines = [(np.full_like(around, eta), around) for eta in (-quarter, quarter)]
    lines += [(along, np.full_like(along, quarter + k * np.pi / 2)) for k in range(4)]
    segments = []
    for eta, omega in lines:
        points = body.parametric_points(eta, omega)
        segments.append(np.stack([points[:-1], points[1:]], axis=1))
    return np.concatenate(segments)


def export(
    bodies: Superquadric | Sequence[Superquadric], path: str | Path, *, resolution: int = 64,
    colours: np.ndarray | None = None, names: Sequence[str] | None = None, optical: bool = True,
) -> Path:
    """Write bodies, one, a batch (n,) or a sequence of single ones, as a coloured scene.

    ``path``: its suffix is one of :data:`FORMATS`: GLB and OBJ have a named object per body, PLY and STL one mesh, STL
    without colours.  ``colours`` (n, 3): red, green, blue in [0, 1]; :data:`COLOURS` in turn if not given.  ``names``
    (n,): of the nodes of a GLB; body_0, body_1 ... if not given.  ``optical``: the bodies are in the optical frame (y
    down): a GLB, whose y axis is up by its standard, is turned half about x so that viewers show them upright.  The
    others always keep the coordinates.

    Raises ValueError for another suffix, where there is no body to write, not one name a body, or colours of another
    form.
    """
    import trimesh

    path = Path(path)
    suffix = path.suffix.lower()
    if suffix.removeprefix(".") not in FORMATS:
        raise ValueError(f"{path.name}: expected a name that ends in .{', .'.join(FORMATS)}")
    singles = [bodies] if isinstance(bodies, Superquadric) and not bodies.batch_shape else list(bodies)
    if not singles:
        raise ValueError(f"{path.name}: no body to write")
    names = [f"body_{k}" for k in range(len(singles))] if names is None else list(names)
    if len(set(names)) != len(singles):
        raise ValueError(f"names: expected {len(singles)} different ones, got {names}")
    palette = COLOURS if colours is None else np.asarray(colours, dtype=float)
    if palette.ndim != 2 or palette.shape[1] != 3 or not len(palette) or not ((palette >= 0) & (palette <= 1)).all():
        raise ValueError(f"colours: expected red, green, blue (n, 3) in [0, 1], got {colours}")
    meshes = []
    for k, body in enumerate(singles):
        part = mesh(body, resolution)
        rgba = np.append(np.round(255 * palette[k % len(palette)]), 255).astype(np.uint8)
        part.visual = trimesh.visual.ColorVisuals(part, vertex_colors=np.tile(rgba, (len(part.vertices), 1)))
        meshes.append(part)
    if suffix in (".ply", ".stl"):
        trimesh.util.concatenate(meshes).export(path)
        return path
    if optical and suffix != ".obj":
        for part in meshes:
            # Turn between the optical frame, y down, and that of viewers of meshes, y up.
            part.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    scene = trimesh.Scene()
    for name, part in zip(names, meshes, strict=True):
        scene.add_geometry(part, node_name=name, geom_name=name)
    scene.export(path)
    return path


def sample(body: Superquadric, count: int = 1000, seed: int = 0) -> np.ndarray:
    """Return points (count, 3) on the surface of one body, uniform in area, in its parent frame, metres."""
    _check_single(body)
    return body.sample_surface(count, np.random.default_rng(seed))


def _check_single(body: Superquadric) -> None:
    if body.batch_shape:
        raise ValueError(f"expected a single body, got a batch of shape {body.batch_shape}")
