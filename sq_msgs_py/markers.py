"""visualization_msgs/MarkerArray of triangle meshes with outlines.

The first marker deletes all earlier ones of the topic, so that a lost message leaves nothing behind.  Per body two
markers share one id: a TRIANGLE_LIST in the namespace ``<namespace>/surface`` and a LINE_LIST in
``<namespace>/outline``.  Vertices are given in the frame of the header, metres, so that every pose is the identity.
A 32 x 32 mesh costs 148 KB and 5 ms to serialise; 16 x 16 is enough to look at.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sq_msgs_py.message_types import MessageTypes, find_type

if TYPE_CHECKING:
    from visualization_msgs.msg import MarkerArray

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices (k, 3), faces (m, 3) of vertex indices, outline (j, 2, 3) of line segments."""

PALETTE = np.array(
    [
        [0.02, 0.58, 0.97],
        [0.96, 0.75, 0.05],
        [0.02, 0.68, 0.46],
        [0.53, 0.19, 0.61],
        [0.77, 0.17, 0.07],
        [0.35, 0.77, 0.97],
        [0.69, 0.88, 0.48],
        [0.55, 0.10, 0.15],
    ]
)
"""Colours that bodies take in turn, by id: those of sq_perception.geometry.mesh, where their choice is explained."""

ALPHA = 0.7  # opacity of surfaces unless given


def markers(
    meshes: Sequence[Mesh], ids: Sequence[int], header: Any, *, colours: np.ndarray | None = None, alpha: float = ALPHA,
    namespace: str = "superquadrics", types: MessageTypes = find_type,
) -> MarkerArray:
    """Return markers of n bodies, which replace all earlier ones.

    ``meshes``, ``ids``: n meshes and their ids, 0 to 2^31 - 1, each once.  ``header``: std_msgs/Header of the image
    that the bodies were recovered from.  ``colours``: (n, 3) RGB, 0 to 1; by default the palette's colour of each id.
    ``alpha``: opacity of surfaces.  ``types``: where the classes of messages come from.  Raises ValueError if lengths,
    shapes, ids or face indices do not fit.
    """
    ids = [int(number) for number in ids]
    if len(ids) != len(meshes):
        raise ValueError(f"ids: expected one for each of {len(meshes)} meshes, got {len(ids)}")
    if len(set(ids)) != len(ids) or any(not 0 <= number < 2**31 for number in ids):
        raise ValueError(f"ids: expected different numbers from 0 to 2^31 - 1, got {ids}")
    paint = PALETTE[np.array(ids, dtype=int) % len(PALETTE)] if colours is None else np.asarray(colours, dtype=float)
    if paint.shape != (len(ids), 3):
        raise ValueError(f"colours: expected ({len(ids)}, 3), got {paint.shape}")
    paint = np.column_stack([paint, np.full(len(ids), alpha)])

    make_marker, make_scale = types("visualization_msgs/msg/Marker"), types("geometry_msgs/msg/Vector3")
    point = types("geometry_msgs/msg/Point")
    upright = types("geometry_msgs/msg/Quaternion")(w=1.0)
    nowhere = types("geometry_msgs/msg/Pose")(orientation=upright)

    def marker(kind: str, number: int, shape: int, colour: np.ndarray, scale: Any, points: list[Any]) -> Any:
        red, green, blue, opacity = (float(channel) for channel in colour)
        return make_marker(
            header=header, ns=f"{namespace}/{kind}", id=number, type=shape, pose=nowhere, scale=scale,
            color=types("std_msgs/msg/ColorRGBA")(r=red, g=green, b=blue, a=opacity), points=points,
        )

    as_it_is, as_wide = make_scale(x=1.0, y=1.0, z=1.0), make_scale(x=0.002)
    black = np.array([0.05, 0.05, 0.05, 1.0])
    found = [make_marker(header=header, action=3)]  # DELETEALL; the others' 0 is ADD
    for number, (surface_vertices, surface_faces, outline), colour in zip(ids, meshes, paint, strict=True):
        vertices, faces = check_mesh(surface_vertices, surface_faces)
        corners = [point(x=x, y=y, z=z) for x, y, z in vertices.tolist()]
        surface = [corners[index] for index in faces.reshape(-1).tolist()]
        found.append(marker("surface", number, 11, colour, as_it_is, surface))  # TRIANGLE_LIST
        segments = np.asarray(outline, dtype=float)
        if segments.size and (segments.ndim != 3 or segments.shape[1:] != (2, 3)):
            raise ValueError(f"outline: expected segments (j, 2, 3), got {segments.shape}")
        lines = [point(x=x, y=y, z=z) for x, y, z in segments.reshape(-1, 3).tolist()]
        found.append(marker("outline", number, 5, black, as_wide, lines))  # LINE_LIST
    return types("visualization_msgs/msg/MarkerArray")(markers=found)


def check_mesh(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (k, 3), float64, and faces (m, 3) of their indices; ValueError for anything else."""
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"mesh: expected vertices (k, 3) and faces (m, 3), got {vertices.shape} and {faces.shape}")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"faces: expected indices 0 to {len(vertices) - 1}, got {faces.min()} to {faces.max()}")
    return vertices, faces
