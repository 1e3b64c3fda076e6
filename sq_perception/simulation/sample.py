"""A sample frame: four objects of known size on a table, as a RealSense D435 would measure them.

The camera looks down on the table at 35 degrees from 0.85 m.  In the frame of the table, whose origin the camera looks
at, x is to the right, y away from the camera and z up; full edges in metres, angles about z in degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import TABLE_CAMERA, Scene, turn_about_up
from sq_perception.simulation.sensor_noise import preset

THINGS = {
    "carton": ((0.16, 0.07, 0.21), (0.1, 0.1), (-0.15, 0.10), 20.0),
    "can": ((0.066, 0.066, 0.115), (0.1, 1.0), (0.04, 0.02), 0.0),
    "ball": ((0.074, 0.074, 0.074), (1.0, 1.0), (0.17, -0.06), 0.0),
    "soap": ((0.095, 0.060, 0.035), (0.3, 0.3), (-0.06, -0.11), -35.0),
}
"""Full edges, exponents, place on the table and turn of each object."""


@dataclass(frozen=True, eq=False)
class Sample:
    """A simulated frame: measured depth (height, width), metres, NaN where nothing was measured, its camera, and the
    true bodies (n,) in the optical frame with their names."""

    depth: np.ndarray
    camera: Camera
    bodies: Superquadric
    names: tuple[str, ...]


def sample(seed: int = 0) -> Sample:
    """Simulate the frame; the seed is that of the sensor's noise."""
    pitch = np.deg2rad(35.0)
    up = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
    right = np.array([1.0, 0.0, 0.0])
    table = np.stack([right, np.cross(up, right), up], axis=1)
    looked_at = np.array([0.0, 0.0, 0.85])
    bodies = []
    for edges, shape, place, degrees in THINGS.values():
        size = 0.5 * np.array(edges)
        centre = looked_at + table @ np.array([*place, size[2]])
        turn = quaternions.from_matrix(table @ turn_about_up(np.deg2rad(degrees)))
        bodies.append(Superquadric(size, np.array(shape), centre, turn))
    scene = Scene(Superquadric.stack(bodies), TABLE_CAMERA, np.append(up, -up @ looked_at))
    depth = preset("realsense_d435").measure(scene.render()[0], scene.camera, np.random.default_rng(seed))
    return Sample(depth.astype(np.float32), scene.camera, scene.bodies, tuple(THINGS))
