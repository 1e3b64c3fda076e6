"""Depth images of triangle meshes: a depth sensor, and poses in the air and on a table.

Metres; optical frame; p_camera = rotation p_mesh + translation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from sq_perception.geometry import rotation as quaternions
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.rendering import Mesh, render_mesh
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(640, 480, 320 / np.tan(np.deg2rad(30)), 320 / np.tan(np.deg2rad(30)), 319.5, 239.5)
DISTANCE = (0.5, 1.0)
"""From the camera to the middle of the object, metres."""
OFF_AXIS = 0.1
"""How far beside the optical axis, as a share of the distance."""
ELEVATION = (30.0, 60.0)
"""How steeply the camera looks down on a table, degrees."""
ROLL = 10.0
SIGMA_AT_1_M = 0.0015
QUANTUM = 0.001


@dataclass(frozen=True)
class MeshView:
    """One object in one image.

    Attributes
    ----------
    depth : (height, width)
        Metres as measured, NaN where nothing was.
    mask : (height, width)
        The object's true pixels.
    plane : (4,) or None
        The support, height above it = n.p + d.
    rotation, translation : (3, 3), (3,)
        Camera from mesh.
    """

    depth: np.ndarray
    mask: np.ndarray
    camera: Camera
    plane: np.ndarray | None
    rotation: np.ndarray
    translation: np.ndarray


Poser = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray, np.ndarray | None]]


def floating(hull: trimesh.Trimesh) -> Poser:
    """Any orientation, nothing behind."""
    middle = hull.bounds.mean(axis=0)

    def pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, None]:
        turn = quaternions.to_matrix(quaternions.random(1, rng)[0])
        return turn, _place(rng) - turn @ middle, None

    return pose


def resting(hull: trimesh.Trimesh) -> Poser:
    """On one of its stable faces, as likely as it would come to lie there; the camera looks down on the table."""
    rests, likely = hull.compute_stable_poses()
    likely = likely / likely.sum()

    def pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rest = rests[rng.choice(len(rests), p=likely)]
        down, roll, yaw = np.deg2rad([rng.uniform(*ELEVATION), rng.uniform(-ROLL, ROLL), rng.uniform(0, 360)])
        table = about_z(roll) @ looked_down_on(down) @ about_z(yaw)
        turn = table @ rest[:3, :3]
        middle = trimesh.transform_points(hull.vertices, rest)
        middle = (middle.min(axis=0) + middle.max(axis=0)) / 2
        origin = _place(rng) - table @ middle
        normal = table[:, 2]
        return turn, origin + table @ rest[:3, 3], np.append(normal, -normal @ origin)

    return pose


def view(mesh: trimesh.Trimesh, pose: Poser, rng: np.random.Generator) -> MeshView:
    """One image of the mesh through the sensor; poses that the image cuts are drawn again."""
    while True:
        turn, translation, plane = pose(rng)
        vertices = mesh.vertices @ turn.T + translation
        pixels = CAMERA.project(vertices)
        if (pixels > 1).all() and (pixels < [CAMERA.width - 2, CAMERA.height - 2]).all():
            break
    depth = render_mesh(Mesh(vertices, mesh.faces), CAMERA)
    mask = np.isfinite(depth)
    if plane is not None:
        depth = np.where(mask, depth, plane_depth(plane, CAMERA))
    return MeshView(measured(depth, rng), mask, CAMERA, plane, turn, translation)


def render_meshes(
    meshes: Sequence[trimesh.Trimesh], turns: Sequence[np.ndarray], places: Sequence[np.ndarray], behind: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth and labels (height, width) of meshes in given poses before a background, and their pixels (n,) if alone.

    Labels count from 1; 0 is the background.
    """
    depth, labels, alone = behind, np.zeros(behind.shape, np.int32), []
    for k, (mesh, turn, place) in enumerate(zip(meshes, turns, places, strict=True)):
        own = render_mesh(Mesh(mesh.vertices @ turn.T + place, np.asarray(mesh.faces)), CAMERA)
        nearer = own < depth
        depth, labels = np.where(nearer, own, depth), np.where(nearer, np.int32(k + 1), labels)
        alone.append(np.count_nonzero(np.isfinite(own)))
    return depth, labels, np.array(alone, dtype=int)


def measured(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the sensor makes of true depth: noise that grows with z^2, whole millimetres, NaN for infinity."""
    depth = np.where(np.isfinite(depth), depth, np.nan)
    noisy = depth + rng.standard_normal(depth.shape) * SIGMA_AT_1_M * depth**2
    return np.round(noisy / QUANTUM) * QUANTUM


def _place(rng: np.random.Generator) -> np.ndarray:
    distance = rng.uniform(*DISTANCE)
    return distance * np.append(rng.uniform(-OFF_AXIS, OFF_AXIS, 2), 1.0)


def looked_down_on(down: float) -> np.ndarray:
    """Columns: right, away and up on a table, in the optical frame of a camera that looks down by so many radians."""
    return np.array([[1.0, 0, 0], [0, -np.sin(down), -np.cos(down)], [0, np.cos(down), -np.sin(down)]])


def about_z(angle: float) -> np.ndarray:
    """The rotation (3, 3) about z by so many radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
