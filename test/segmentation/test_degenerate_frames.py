"""Frames that show nothing to recover, or hardly anything: no exception, no body, or one that says what it is worth.

Every frame is made of numbers here: planes and corners seen by each simulated sensor, things too near, images without
depth, images of any size.  Masks are the program's own, the whole image as one object, and random ones.

A body is *vouched for* if it did not fail and its score is above 0.5, and *flagged* if it is not vouched for or its
status is not CONVERGED.  A body that is vouched for is wild, with its measured points P, if

    2 max(a) > 3 max(extent of P along x, y, z)                        it is much larger than what was measured of it
    min(z of the body) - median(z of P) > 2 max(a)                     it hides behind what was measured
    height of its lowest point above the support < -10 mm              it reaches below what it stands on

with the true support where the frame has one, otherwise the one that was found if the points lie above it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from sq_perception.fitting.fit import Status
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, Recovery, RecoveryOptions
from sq_perception.simulation import sensor_noise
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
VGA = Camera(640, 480, 540.0, 540.0, 319.5, 239.5)
COARSE = Camera(160, 120, 135.0, 135.0, 79.5, 59.5)
"""Of frames that need no more pixels."""
SENSORS = sorted(sensor_noise.PRESETS)
VOUCHED = 0.5
LARGER = 3.0
BELOW = 0.010
TABLE = np.array([0.0, -np.cos(np.deg2rad(40.0)), -np.sin(np.deg2rad(40.0)), 0.8 * np.sin(np.deg2rad(40.0))])
"""Seen from 0.8 m at 40 degrees."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A depth image, its camera, and the plane that things would stand on, where there is one."""

    depth: np.ndarray
    camera: Camera = COARSE
    support: np.ndarray | None = None


@pytest.fixture(scope="module")
def recoverer() -> Recoverer:
    return Recoverer()


# Frames


def tilted(normal: list[float], away: float) -> np.ndarray:
    unit = np.array(normal, dtype=float) / np.linalg.norm(normal)
    return np.append(unit, -unit[2] * away)


def hand_over_the_lens(seed: int) -> np.ndarray:
    """3 to 8 cm away, with the holes that a sensor leaves below its shortest distance."""
    rng = np.random.default_rng(seed)

    def waves() -> np.ndarray:
        """A smooth surface from 0 to 1 that fills the image."""
        x, y = U / COARSE.width - 0.5, V / COARSE.height - 0.5
        found = sum(
            rng.uniform(0.3, 1) * np.cos(2 * np.pi * (a * x + b * y) + rng.uniform(0, 2 * np.pi))
            for a, b in rng.uniform(-1.2, 1.2, (6, 2))
        )
        return (found - found.min()) / np.ptp(found)

    holes, speckles = waves() > 0.7, rng.random(U.shape) < 0.1
    return np.where(holes | speckles, np.nan, 0.03 + 0.05 * waves() + 5e-4 * rng.standard_normal(U.shape))


def box_close_by(degrees: float) -> np.ndarray:
    """A box of 20 cm whose face or edge is 5 cm away, wider than the image."""
    half = np.deg2rad(degrees) / 2
    body = Superquadric([0.1] * 3, [0.1] * 2, np.zeros(3), [0.0, np.sin(half), 0.0, np.cos(half)])
    place = [0.0, 0.0, 0.05 + body.support(np.array([[0.0, 0.0, -1.0]]))[0]]
    depth, _ = raycast.render(Superquadric(body.size, body.shape, place, body.rotation), COARSE)
    return np.where(np.isfinite(depth), depth + 3e-4 * np.random.default_rng(5).standard_normal(depth.shape), np.nan)


