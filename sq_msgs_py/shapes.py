"""Superquadrics as shape_msgs: triangle meshes, and the primitive solid that encloses a body most tightly.

Everything is in the body's own frame, centred at its origin; the pose of the message is that of the body.  Metres.

No space may look free to a planner where the body is.  The flat faces of a mesh cut through a curved body,
and a body is hardly ever a primitive; so a mesh can be grown, and a primitive is chosen, to ENCLOSE the body.

The points of the surface of a body with exponents at most 2 (all of these are convex) are x^2 + y^2 = (a1^2 u^e2 +
a2^2 v^e2) s^e1 and z^2 = a3^2 t^e1, with u + v = 1 and s + t = 1, none below 0.  So the enclosing

    box        has the half sizes a1 a2 a3, and touches the body with all six faces,
    cylinder   has the height 2 a3, and as radius the largest sqrt(x^2 + y^2),
    sphere     has as radius the largest |p|,

and both radii have closed forms: the maximum of c u^e + d v^e is (c^k + d^k)^(1/k), k = 1/(1 - e), for e < 1 (Hölder's
inequality), and max(c, d) otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from sq_msgs_py.markers import check_mesh
from sq_msgs_py.superquadrics import SuperquadricArray

if TYPE_CHECKING:
    from shape_msgs.msg import Mesh, SolidPrimitive

BOX, CYLINDER, SPHERE = "box", "cylinder", "sphere"


@dataclass(frozen=True)
class Primitive:
    """A solid that encloses a body; its pose is the body's.

    ``kind``: BOX, CYLINDER (axis along the body's z) or SPHERE.  ``dimensions``: as SolidPrimitive has them: box: full
    edges x y z; cylinder: height, radius; sphere: radius; metres.
    """

    kind: str
    dimensions: tuple[float, ...]

    @property
    def message(self) -> SolidPrimitive:
        """The solid as a message, centred at the origin of the body's pose."""
        from shape_msgs.msg import SolidPrimitive

        kinds = {BOX: SolidPrimitive.BOX, CYLINDER: SolidPrimitive.CYLINDER, SPHERE: SolidPrimitive.SPHERE}
        return SolidPrimitive(type=kinds[self.kind], dimensions=list(self.dimensions))


def primitive(size: np.ndarray, shape: np.ndarray) -> Primitive:
    """Return the box, cylinder or sphere of the least volume that encloses a body.

    Boxes with two small exponents become boxes; cylinders (e1 small, e2 near 1, a1 near a2) become cylinders; balls
    become spheres; what is none of these mostly gets its bounding box.  Parameters and errors are those of
    :func:`enclosing_solids`.
    """
    return min(enclosing_solids(size, shape), key=lambda one: one[0])[1]


def enclosing_solids(size: np.ndarray, shape: np.ndarray) -> list[tuple[float, Primitive]]:
    """Return the box, cylinder and sphere that enclose a body, each behind its volume in cubic metres.

    ``size`` (3,): half sizes, metres.  ``shape`` (2,): e1, e2.  Raises ValueError if a half size is not positive or an
    exponent not in (0, 2].
    """
    (a1, a2, a3), (e1, e2) = (known.tolist() for known in _check(size, shape))
    radius = sqrt(_largest(a1**2, a2**2, e2))
    outer = sqrt(_largest(radius**2, a3**2, e1))
    return [
        (8 * a1 * a2 * a3, Primitive(BOX, (2 * a1, 2 * a2, 2 * a3))),
        (2 * pi * radius**2 * a3, Primitive(CYLINDER, (2 * a3, radius))),
        (4 / 3 * pi * outer**3, Primitive(SPHERE, (outer,))),
    ]


def primitives(superquadrics: SuperquadricArray) -> list[Primitive]:
    """Return the enclosing primitive of each of n bodies; ValueError as :func:`primitive`."""
    return [primitive(size, shape) for size, shape in zip(superquadrics.size, superquadrics.shape, strict=True)]


def mesh_message(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh of vertices (k, 3) and faces (m, 3) of vertex indices, outwards.  Raises ValueError if shapes or
    indices do not fit."""
    from geometry_msgs.msg import Point
    from shape_msgs.msg import Mesh, MeshTriangle

    vertices, faces = _check_mesh(vertices, faces)
    return Mesh(
        vertices=[Point(x=x, y=y, z=z) for x, y, z in vertices.tolist()],
        triangles=[MeshTriangle(vertex_indices=corners) for corners in faces.astype(np.uint32)],
    )


def enclosing_factor(
    vertices: np.ndarray, faces: np.ndarray, size: np.ndarray, shape: np.ndarray,
    taper: np.ndarray | tuple[float, float] = (0.0, 0.0),
) -> float:
    """Return by how much a mesh of points on a body must grow about the centre to enclose it, at least 1.

    The plane of a face, n.p = d, has the body behind it when d reaches the support function h(n), the dual of the
    gauge; the factor is the largest h(n) / d.  Then every point of the body lies behind the face that its ray from the
    centre passes: the body is inside.  For a mesh of 16 x 16 points it is below 1.03.

    ``vertices``, ``faces``: (k, 3) in the body's own frame and (m, 3), outwards, around the origin.  ``size``,
    ``shape``, ``taper``: (3,), (2,) and (2,) of the body, as in a message.  Raises ValueError if the mesh is not around
    the origin with its faces outwards, or the body is none.
    """
    size, shape = _check(size, shape)
    vertices, faces = _check_mesh(vertices, faces)
    corners = (vertices / size)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    is_face = area > 1e-12  # smaller ones have no normal
    if not is_face.any():
        raise ValueError("mesh: expected faces of an area above 0")
    normals = normals[is_face] / area[is_face, None]
    distance = np.einsum("ij,ij->i", normals, corners[is_face, 0])
    if (distance <= 0).any():
        raise ValueError("mesh: expected the origin inside and the faces outwards")
    return max(float((support(normals, np.ones(3), shape, taper) / distance).max()), 1.0)


def support(
    normals: np.ndarray, size: np.ndarray, shape: np.ndarray, taper: np.ndarray | tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Return how far a body reaches from its centre along directions (k, 3) of its own frame, times their lengths."""
    if np.any(taper):
        return _of_sections(normals * size, (float(shape[0]), float(shape[1])), np.asarray(taper, dtype=float))
    x, y, z = np.abs(normals * size).T
    return _dual(_dual(x, y, shape[1]), z, shape[0])


def _of_sections(normals: np.ndarray, shape: tuple[float, float], taper: np.ndarray) -> np.ndarray:
    """Support (n,) of a tapered body of half sizes 1: the largest one of its sections along its z axis."""
    e1, e2 = shape
    angle = np.linspace(-0.5 * pi, 0.5 * pi, 257)  # the largest one is missed by less than 1e-4 of it
    high = np.sign(angle) * np.abs(np.sin(angle)) ** e1
    scale = (1 + taper * high[:, None]) / (1 + np.abs(taper))
    x, y, z = normals.T
    across = _dual(np.abs(x)[:, None] * scale[:, 0], np.abs(y)[:, None] * scale[:, 1], e2)
    return np.asarray((across * np.cos(angle) ** e1 + z[:, None] * high).max(axis=1))


def _largest(c: float, d: float, e: float) -> float:
    """Of c u^e + d v^e for u, v >= 0 with u + v = 1."""
    if e >= 1:
        return max(c, d)
    k = 1 / (1 - e)
    return exp(float(np.logaddexp(k * log(c), k * log(d))) / k)


def _dual(u: np.ndarray, v: np.ndarray, e: float) -> np.ndarray:
    """(u^q + v^q)^(1/q) of u, v >= 0 with q = 2 / (2 - e), the dual of the norm with p = 2 / e."""
    larger, smaller = np.maximum(u, v), np.minimum(u, v)
    ratio = np.divide(smaller, larger, out=np.zeros_like(larger), where=larger > 0)
    if e == 2:
        return larger
    return larger * (1 + ratio ** (2 / (2 - e))) ** ((2 - e) / 2)


def _check(size: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    size, shape = np.asarray(size, dtype=float), np.asarray(shape, dtype=float)
    if size.shape != (3,) or not (np.isfinite(size) & (size > 0)).all():
        raise ValueError(f"size: expected three half sizes above 0, got {size.tolist()}")
    if shape.shape != (2,) or not ((shape > 0) & (shape <= 2)).all():
        raise ValueError(f"shape: expected two exponents above 0, at most 2, got {shape.tolist()}")
    return size, shape


def _check_mesh(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = check_mesh(vertices, faces)
    if not np.isfinite(vertices).all():
        raise ValueError("mesh: expected finite vertices")
    return vertices, faces
