"""Measurements of a simulated object by random depth sensors: errors and missing readings.

One of :mod:`sensor_noise` with random parameters: noise of a window, steps, the shadow of the baseline on either side,
fattened or mixed or wandering edges, lost grazing sides.  Besides, in some images: waves, a side that is lost as one
eye hardly sees it, lost edges, contours, dark blobs and bands, objects that are lost but for patches, smoothing.  In
half of them what is missing beside the object is filled with what is there.  Last come the camera's
:mod:`~sq_perception.simulation.camera_stages`.

Depth in metres.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.simulation.camera_stages import Stages, temporal
from sq_perception.simulation.sensor_noise import Ideal, SensorNoise, Stereo, StructuredLight, TimeOfFlight

_SHINING = 0.08
"""Share of the images whose objects are lost but for patches.  Of household objects that are half visible, 4 % are
measured at less than half of their pixels."""


def draw_sensor(camera: Camera, rng: np.random.Generator) -> SensorNoise:
    """Draw a depth sensor with random parameters around those of :data:`sensor_noise.PRESETS`."""
    choice = rng.random()
    if choice < 0.1:
        return Ideal(rng.uniform(0, 0.001))
    if choice < 0.35:
        near = rng.uniform(0.1, 0.3)
        return TimeOfFlight(near, rng.uniform(3.0, 5.0), rng.uniform(0.0, 2.0), rng.uniform(0.0, 1.0))
    grazing = rng.uniform(55, 80)
    shared: dict[str, Any] = {
        "focal": camera.fx,
        "baseline": rng.choice([-1.0, 1.0]) * rng.uniform(0.02, 0.12),
        "step": rng.choice([0.0, 1 / 32, 1 / 8]),
        "window": (int(rng.choice([1, 3, 5, 7])), int(rng.choice([1, 3, 5]))),
        "near": 0.1,
        "far": 10.0,
        "edge_wander": rng.uniform(0.0, 1.2),
        "grazing": grazing,
        "blind": rng.uniform(grazing, 89),
    }
    if choice < 0.65:
        return StructuredLight(**shared)
    return Stereo(**shared, subpixel=rng.uniform(0.02, 0.15), fattening=int(rng.integers(0, 4)))


def measure_by_any(
    depth: np.ndarray, seen: np.ndarray, camera: Camera, stages: Stages, rng: np.random.Generator
) -> np.ndarray:
    """Measure a true depth image with a random sensor and these camera stages."""
    sensor = draw_sensor(camera, rng)
    frames = [sensor.measured(depth, camera, rng) for _ in range(stages.frames)]
    measured = temporal(frames, stages.factor, stages.threshold) if len(frames) > 1 else frames[0]
    if rng.random() < 0.4:
        measured += _waves(measured.shape, rng) * np.square(measured)
    if rng.random() < 0.35:
        measured[seen & _turn_aside(depth, camera, rng)] = np.nan
    if rng.random() < 0.25:
        measured[_edges(depth, rng)] = np.nan
    if rng.random() < 0.1:
        measured[seen & _contours(depth, seen, rng)] = np.nan
    if rng.random() < 0.15:
        measured[seen & _blob(seen, rng)] = np.nan
    if rng.random() < _SHINING:
        measured[seen & _between_patches(seen, rng)] = np.nan
    if rng.random() < 0.3:
        measured = _smooth(measured, int(rng.choice((3, 5))), seen if rng.random() < 0.5 else None)
    if rng.random() < 0.5:
        filled = ~seen & np.isnan(measured) & np.isfinite(depth)
        measured[filled] = depth[filled]
    return stages.processed(measured, seen, camera)


def _waves(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draw smooth errors, metres at 1 m, as calibration and disparity interpolation leave them."""
    coarse = rng.standard_normal((int(rng.integers(4, 14)), int(rng.integers(4, 14))), dtype=np.float32)
    sigma = np.float32(0.0005 * 8.0 ** rng.random())
    return sigma * cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)


def _edges(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Select most pixels within one to three pixels of a depth step."""
    inverse = (1 / depth).astype(np.float32)
    brush = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(inverse, brush)
    step: np.ndarray = (highest - cv2.erode(inverse, brush) > 0.06 * highest).astype(np.uint8)
    wider = int(rng.integers(0, 3))
    if wider:
        step = cv2.dilate(step, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * wider + 1, 2 * wider + 1)))
    return (step > 0) & (rng.random(depth.shape, dtype=np.float32) < rng.uniform(0.4, 1.0))


def _contours(depth: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Select thin lines of equal disparity, where some sensors that measure in steps find no match."""
    inverse = 1 / depth
    near, far = inverse[seen].max(), inverse[seen].min()
    lines = rng.uniform(1.5, 6.0) / max(near - far, 1e-6)
    return (inverse * lines + rng.random()) % 1.0 < rng.uniform(0.03, 0.12)


def _turn_aside(depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Select surfaces that turn away to one side of the image by more than a random angle."""
    with np.errstate(invalid="ignore"):
        slope = cv2.Sobel(depth, cv2.CV_64F, 1, 0, ksize=1) * (0.5 * camera.fx) / depth
        return rng.choice([-1.0, 1.0]) * slope > np.tan(np.deg2rad(rng.uniform(45, 82)))


def _blob(seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Select a dark label: an ellipse or a band somewhere on the object."""
    v, u = np.nonzero(seen)
    at = rng.integers(v.size)
    side = max(np.ptp(u), np.ptp(v)) + 1
    down, across = np.indices(seen.shape, dtype=float)
    way = rng.uniform(0, np.pi)
    c, s = np.cos(way), np.sin(way)
    x, y = c * (across - u[at]) + s * (down - v[at]), c * (down - v[at]) - s * (across - u[at])
    wide = side * rng.uniform(0.03, 0.2)
    long = np.inf if rng.random() < 0.3 else side * rng.uniform(0.05, 0.3)
    return np.square(x / long) + np.square(y / wide) < 1


def _between_patches(seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Select most of an object that is shiny, dark or translucent."""
    coarse = rng.standard_normal((int(rng.integers(3, 12)), int(rng.integers(3, 12))), dtype=np.float32)
    field = cv2.resize(coarse, (seen.shape[1], seen.shape[0]), interpolation=cv2.INTER_CUBIC)
    return field > np.quantile(field[seen], 1 - rng.uniform(0.3, 0.95))


def _smooth(measured: np.ndarray, width: int, within: np.ndarray | None) -> np.ndarray:
    """Average the readings of a window, all of them or only those within a mask."""
    known = np.isfinite(measured)
    inner = known if within is None else known & within
    weight = cv2.blur(inner.astype(np.float32), (width, width))
    mean = cv2.blur(np.where(inner, measured, np.float32(0)), (width, width)) / np.maximum(weight, np.float32(1e-6))
    return np.where(inner, mean, measured)