def small(width: int, height: int, shown: str) -> Frame:
    camera = Camera(width, height, 270.0, 270.0, (width - 1) / 2, (height - 1) / 2)
    v, u = np.indices((height, width))
    depth = {"wall": 0.7 + 0 * u, "steps": np.where((u // 40 + v) % 2 == 0, 0.5, 0.9), "nothing": np.nan + u}[shown]
    return Frame(depth.astype(np.float32), camera)


def room(kind: str, camera: Camera = CAMERA) -> np.ndarray:
    """True depth of planes that are the room, not things in it."""
    walls = {
        "empty table": [TABLE],
        "wall in front": [tilted([0, 0, -1], 1.0)],
        "wall at an angle": [tilted([0.8, 0, -1], 1.2)],
        "corner of two walls": [tilted([0.9, 0.1, -1], 1.6), tilted([-1, 0.1, -1], 1.6)],
        "corner of the room": [tilted([0.9, 0, -1], 1.8), tilted([-0.9, 0, -1], 1.8), tilted([0, -1, -0.5], 1.5)],
        "table before a wall": [TABLE, tilted([0, 0, -1], 1.1)],
    }[kind]
    return np.min([plane_depth(wall, camera) for wall in walls], axis=0)


ROOMS = ("empty table", "wall in front", "wall at an angle", "corner of two walls", "corner of the room",
         "table before a wall")  # fmt: skip


def seen(kind: str, sensor: str, seed: int = 3, camera: Camera = CAMERA) -> Frame:
    depth = sensor_noise.preset(sensor).measure(room(kind, camera), camera, np.random.default_rng(seed))
    return Frame(depth, camera, TABLE if "table" in kind else None)


V, U = np.indices((COARSE.height, COARSE.width))
RNG = np.random.default_rng(11)
KEPT = {
    "every other pixel": (U + V) % 2 == 0, "squares": (U // 8 + V // 8) % 2 == 0, "a column": U == 50,
    "a row": V == 38, "a diagonal": U == V, "a pixel": (U == 80) & (V == 60),
}  # fmt: skip
"""What is measured of a wall at 0.8 m."""
NOISES = {
    "uniform": RNG.uniform(0.3, 3.0, U.shape),
    "salt and pepper": np.where(RNG.random(U.shape) < 0.5, 0.4, 2.0),
    "extreme": 10.0 ** RNG.uniform(-30, 30, U.shape),
    "of both signs": RNG.standard_normal(U.shape),
    "rarely a number": np.where(RNG.random(U.shape) < 0.02, RNG.uniform(0.3, 3.0, U.shape), np.nan),
}
VALUES = {"NaN": np.nan, "zero": 0.0, "infinite": np.inf, "negative": -1.0, "0.6 m": 0.6}
IMAGES: dict[str, Callable[[], Any]] = {
    **{f"all {name}": partial(np.full, U.shape, value) for name, value in VALUES.items()},
    "a table in the lower corner": lambda: np.where(U + 2 * V > 210, plane_depth(TABLE, COARSE), np.nan),
    **{f"wall, {kind}": partial(np.where, kept, 0.8, np.nan) for kind, kept in KEPT.items()},
    **{f"noise, {kind}": partial(np.array, image) for kind, image in NOISES.items()},
    **{f"hand over the lens {seed}": partial(hand_over_the_lens, seed) for seed in range(2)},
    **{f"box at 5 cm turned by {degrees} degrees": partial(box_close_by, degrees) for degrees in (0, 45)},
}
SIZES = ((1, 1), (2, 2), (640, 3), (3, 480), (16, 16))
SMALL = {f"{w} x {h} {shown}": partial(small, w, h, shown) for w, h in SIZES for shown in ("wall", "steps", "nothing")}
FRAMES = (*IMAGES, *SMALL)


def frame_of(name: str) -> Frame:
    if name in SMALL:
        return SMALL[name]()
    return Frame(IMAGES[name]().astype(np.float32), support=TABLE if "table" in name else None)


def random_tiles(frame: Frame) -> np.ndarray:
    """Random labels, some negative, in tiles of 12 pixels."""
    rows, columns = (np.arange(size) // 12 for size in frame.depth.shape)
    values = np.random.default_rng(2).integers(-1, 3, (rows[-1] + 1, columns[-1] + 1))
    return values[np.ix_(rows, columns)].astype(np.int16)


MASKS = {
    "whole image": lambda frame: np.ones(frame.depth.shape, np.int32),
    "random pixels": lambda frame: np.random.default_rng(1).integers(0, 3, frame.depth.shape).astype(np.int32),
    "random tiles": random_tiles,
}
"""Masks from outside."""


# What must hold


def flagged(body: Recovery) -> bool:
    return body.score <= VOUCHED or body.status != Status.CONVERGED


def wild(body: Recovery, frame: Frame, found: FrameRecovery) -> str:
    """Why a body is wild; empty if it is not."""
    if body.status == Status.FAILED or body.score <= VOUCHED:
        return ""
    one, camera = body.superquadric, frame.camera
    rows, columns = np.nonzero((found.labels == body.label) & np.isfinite(frame.depth) & (frame.depth > 0))
    points = camera.unproject(columns, rows, frame.depth[rows, columns])
    longest, extent = 2 * float(one.size.max()), float(np.ptp(points, axis=0).max())
    if longest > LARGER * extent:
        return f"{1e3 * longest:.0f} mm long, measured {1e3 * extent:.0f} mm"
    behind = float(one.bounding_box()[0][2] - np.median(points[:, 2]))
    if behind > longest:
        return f"{1e3 * behind:.0f} mm behind what was measured, {1e3 * longest:.0f} mm long"
    support = frame.support
    if support is None and found.plane is not None and np.median(points @ found.plane[:3] + found.plane[3]) > 0:
        support = found.plane
    if support is None:
        return ""
    normal = support[:3] / np.linalg.norm(support[:3])
    lowest = (one.translation @ support[:3] + support[3]) / np.linalg.norm(support[:3]) - one.support(-normal[None])[0]
    return f"{-1e3 * lowest:.0f} mm below the support" if lowest < -BELOW else ""


def check(found: FrameRecovery, frame: Frame) -> None:
    """The answer is whole, its numbers are numbers, and no body is wild."""
    assert found.labels.shape == frame.depth.shape
    assert found.message or found.bodies
    for body in found.bodies:
        assert np.isfinite(body.superquadric.to_numbers()).all()
        assert (body.superquadric.size > 0).all()
        assert 0 <= body.score <= 1
        assert body.status == Status.CONVERGED or body.message
        assert not wild(body, frame, found), f"{body.status.name}, score {body.score:.2f}: {wild(body, frame, found)}"


def check_empty(found: FrameRecovery, frame: Frame) -> None:
    check(found, frame)
    bad = [f"score {body.score:.2f}, sizes {body.superquadric.size}" for body in found.bodies if not flagged(body)]
    assert not bad, bad


NOISY_WALLS = [*(("wall at an angle", "realsense_d435", seed) for seed in (1, 6, 7)),
               ("corner of two walls", "realsense_d435", 5)]  # fmt: skip


@pytest.mark.parametrize(("kind", "sensor", "seed"), [*((k, s, 3) for k in ROOMS for s in SENSORS), *NOISY_WALLS])
def test_a_room_without_things_has_no_bodies(recoverer: Recoverer, kind: str, sensor: str, seed: int) -> None:
    frame = seen(kind, sensor, seed)
    check_empty(recoverer.recover(frame.depth, frame.camera), frame)


def test_noise_in_the_corner_of_a_room_makes_no_wild_body(recoverer: Recoverer) -> None:
    frame = seen("corner of the room", "realsense_d435", 0, VGA)
    check(recoverer.recover(frame.depth, frame.camera, options=RecoveryOptions(repair=False)), frame)


@pytest.mark.parametrize("sensor", ["realsense_d435", "kinect_v1"])
@pytest.mark.parametrize("kind", ROOMS)
@pytest.mark.parametrize("masks", ["whole image", "random tiles"])
def test_masks_in_a_room_without_things_make_no_wild_bodies(recoverer, kind, sensor, masks) -> None:
    frame = seen(kind, sensor)
    if masks == "whole image":  # then the table itself is the object, and stands on nothing
        frame = replace(frame, support=None)
    check(recoverer.recover(frame.depth, frame.camera, MASKS[masks](frame)), frame)


@pytest.mark.parametrize("name", FRAMES)
def test_a_frame_of_nothing_has_no_bodies(recoverer: Recoverer, name: str) -> None:
    frame = frame_of(name)
    check_empty(recoverer.recover(frame.depth, frame.camera), frame)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("masks", MASKS)
def test_masks_in_a_frame_of_nothing_make_no_wild_bodies(recoverer: Recoverer, name: str, masks: str) -> None:
    frame = frame_of(name)
    check(recoverer.recover(frame.depth, frame.camera, MASKS[masks](frame)), frame)


def test_readings_that_no_sensor_makes_count_as_none(recoverer: Recoverer) -> None:
    ball = Superquadric(np.full(3, 0.1), np.ones(2), np.array([0.0, 0.0, 0.6]), np.array([0.0, 0.0, 0.0, 1.0]))
    depth = np.where(np.isfinite(rendered := raycast.render(ball, COARSE)[0]), rendered, np.nan).astype(np.float32)
    labels = np.isfinite(depth).astype(np.int32)
    holes = np.random.default_rng(1).random(depth.shape) < 0.2
    wild = np.where(holes, np.resize(np.array([1e30, 1e-30, 3e38, 1e6], np.float32), depth.shape), depth)
    known, found = (
        recoverer.recover(image, COARSE, labels).bodies[0]
        for image in (np.where(holes, np.float32(np.nan), depth), wild)
    )
    assert found.pixels == known.pixels
    np.testing.assert_array_equal(found.superquadric.to_numbers(), known.superquadric.to_numbers())
