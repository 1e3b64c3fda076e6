"""What a camera's driver and its users do to depth images after the sensor measured them.

Every stage takes and gives depth (height, width), float32 metres, NaN where nothing was measured.  With the inverse
depth w = 1 / z, in which stereo cameras filter, and x, s the value and the filtered value along a row or column:

    temporal    s_k = a x_k + (1 - a) s_(k-1) over frames k if |x_k - s_(k-1)| < d, else x_k; s_(k-1) if x_k is missing
    decimate    the median of the readings of n x n pixels; focal lengths and principal point follow
    spatial     the same recursion along each row, forth and back, then along each column; some rounds of that
    ring        beside a step of more than a share of z nothing is measured: n pixels on its far side, m on its near one
    fill        a missing reading is its left neighbour, or the farthest or nearest of five neighbours, in raster order
    align       p' = p - b, each reading drawn where it is seen from b, as a point or as a rectangle; the nearest wins
    bend        z (1 + k.(x - x0) + q |x - x0|^2), x = (X / Z, Y / Z): nothing moves at x0
    median      over n x n pixels, in which a missing reading is 0, as in images of whole millimetres
    round_depth to whole steps
    blocks      w without what JPEG's quantisation of 8 x 8 blocks loses

References
----------
librealsense, post-processing filters (doc/post-processing-filters.md, src/proc): the equations of temporal, decimate,
spatial and fill, their ranges and defaults; align: rectangles.  The edge is kept by Gastal & Oliveira, Domain
transform for edge-aware image and video processing, SIGGRAPH 2011.  depth_image_proc (ROS), register: points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.imaging import depth_steps
from sq_perception.imaging.camera import Camera

Filling = Literal["left", "farthest", "nearest"]


@dataclass(frozen=True)
class StageRanges:
    """Shares of the cameras that have a stage, and the ranges of its parameters."""

    temporal: float = 0.2
    frames: tuple[int, int] = (2, 4)  # a still scene: with the default of a = 0.4, four frames weigh 87 %
    decimation: float = 0.1
    spatial: float = 0.45
    factor: tuple[float, float] = (0.25, 1.0)  # a, of both filters; librealsense: 0.25 to 1, by default 0.5
    threshold: tuple[float, float] = (1.0, 50.0)
    """d, in steps of disparity of 1/32 pixel; librealsense: 1 to 50, by default 20."""
    rounds: tuple[int, int] = (1, 5)  # librealsense: 1 to 5, by default 2
    disparity: tuple[float, float] = (15.0, 80.0)
    """f b, pixels times metres, by which steps are counted: 21 for a D435 at 848 x 480, 87 for a D455 at 1280 x 720."""
    ring: float = 0.45
    outer: tuple[int, int] = (1, 6)  # pixels
    both_sides: float = 0.2
    """Share of the rings that cost the near side readings too.  What a second eye does not see, or a window mixes with
    what is nearer, is behind; mixed pixels of time of flight are on both sides."""
    inner: tuple[int, int] = (1, 2)
    edge: tuple[float, float] = (0.02, 0.08)
    """Step in depth from pixel to pixel beside which readings are lost, as a share of the depth."""
    foot: float = 0.5  # share of the rings that go around the whole thing, its foot too, where no step is
    filling: float = 0.15
    alignment: float = 0.25
    baseline: tuple[float, float] = (0.01, 0.06)
    """Metres from the sensor to the colour camera: D435 15 mm, Xtion 25, Azure Kinect 32, D455 59."""
    focal: tuple[float, float] = (0.65, 1.15)
    """Focal length of the sensor over that of the colour camera: D435 424 / 615, Kinect v1 580 / 525."""
    bend: float = 0.5
    slope: float = 0.02  # largest k and q: a table is bent by 1 to 2 % of the depth over half an image
    median: float = 0.15
    rounding: float = 0.5
    steps: tuple[float, ...] = (0.0001, 0.001, 0.001, 0.01)  # metres; whole millimetres are the rule (REP 118)
    blocks: float = 0.08
    quality: tuple[float, float] = (2e-4, 4e-3)
    """Quantum of the blocks' mean, per metre, of 8 to 12 bits for depths from half a metre on."""


RANGES = StageRanges()


