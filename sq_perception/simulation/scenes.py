"""Scenes with known truth: one body of the thesis' protocol, bodies resting on a table, or a sample of known objects.

Thesis protocol (chapter 5.1), in the unit cube: half sizes a in [25, 75] / 255, exponents e in [0.1, 1], the centre at
(128 +- 40) / 255, rotations uniform, seen by the orthographic camera of :mod:`sq_perception.imaging.unit_cube`.

Table
-----
A pinhole camera looks down on the plane n.p + d = 0 (optical frame, |n| = 1, n up) at its point (0, 0, L).  With the
pitch angle p below the horizon and the roll r,

    n = (-cos p sin r, -cos p cos r, -sin p),    d = L sin p.

A body touches the plane according to its support function h: its centre t has the height n.t + d = h(n).  It stands on
one of its three axes, turned about n by any angle.  The shortest axis always holds; another one is taken only for
bodies with flat faces (e1 and e2 below 0.5), since an egg does not stand on its tip.

In a crowd most bodies are pushed along the table against another one until they touch.  Convex bodies A and B overlap
where a point of one's surface lies inside the other; the push ends where no sampled point does any more.

Metres; depth is the z coordinate, NaN where nothing is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.raycast import render
from sq_perception.simulation.sensor_noise import preset

THESIS_SIZE = (25 / 255, 75 / 255)
TABLE_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
MOST = 12  # most bodies of a crowd


@dataclass(frozen=True)
class Scene:
    """Bodies and the camera that sees them."""

    bodies: Superquadric  # a batch (n,) in the optical frame of the camera, NumPy
    camera: Camera
    plane: np.ndarray | None  # (4,), height above the table = n.p + d in the optical frame, n up; None without a table

    def render(self) -> tuple[np.ndarray, np.ndarray]:
        """Render depth float32 (height, width), NaN for no surface, and labels int32, k + 1 for body k, 0 elsewhere."""
        depth, index = render(self.bodies, self.camera)
        if self.plane is not None:
            table = plane_depth(self.plane, self.camera)
            behind = table < depth
            depth, index = np.where(behind, table, depth), np.where(behind, -1, index)
        return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32), (index + 1).astype(np.int32)


def thesis_bodies(count: int, rng: np.random.Generator) -> Superquadric:
    """Draw a batch (count,) of bodies of the thesis' protocol, in the cube frame."""
    return Superquadric(
        rng.uniform(*THESIS_SIZE, (count, 3)), rng.uniform(0.1, 1.0, (count, 2)),
        rng.uniform(88 / 255, 168 / 255, (count, 3)), quaternions.random(count, rng),
    )


def thesis_scene(rng: np.random.Generator) -> Scene:
    """Draw one random body of the thesis' protocol before the camera of the unit cube."""
    return Scene(unit_cube.optical_from_cube(thesis_bodies(1, rng)), unit_cube.camera(unit_cube.THESIS_PIXELS), None)


def table_scene(rng: np.random.Generator, count: int = 3, camera: Camera = TABLE_CAMERA) -> Scene:
    """Draw ``count`` random bodies side by side on a table, all wholly inside the image.  Raises ValueError if
    ``count`` is not 1 to 10, the camera is no pinhole camera, or the bodies do not fit into its image."""
    if not 1 <= count <= 10:
        raise ValueError(f"count: expected 1 to 10 bodies, got {count}")
    if not camera.is_pinhole:
        raise ValueError("camera: expected a pinhole camera, got an orthographic one")
    # In one of seven views ten bodies do not fit.
    for _ in range(10):
        plane = table_plane(rng, (0.7, 1.0), (np.pi / 6, np.pi / 3))
        bodies: list[Superquadric] = []
        reach: list[float] = []
        for _ in range(2000):
            body, radius = resting_body(rng, plane)
            apart = all(
                np.linalg.norm(body.translation - other.translation) > radius + other_radius + 0.015
                for other, other_radius in zip(bodies, reach, strict=True)
            )
            if apart and inside_image(body, camera):
                bodies.append(body)
                reach.append(radius)
            if len(bodies) == count:
                return Scene(Superquadric.stack(bodies), camera, plane)
        if not bodies:  # nor will another view of the table show a whole one
            break
    raise ValueError(f"no room for {count} bodies in an image of {camera.width} x {camera.height} pixels")


