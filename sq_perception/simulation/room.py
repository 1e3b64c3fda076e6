"""The room behind a table: the table's edge, the floor below, and what stands on the floor.

Cameras also see what is beyond a table, which is no object on it.  The table ends along a line behind the objects,
across a direction a that leads away from the camera, turned by up to 70 degrees.  Behind it is a floor, or a lower
table, 5 to 90 cm below; on its visible part stand up to ten superquadrics, sharp or rounded, with edges of 4 cm to 1 m,
that may reach above the table: boxes, bins, chairs and shelves.

Metres, optical frame.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.simulation.scenes import plane_depth, turn_about_up
from sq_perception.simulation.things_on_table import ThingsOnTable

_TURN = float(np.deg2rad(70.0))


def behind(scene: ThingsOnTable, rng: np.random.Generator) -> np.ndarray:
    """Return the depth (height, width) of a scene with a room behind its table; its objects and occluders stay."""
    camera, normal = scene.camera, scene.plane[:3]
    angle = rng.uniform(-_TURN, _TURN)
    away = scene.table @ np.array([np.sin(angle), np.cos(angle), 0.0])
    rows, columns = np.nonzero(scene.labels)
    if not rows.size:
        return scene.depth
    farthest = (camera.unproject(columns, rows, scene.depth[rows, columns]) @ away).max()
    edge = farthest + rng.uniform(0.03, 0.4)
    table = plane_depth(scene.plane, camera)
    v, u = np.nonzero(np.isfinite(table))
    on_table = np.zeros(table.shape, bool)
    on_table[v, u] = camera.unproject(u, v, table[v, u]) @ away < edge
    floor = np.append(normal, scene.plane[3] + rng.uniform(0.05, 0.9))
    ground = plane_depth(floor, camera)
    free = np.nonzero((scene.labels == 0) & ~on_table & np.isfinite(ground))
    if not free[0].size:
        return scene.depth
    chosen = rng.integers(free[0].size, size=int(rng.integers(1, 11)))
    feet = camera.unproject(free[1][chosen], free[0][chosen], ground[free][chosen])
    standing = Superquadric.stack([_standing_at(foot, edge, away, scene.table, rng) for foot in feet])
    seen = np.minimum(np.minimum(ground, raycast.render(standing, camera)[0]), scene.wall)
    return np.where((scene.labels > 0) | on_table, scene.depth, seen)


def _standing_at(
    foot: np.ndarray, edge: float, away: np.ndarray, table: np.ndarray, rng: np.random.Generator
) -> Superquadric:
    """Return a body on the floor below a point, moved from the table if it would reach under its top."""
    least, most = np.log((0.02, 0.5))
    size, turn = np.exp(rng.uniform(least, most, 3)), turn_about_up(rng.uniform(0, np.pi))
    clear = foot @ away - edge - np.hypot(*size[:2])
    centre = foot - min(clear, 0.0) * away + size[2] * table[:, 2]
    return Superquadric(size, rng.uniform(0.1, 1.0, 2), centre, quaternions.from_matrix(table @ turn))