def temporal(frames: Sequence[np.ndarray], factor: float, threshold: float) -> np.ndarray:
    """The last of some frames of a still scene, filtered with the ``factor`` a and the ``threshold`` d per metre."""
    held = _inverse(frames[0])
    for new in map(_inverse, frames[1:]):
        close = np.abs(new - held) < threshold
        held = np.where(np.isnan(new) | close, np.where(close, held + factor * (new - held), held), new)
    return _inverse(held)


def decimate(depth: np.ndarray, times: int) -> np.ndarray:
    """Depth (height // n, width // n)."""
    height, width = depth.shape[0] // times, depth.shape[1] // times
    cells = depth[: times * height, : times * width].reshape(height, times, width, times).swapaxes(1, 2)
    ordered = np.sort(cells.reshape(height, width, times * times), axis=2)  # NaN last
    middle = np.maximum(np.count_nonzero(~np.isnan(ordered), axis=2) - 1, 0) // 2
    return np.take_along_axis(ordered, middle[..., None], axis=2)[..., 0]


def decimate_camera(camera: Camera, times: int) -> Camera:
    """The camera of a decimated image; pixels' centres are whole numbers in both."""
    size = camera.width // times, camera.height // times
    cx, cy = ((each + 0.5) / times - 0.5 for each in (camera.cx, camera.cy))
    return Camera(*size, camera.fx / times, camera.fy / times, cx, cy, camera.projection)


def spatial(depth: np.ndarray, factor: float, threshold: float, rounds: int) -> np.ndarray:
    """Filtered with the ``factor`` a and the ``threshold`` d per metre."""
    w = _inverse(depth)
    for _ in range(rounds):
        for _ in range(2):  # along the rows, then along the columns
            _smooth_rows(w, factor, threshold)
            w = np.ascontiguousarray(w.T)
    return _inverse(w)


def ring(depth: np.ndarray, outer: int, inner: int, share: float) -> np.ndarray:
    """Without the readings beside steps between neighbours of more than this ``share`` of the depth: ``outer`` pixels
    of what is behind, ``inner`` of what is before."""
    w, left = _inverse(depth), np.float32(1 - share)
    highest, lowest = np.nan_to_num(w, nan=0.0), np.nan_to_num(w, nan=np.inf)
    with np.errstate(invalid="ignore"):
        before, behind = (
            w * left > cv2.erode(lowest, depth_steps.CROSS),
            cv2.dilate(highest, depth_steps.CROSS) * left > w,
        )
        highest = cv2.dilate(np.where(before, w, np.float32(0)), _disc(outer))
        lowest = cv2.erode(np.where(behind, w, np.float32(np.inf)), _disc(inner))
        lost = (highest * left > w) | (w * left > lowest)
    return np.where(lost, np.float32(np.nan), depth)


def ring_around(depth: np.ndarray, mask: np.ndarray, outer: int) -> np.ndarray:
    """Without the readings within ``outer`` pixels of a mask, bool (height, width), but with those in it."""
    near = cv2.dilate(mask.astype(np.uint8), _disc(outer)) > 0
    return np.where(near & ~mask, np.float32(np.nan), depth)


def fill(depth: np.ndarray, rule: Filling) -> np.ndarray:
    """Missing readings filled from the neighbours that ``rule`` says; see the module."""
    out = depth.copy()
    _fill(out, get_args(Filling).index(rule))
    return out


def align(depth: np.ndarray, camera: Camera, beside: np.ndarray, onto: Camera, whole: bool) -> np.ndarray:
    """The depth that a camera ``onto`` has of one that ``camera`` measured at ``beside`` (3,) in its frame, metres,
    looking in parallel; drawn as rectangles, ``whole``, or as points, which leave gaps in finer images."""
    out = np.full((onto.height, onto.width), np.float32(np.inf))
    _draw(depth, camera.lens, np.asarray(beside, dtype=float), out, onto.lens, 0.5 if whole else 0.0)
    out[np.isinf(out)] = np.nan
    return out