def plane_depth(plane: np.ndarray, camera: Camera) -> np.ndarray:
    """Return depth float64 (height, width) of the plane n.p + d = 0; +inf where its front is not within 4 m."""
    v, u = np.indices((camera.height, camera.width))
    origin, direction = camera.rays(u, v)
    slope = direction @ plane[:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -(origin @ plane[:3] + plane[3]) / slope
    return np.where((slope < 0) & (depth > 0) & (depth < 4.0), depth, np.inf)


def table_plane(rng: np.random.Generator, distance: tuple[float, float], pitch: tuple[float, float]) -> np.ndarray:
    """Return the plane (4,) of a table that the camera looks down on, at a distance along its axis."""
    most = float(np.deg2rad(5.0))
    far, down, roll = rng.uniform(*distance), rng.uniform(*pitch), rng.uniform(-most, most)
    normal = -np.array([np.cos(down) * np.sin(roll), np.cos(down) * np.cos(roll), np.sin(down)])
    return np.append(normal, far * np.sin(down))


def turn_about_up(yaw: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle, radians, about the z axis of a table's frame."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def resting_body(
    rng: np.random.Generator, plane: np.ndarray, reach: float = 0.3
) -> tuple[Superquadric, float]:
    """Draw a body on the plane within ``reach`` metres of where the camera looks, and its bounding radius, metres."""
    normal, offset = plane[:3], plane[3]
    size, shape = rng.uniform(0.02, 0.07, 3), rng.uniform(0.1, 1.0, 2)
    upright = int(rng.integers(3)) if shape.max() < 0.5 else int(np.argmin(size))
    across = np.cross(normal, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    table = np.stack([across, np.cross(normal, across), normal], axis=1)
    turn = turn_about_up(rng.uniform(0, 2 * np.pi))
    axes = np.roll(np.eye(3), upright - 2, axis=1)
    rotation = quaternions.from_matrix(table @ turn @ axes)
    radius, bearing = reach * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    height = Superquadric(size, shape, np.zeros(3), rotation).support(normal[None])[0]
    looked_at = np.array([0.0, 0.0, -offset / normal[2]])
    centre = looked_at + table @ np.array([radius * np.cos(bearing), radius * np.sin(bearing), height])
    return Superquadric(size, shape, centre, rotation), float(np.linalg.norm(size))


def inside_image(body: Superquadric, camera: Camera, border: float = 0.0) -> bool:
    """Return whether the box around a body is wholly visible, this many pixels from the border."""
    lower, upper = body.bounding_box()
    if lower[2] <= 0:
        return False
    corners = np.stack(np.meshgrid(*np.stack([lower, upper], axis=-1), indexing="ij"), axis=-1).reshape(-1, 3)
    pixels = camera.project(corners)
    limit = np.array([camera.width, camera.height]) - 1 - border
    return bool((pixels >= border).all() and (pixels <= limit).all())


def draw_crowd(rng: np.random.Generator, count: int, camera: Camera = TABLE_CAMERA) -> Scene:
    """Draw ``count`` random bodies on a table seen from 0.5 to 1.2 m, most in contact, wholly inside the image.  Raises
    ValueError if ``count`` is not 1 to 12, or the bodies do not fit into the image."""
    if not 1 <= count <= MOST:
        raise ValueError(f"count: expected 1 to {MOST} bodies, got {count}")
    for _ in range(10):
        plane = table_plane(rng, (0.5, 1.2), tuple(np.deg2rad([30.0, 65.0])))
        bodies: list[_Placed] = []
        for _ in range(200):
            drawn = resting_body(rng, plane, 0.25)[0]
            if not inside_image(drawn, camera):
                continue
            body = _Placed(drawn, drawn.sample_surface(1500, rng, oversampling=2))
            if bodies and rng.random() < 0.7:
                body = _push(body, bodies[rng.integers(len(bodies))], plane[:3])
            if not any(map(body.overlaps, bodies)) and inside_image(body.body, camera):
                bodies.append(body)
            if len(bodies) == count:
                return Scene(Superquadric.stack([placed.body for placed in bodies]), camera, plane)
    raise ValueError(f"no room for {count} bodies in an image of {camera.width} x {camera.height} pixels")


@dataclass(frozen=True)
class _Placed:
    """A body with points (n, 3) of its surface."""

    body: Superquadric
    surface: np.ndarray

    def move(self, by: np.ndarray) -> _Placed:
        return _Placed(self.body.transformed(np.array([0.0, 0.0, 0.0, 1.0]), by), self.surface + by)

    def overlaps(self, other: _Placed) -> bool:
        if np.linalg.norm(self.body.translation - other.body.translation) > np.linalg.norm(
            self.body.size
        ) + np.linalg.norm(other.body.size):
            return False
        return bool((self.body.gauge(other.surface) < 1).any() or (other.body.gauge(self.surface) < 1).any())


def _push(body: _Placed, other: _Placed, normal: np.ndarray) -> _Placed:
    """Push a body along the table, straight towards the other one or away from it, until they just touch."""
    way = body.body.translation - other.body.translation
    way = way - (way @ normal) * normal
    length = float(np.linalg.norm(way))
    way = way / length if length > 0 else np.cross(normal, [0.0, 0.0, 1.0])
    near, far = -length, float(np.linalg.norm(body.body.size) + np.linalg.norm(other.body.size))
    while far - near > 2e-4:
        middle = 0.5 * (near + far)
        near, far = (middle, far) if body.move(middle * way).overlaps(other) else (near, middle)
    return body.move(far * way)


THINGS = {
    "carton": ((0.16, 0.07, 0.21), (0.1, 0.1), (-0.15, 0.10), 20.0),
    "can": ((0.066, 0.066, 0.115), (0.1, 1.0), (0.04, 0.02), 0.0),
    "ball": ((0.074, 0.074, 0.074), (1.0, 1.0), (0.17, -0.06), 0.0),
    "soap": ((0.095, 0.060, 0.035), (0.3, 0.3), (-0.06, -0.11), -35.0),
}
"""The sample's objects: full edges, exponents, place on the table (x to the right, y away from the camera) and turn, in
metres and degrees."""


@dataclass(frozen=True, eq=False)
class Sample:
    """A simulated frame: measured depth (height, width), metres, NaN where nothing was measured, its camera, and the
    true bodies (n,) in the optical frame with their names."""

    depth: np.ndarray
    camera: Camera
    bodies: Superquadric
    names: tuple[str, ...]


def sample(seed: int = 0) -> Sample:
    """Simulate a table as a RealSense D435 measures it from 0.85 m, 35 degrees above, with the noise of this seed."""
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
