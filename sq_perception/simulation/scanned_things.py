"""The user's own objects as meshes, to train a network on besides the simulated household.

A mesh rests on the faces of its hull on which it is stable, as often as it would settle there (K. Goldberg et al.,
"Part pose statistics", 1999, as computed by trimesh for uniform density).  Views show the mesh; the network predicts
its hull, whose corners are in :attr:`Thing.parts` as points.

Metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.simulation.rendering import Mesh
from sq_perception.simulation.thing import NO_CAVITY, Rest, Thing

SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".off")
LARGEST, SMALLEST = 1.0, 0.005
"""Longest edge of the box around an object, metres: others are taken for other units."""


def read_things(folder: Path) -> tuple[Thing, ...]:
    """Read all meshes of a folder, by name.

    Raises
    ------
    ValueError
        If there are none, one cannot be read or has no faces, or its size is none that one takes in a hand.
    """
    paths = sorted(path for path in folder.glob("[!.]*") if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise ValueError(f"{folder}: expected meshes ({' '.join(SUFFIXES)}), found none")
    return tuple(_read(path) for path in paths)


def _read(path: Path) -> Thing:
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        mesh.remove_unreferenced_vertices()  # nobody sees them
        hull = mesh.convex_hull
        if not hull.volume > 0:
            raise ValueError("it is flat")  # and trimesh would look for its poses for ever
        turns, likely = hull.compute_stable_poses()
    except Exception as error:  # whatever a reader of one of many formats raises
        raise ValueError(f"{path}: no mesh with a volume: {error}") from error
    longest = float(np.ptp(hull.vertices, axis=0).max())
    if not SMALLEST <= longest <= LARGEST:
        raise ValueError(
            f"{path}: expected metres, a thing of {SMALLEST} to {LARGEST}; its longest edge is {longest:.4g}"
        )
    middle = hull.bounds.mean(axis=0)
    corners = hull.vertices - middle
    points = np.zeros((len(corners), 12))
    points[:, :3], points[:, 3:5], points[:, 5:8], points[:, 11] = 1e-5, 1.0, corners, 1.0
    order = np.argsort(-likely, kind="stable")
    # The likeliest are kept: each pose of a finely divided round side is unlikely.
    kept = order[: np.searchsorted(np.cumsum(likely[order]), 0.99 * likely.sum()) + 1]
    turns, likely = turns[kept], likely[kept]
    rests = tuple(
        Rest(f"face {k}", quaternions.from_matrix(turn[:3, :3]), float(share))
        for k, (turn, share) in enumerate(zip(turns, likely / likely.sum(), strict=True))
    )
    surface = Mesh(np.asarray(mesh.vertices, dtype=float) - middle, np.asarray(mesh.faces))
    return Thing("union", path.stem, Superquadric.from_flat(points), rests, NO_CAVITY, surface)