def bend(depth: np.ndarray, camera: Camera, at: np.ndarray, slope: np.ndarray, bow: float) -> np.ndarray:
    """Bent by ``slope`` k (2,) and ``bow`` q about the ray ``at`` x0 (2,); see the module."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx - at[0]
    y = ((np.arange(camera.height) - camera.cy) / camera.fy - at[1])[:, None]
    return np.asarray(depth * (1 + slope[0] * x + slope[1] * y + bow * (x * x + y * y)), dtype=np.float32)


def median(depth: np.ndarray, side: Literal[3, 5]) -> np.ndarray:
    """The median over ``side`` x ``side`` pixels."""
    return _known(cv2.medianBlur(np.nan_to_num(depth, nan=0.0).astype(np.float32), side))


def round_depth(depth: np.ndarray, step: float) -> np.ndarray:
    """Depths in whole steps, metres."""
    return _known(np.rint(depth / np.float32(step)) * np.float32(step))


def blocks(depth: np.ndarray, quantum: float) -> np.ndarray:
    """The depth after a lossy compression whose blocks' means have this ``quantum``, per metre, and waves about (1 + i
    + j) of it, as in JPEG.  Missing readings are 0 in the image, and known as a mask goes with it."""
    side = 8  # side of JPEG's blocks, pixels
    height, width = depth.shape
    w = np.nan_to_num(_inverse(depth), nan=0.0)
    w = np.pad(w, ((0, -height % side), (0, -width % side)), mode="edge")
    steps = np.float32(quantum * side) * (1 + np.add(*np.indices((side, side), np.float32)))
    for top in range(0, height, side):
        for left in range(0, width, side):
            block = np.s_[top : top + side, left : left + side]
            w[block] = cv2.idct(np.rint(cv2.dct(w[block]) / steps) * steps)
    w = np.where(w < quantum, np.float32(np.nan), w)[:height, :width]
    return np.where(np.isnan(depth), np.float32(np.nan), _inverse(w))


@dataclass(frozen=True)
class Stages:
    """What one camera does after its sensor; 0 or None for what it does not.  Thresholds and quanta are per metre."""

    frames: int = 1
    decimation: int = 1
    factor: float = 1.0
    threshold: float = 0.0
    rounds: int = 0
    outer: int = 0
    inner: int = 0
    edge: float = 0.0
    foot: bool = False
    filling: Filling | None = None
    beside: float = 0.0
    """x of the sensor in the frame of the camera that its image is aligned to, metres; ``focal`` its focal length over
    that of this camera; whether ``whole`` pixels are drawn, or points."""
    focal: float = 1.0
    whole: bool = False
    slope: tuple[float, float] = (0.0, 0.0)
    bow: float = 0.0
    median: Literal[0, 3, 5] = 0
    step: float = 0.0
    quantum: float = 0.0

    def process(self, depth: np.ndarray, thing: np.ndarray, camera: Camera) -> np.ndarray:
        """The depth after all stages that keep its camera; ``thing`` bool (height, width) is what a ring goes around,
        and the middle of what is bent."""
        if self.outer:
            depth = ring_around(depth, thing, self.outer) if self.foot else depth
            depth = ring(depth, self.outer, self.inner, self.edge)
        if self.rounds:
            depth = spatial(depth, self.factor, self.threshold, self.rounds)
        if self.filling is not None:
            depth = fill(depth, self.filling)
        if self.bow or any(self.slope):
            rows, columns = np.nonzero(thing)
            middle = (columns.mean() - camera.cx) / camera.fx, (rows.mean() - camera.cy) / camera.fy
            depth = bend(depth, camera, np.array(middle), np.array(self.slope), self.bow)
        if self.median:
            depth = median(depth, self.median)
        if self.quantum:
            depth = blocks(depth, self.quantum)
        return round_depth(depth, self.step) if self.step else depth


def draw_stages(rng: np.random.Generator, ranges: StageRanges = RANGES) -> Stages:
    """The stages of a random camera: each there or not, alone or with others."""

    def whether(share: float) -> bool:
        return bool(rng.random() < share)

    steps = rng.uniform(*ranges.threshold) / 32 / rng.uniform(*ranges.disparity)
    has_ring, is_bent = whether(ranges.ring), whether(ranges.bend)
    return Stages(
        frames=int(rng.integers(*ranges.frames, endpoint=True)) if whether(ranges.temporal) else 1,
        decimation=2 if whether(ranges.decimation) else 1, factor=rng.uniform(*ranges.factor), threshold=steps,
        rounds=int(rng.integers(*ranges.rounds, endpoint=True)) if whether(ranges.spatial) else 0,
        outer=int(rng.integers(*ranges.outer, endpoint=True)) if has_ring else 0,
        inner=int(rng.integers(*ranges.inner, endpoint=True)) if has_ring and whether(ranges.both_sides) else 0,
        edge=rng.uniform(*ranges.edge), foot=whether(ranges.foot),
        filling=get_args(Filling)[rng.integers(3)] if whether(ranges.filling) else None,
        beside=rng.choice((-1, 1)) * rng.uniform(*ranges.baseline) if whether(ranges.alignment) else 0.0,
        focal=rng.uniform(*ranges.focal), whole=whether(0.5),
        slope=(rng.uniform(-1, 1) * ranges.slope, rng.uniform(-1, 1) * ranges.slope) if is_bent else (0.0, 0.0),
        bow=rng.uniform(-1, 1) * ranges.slope if is_bent else 0.0,
        median=(3, 5)[rng.integers(2)] if whether(ranges.median) else 0,
        step=float(rng.choice(ranges.steps)) if whether(ranges.rounding) else 0.0,
        quantum=float(np.exp(rng.uniform(*np.log(ranges.quality)))) if whether(ranges.blocks) else 0.0,
    )


def _inverse(depth: np.ndarray) -> np.ndarray:
    """1 / z of z, and back."""
    return np.ascontiguousarray(1 / depth, dtype=np.float32)


def _known(depth: np.ndarray) -> np.ndarray:
    """Depth in which 0 is a missing reading."""
    return np.where(depth > 0, depth, np.float32(np.nan)).astype(np.float32)


def _disc(pixels: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))


@kernel
def _smooth_rows(w: np.ndarray, factor: float, threshold: float) -> None:
    """The recursion along each row, from the left and then from the right."""
    height, width = w.shape
    for v in range(height):
        for u in range(1, width):
            if abs(w[v, u] - w[v, u - 1]) < threshold:
                w[v, u] = factor * w[v, u] + (1 - factor) * w[v, u - 1]
        for u in range(width - 2, -1, -1):
            if abs(w[v, u] - w[v, u + 1]) < threshold:
                w[v, u] = factor * w[v, u] + (1 - factor) * w[v, u + 1]


@kernel
def _fill(depth: np.ndarray, rule: int) -> None:
    """Fill by the rule of this number among those of :data:`Filling`."""
    height, width = depth.shape
    for v in range(height):
        for u in range(1, width):
            if np.isfinite(depth[v, u]):
                continue
            chosen = depth[v, u - 1]
            if rule > 0:
                for i, j in ((-1, 0), (-1, -1), (1, -1), (1, 0)):
                    if 0 <= v + i < height:
                        z = depth[v + i, u + j]
                        if np.isnan(chosen) or (rule == 1 and z > chosen) or (rule == 2 and z < chosen):
                            chosen = z
            depth[v, u] = chosen


@kernel
def _draw(
    depth: np.ndarray, lens: tuple[float, float, float, float, bool], beside: np.ndarray, out: np.ndarray,
    onto: tuple[float, float, float, float, bool], half: float,
) -> None:
    """Draw readings into another camera's image of +inf, each as wide as twice ``half`` pixels; see :func:`align`."""
    fx, fy, cx, cy, _ = lens
    gx, gy, ox, oy, _ = onto
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            ahead = z + beside[2]
            if not (np.isfinite(z) and ahead > 0):
                continue
            left = gx * ((u - half - cx) / fx * z + beside[0]) / ahead + ox
            right = gx * ((u + half - cx) / fx * z + beside[0]) / ahead + ox
            top = gy * ((v - half - cy) / fy * z + beside[1]) / ahead + oy
            bottom = gy * ((v + half - cy) / fy * z + beside[1]) / ahead + oy
            if half == 0:  # the pixel that the point is in
                left, top = np.floor(left + 0.5), np.floor(top + 0.5)
                right, bottom = left + 1, top + 1
            for i in range(max(int(np.ceil(top)), 0), min(int(np.ceil(bottom)), out.shape[0])):
                for j in range(max(int(np.ceil(left)), 0), min(int(np.ceil(right)), out.shape[1])):
                    out[i, j] = min(out[i, j], ahead)
