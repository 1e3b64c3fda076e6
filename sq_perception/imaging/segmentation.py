"""Objects on a table: the support plane away, what stands on it taken apart.

Equation
--------
The support plane is n.p + d = 0 with |n| = 1 in the optical frame and n towards the camera, so that the height of a
point above the table is

    h(p) = n.p + d  =  z (n_x (u - cx)/fx + n_y (v - cy)/fy + n_z) + d        for a pinhole camera,

one multiplication per pixel.  Depth noise of triangulating and time-of-flight cameras grows about as z^2; tolerances
are therefore sigma(z) = sigma_1 z^2 with sigma_1 measured on the plane itself.

Steps: planes by RANSAC on a seeded subsample and least squares on the inliers; the support plane is the one with many
points that lies low in the image; pixels clearly above it, separated where the depth jumps, are the objects; each grows
back down to the edge of the noise.  An orthographic camera sees the thesis' world: there is no plane, and every
connected set of pixels is an object.

Metres and pixels.  Reference: M. A. Fischler, R. C. Bolles, Random Sample Consensus, Comm. ACM 24 (1981).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.imaging.camera import Camera

_PLANE_POINTS = 1500
_REFINE_POINTS = 8000
_HYPOTHESES = 200
_PLANES = 3
_FOOT_PIXELS = 3
_COARSE_PIXELS = 120
_FACE_TOLERANCE = 0.008
_BENT_SHARE = 0.08
_ISLAND_SHARE = 0.25

_Surface = tuple[np.ndarray, bool]


@dataclass(frozen=True)
class SegmentationOptions:
    """What counts as an object.

    Attributes
    ----------
    depth_range
        Nearest and farthest depth that is looked at, metres.
    max_objects
        The largest ones are kept.
    min_pixels
        Smaller components are dropped; None: 0.05 % of the image, at least 30.
    min_height
        An object reaches at least this far above the plane, metres.
    depth_step
        Neighbouring pixels whose depths differ by more than this share of the depth belong to different objects.
    plane_tolerance
        Half thickness of a plane while it is searched, metres at a depth of one metre.
    min_plane_share
        Share of the valid pixels that a support plane has at least.
    seed
        Of the random sample; the same image gives the same result.
    """

    depth_range: tuple[float, float] = (0.0, np.inf)
    max_objects: int = 20
    min_pixels: int | None = None
    min_height: float = 0.012
    depth_step: float = 0.015
    plane_tolerance: float = 0.008
    min_plane_share: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        near, far = self.depth_range
        if not (0 <= near < far):
            raise ValueError(f"depth_range: expected 0 <= nearest < farthest, got {self.depth_range}")
        if self.max_objects < 1:
            raise ValueError(f"max_objects: expected at least 1, got {self.max_objects}")
        for name in ("min_height", "depth_step", "plane_tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Objects of one image.

    Attributes
    ----------
    labels : int32 (height, width)
        0 for background; own labels run from 1, largest object first, labels given from outside keep their values.
    plane : (4,) or None
        n and d of the support plane, height above it = n.p + d; None where there is none.
    ids : tuple of int
        Labels in the image, the one with most pixels first.
    """

    labels: np.ndarray
    plane: np.ndarray | None
    ids: tuple[int, ...]


def segment(depth: np.ndarray, camera: Camera, options: SegmentationOptions | None = None) -> Segmentation:
    """Find the objects in a depth image.

    Parameters
    ----------
    depth : float (height, width)
        Metres in the optical frame, not finite where nothing was measured.
    camera : Camera

    Returns
    -------
    Segmentation
        Without objects for an empty table, a wall, or an image without depth.

    Raises
    ------
    ValueError
        If the image does not fit the camera.
    """
    options = options or SegmentationOptions()
    depth, valid = _checked(depth, camera, options.depth_range)
    least = _least_pixels(options, depth)
    if not camera.is_pinhole:
        labels, ids = _ordered(_components(valid), least, options.max_objects)
        return Segmentation(labels, None, ids)
    if np.count_nonzero(valid) < least:
        return Segmentation(np.zeros(depth.shape, np.int32), None, ())
    planes = _planes(depth, valid, camera, options)
    support = _support_plane(planes, _on_one_surface(depth, valid, camera, options))
    if support is None:
        labels, ids = _ordered(_separated(depth, valid, options), least, options.max_objects)
        return Segmentation(labels, None, ids)
    labels = _above(depth, valid, camera, support, options)
    walls = [plane for plane in planes if plane is not support]
    labels, ids = _ordered(labels, least, options.max_objects, _object_test(depth, camera, support, walls, options))
    return Segmentation(labels, support.equation, ids)


def from_labels(
    labels: np.ndarray, depth: np.ndarray, camera: Camera, options: SegmentationOptions | None = None
) -> Segmentation:
    """Objects given from outside as a label image; the support plane comes from the pixels around them.

    Parameters
    ----------
    labels : integer (height, width)
        0 (and anything negative) is background; other values are kept as they are.
    depth, camera
        As in :func:`segment`.

    Returns
    -------
    Segmentation
        Labels without a valid depth pixel, or with fewer than ``min_pixels`` where that is given, are left out.

    Raises
    ------
    ValueError
        If either image does not fit the camera, or labels are no integers.
    """
    options = options or SegmentationOptions()
    labels = np.asarray(labels)
    if labels.dtype.kind not in "iub":
        raise ValueError(f"labels: expected an integer image, got {labels.dtype}")
    if labels.ndim != 2:
        raise ValueError(f"labels: expected shape (height, width), got {labels.shape}")
    camera.check_image(labels)
    depth, valid = _checked(depth, camera, options.depth_range)
    labels = np.maximum(labels, 0).astype(np.int32)
    values, counts = np.unique(labels[valid], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    least = options.min_pixels or 1
    ids = tuple(int(values[k]) for k in order if values[k] > 0 and counts[k] >= least)[: options.max_objects]
    plane = None
    if ids and camera.is_pinhole:
        plane = _plane_around(labels, ids, depth, valid, camera, options)
    return Segmentation(labels, plane, ids)


@dataclass(frozen=True, eq=False)
class _Plane:
    equation: np.ndarray
    share: float
    sigma: float
    """Of the inliers' heights at a depth of one metre, metres."""


def _checked(depth: np.ndarray, camera: Camera, limits: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    depth = np.asarray(depth)
    if depth.ndim != 2 or depth.dtype.kind != "f":
        raise ValueError(f"depth: expected a float image (height, width), got {depth.dtype} {depth.shape}")
    camera.check_image(depth)
    depth = depth.astype(np.float32, copy=False)
    valid = np.isfinite(depth) & (depth >= limits[0]) & (depth <= limits[1])
    if camera.is_pinhole:
        valid &= depth > 0
    return depth, valid


def _least_pixels(options: SegmentationOptions, depth: np.ndarray) -> int:
    if options.min_pixels is not None:
        return max(1, options.min_pixels)
    return max(30, round(5e-4 * depth.size))


def _noise(z: np.ndarray) -> np.ndarray:
    """Growth of the depth noise, 1 at one metre; not below what near objects' own quantisation needs."""
    return np.maximum(z * z, 0.1)


# The plane


def _planes(depth: np.ndarray, valid: np.ndarray, camera: Camera, options: SegmentationOptions) -> list[_Plane]:
    """Up to three planes, the one with most points first; each is taken away before the next is searched."""
    pixels = np.flatnonzero(valid)
    rows, columns = np.divmod(pixels[:: max(1, pixels.size // _REFINE_POINTS)], camera.width)
    points = camera.unproject(columns, rows, depth[rows, columns])
    rng = np.random.default_rng(options.seed)
    total, found = len(points), []
    for _ in range(_PLANES):
        if len(points) < max(12, options.min_plane_share * total):
            break
        plane, inside = _dominant_plane(points, options.plane_tolerance, rng)
        if plane is None or inside.sum() < options.min_plane_share * total:
            break
        near = points[inside]
        spread = np.abs(near @ plane[:3] + plane[3]) / _noise(near[:, 2])
        found.append(_Plane(plane, float(inside.sum() / total), float(1.4826 * np.median(spread))))
        points = points[~inside]
    return found


def _dominant_plane(
    points: np.ndarray, tolerance: float, rng: np.random.Generator
) -> tuple[np.ndarray | None, np.ndarray]:
    """The plane (4,) with most points within tolerance * z^2, and which points these are."""
    few = points[:: max(1, len(points) // _PLANE_POINTS)]
    corners = few[rng.integers(len(few), size=(_HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1e-9
    if not usable.any():
        return None, np.zeros(len(points), bool)
    normals = normals[usable] / length[usable, None]
    offsets = -np.einsum("ij,ij->i", normals, corners[usable, 0])
    weight = (1 / (tolerance * _noise(few[:, 2]))).astype(np.float32)
    weighted = np.concatenate([few, np.ones((len(few), 1))], axis=1).astype(np.float32) * weight[:, None]
    heights = np.column_stack([normals, offsets]).astype(np.float32) @ weighted.T
    votes = np.count_nonzero(np.abs(heights) < 1, axis=1)
    best = int(np.argmax(votes))
    plane = np.append(normals[best], offsets[best])
    reach = tolerance * _noise(points[:, 2])
    for share in (1.0, 1.0, 0.5):
        inside = np.abs(points @ plane[:3] + plane[3]) < share * reach
        if inside.sum() < 12:
            return None, inside
        near = points[inside]
        plane = _least_squares_plane(near, 1 / _noise(near[:, 2]) ** 2)
    return plane, np.abs(points @ plane[:3] + plane[3]) < reach


def _least_squares_plane(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The plane (4,) through weighted points, normal towards the camera."""
    middle = weights @ points / weights.sum()
    centred = points - middle
    _, axes = np.linalg.eigh((weights[:, None] * centred).T @ centred)
    normal = axes[:, 0]
    offset = -normal @ middle
    return np.append(normal, offset) * (1.0 if offset > 0 else -1.0)


def _support_plane(planes: list[_Plane], surfaces: list[_Surface]) -> _Plane | None:
    """The plane that things stand on: many points, and rather below the camera than in front of it or above it.

    A camera is mounted upright or looks straight down.  The table seen from straight above and a wall look alike; a
    wall counts less, as a floor or a table in the same picture then has a normal that points up.
    """
    candidates = [plane for plane in planes if not _is_face(plane, surfaces)]
    return max(candidates, key=_support_vote) if candidates else None


def _is_face(plane: _Plane, surfaces: list[_Surface]) -> bool:
    """Whether a plane is part of a body or of a room: a surface joined to it runs on below, away from the camera.

    On recorded tables and floors up to 4 % of the points lie below, on the faces of lone bodies more than 10 %.  A
    small island before nothing is a body as well, seen face-on.
    """
    on, below, alone = 0, 0, False
    for points, is_island in surfaces:
        height = (points @ plane.equation[:3] + plane.equation[3]) / (_FACE_TOLERANCE * _noise(points[:, 2]))
        inside = int(np.count_nonzero(np.abs(height) < 1))
        if inside > on:
            on = inside
            below, alone = int(np.count_nonzero(height < -2)), is_island
    return alone or below > _BENT_SHARE * on


def _on_one_surface(
    depth: np.ndarray, valid: np.ndarray, camera: Camera, options: SegmentationOptions
) -> list[_Surface]:
    """Each connected surface of a coarse image, as far as it is of any size, and whether it is a small island."""
    k = max(1, min(depth.shape) // _COARSE_PIXELS)
    coarse, kept = depth[::k, ::k], valid[::k, ::k]
    labels = _components(kept & ~_jumps(np.where(kept, coarse, np.float32(0)), kept, k * options.depth_step))
    rows, columns = np.nonzero(labels)
    numbers = labels[rows, columns]
    points = camera.unproject(k * columns, k * rows, coarse[rows, columns])
    surfaces = []
    for label in np.flatnonzero(np.bincount(numbers) > 0.02 * rows.size):
        part = numbers == label
        r, c = rows[part], columns[part]
        inside = min(r.min(), c.min(), labels.shape[0] - 1 - r.max(), labels.shape[1] - 1 - c.max()) > 0
        surfaces.append((points[part], bool(inside and r.size < _ISLAND_SHARE * labels.size)))
    return surfaces


def _support_vote(plane: _Plane) -> float:
    up = -plane.equation[1]
    return plane.share * (0.25 + max(0.0, up))


def _plane_around(
    labels: np.ndarray,
    ids: tuple[int, ...],
    depth: np.ndarray,
    valid: np.ndarray,
    camera: Camera,
    options: SegmentationOptions,
) -> np.ndarray | None:
    """The support plane from the unlabelled pixels near the bodies: below all of them, and touched."""
    near = np.zeros(labels.shape, bool)
    bodies = []
    for label in ids:
        rows, columns = np.nonzero((labels == label) & valid)
        margin = 10 + (int(rows.max() - rows.min()) + int(columns.max() - columns.min())) // 3
        top, left = max(rows.min() - margin, 0), max(columns.min() - margin, 0)
        near[top : rows.max() + margin + 1, left : columns.max() + margin + 1] = True
        step = max(1, rows.size // 500)
        rows, columns = rows[::step], columns[::step]
        bodies.append(camera.unproject(columns, rows, depth[rows, columns]))
    labelled = cv2.dilate((labels > 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    near &= valid & ~labelled
    if np.count_nonzero(near) < 30:
        return None
    best, best_vote = None, 0.0
    for plane in _planes(depth, near, camera, options):
        contact = []
        for points in bodies:
            heights = (points @ plane.equation[:3] + plane.equation[3]) / _noise(points[:, 2])
            lowest, middle = np.quantile(heights, (0.02, 0.5))
            # What a body lies behind is not what it stands on, but perhaps the front of its occluder.
            contact.append(np.exp(-np.abs(lowest) / (4 * options.plane_tolerance)) if middle > 0 else 0.0)
        vote = _support_vote(plane) * float(np.mean(contact))
        if vote > best_vote:
            best, best_vote = plane.equation, vote
    return best


# The objects on it


def _height(depth: np.ndarray, camera: Camera, plane: np.ndarray) -> np.ndarray:
    across = (plane[0] * (np.arange(camera.width) - camera.cx) / camera.fx + plane[2]).astype(np.float32)
    down = (plane[1] * (np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)
    height = across[None, :] + down[:, None]
    height *= depth
    height += np.float32(plane[3])
    return height


def _above(
    depth: np.ndarray, valid: np.ndarray, camera: Camera, plane: _Plane, options: SegmentationOptions
) -> np.ndarray:
    """Components (labels from 1, unordered) of what is above the plane."""
    labels = np.zeros(depth.shape, np.int32)
    known = np.where(valid, depth, np.float32(0))
    relative = _height(known, camera, plane.equation) / _noise(known)
    relative *= valid
    # Half of the tolerance band is a compromise: bent depth of real cameras stays below, thin objects stay above.
    clear = (cv2.blur(relative, (3, 3)) > max(0.5 * options.plane_tolerance, 4 * plane.sigma)) & valid
    left, top, width, height = cv2.boundingRect(clear.view(np.uint8))
    if width == 0:
        return labels
    top, left = max(top - _FOOT_PIXELS, 0), max(left - _FOOT_PIXELS, 0)
    window = slice(top, top + height + 2 * _FOOT_PIXELS), slice(left, left + width + 2 * _FOOT_PIXELS)
    known = known[window]
    inside = _separated(known, clear[window], options)
    foot = (relative[window] > max(0.25 * options.plane_tolerance, 2 * plane.sigma)) & (inside == 0)
    labels[window] = _grown(inside, foot, known, _FOOT_PIXELS, options.depth_step)
    return labels


def _separated(depth: np.ndarray, wanted: np.ndarray, options: SegmentationOptions) -> np.ndarray:
    """Components of the wanted pixels, cut where neighbouring depths jump; the cut pixels are given back."""
    filled = np.where(wanted, depth, np.float32(0))
    kept = wanted & ~_jumps(filled, wanted, options.depth_step)
    kept = cv2.morphologyEx(kept.astype(np.uint8), cv2.MORPH_OPEN, _CROSS)
    labels = _components(kept)
    return _grown(labels, wanted & (labels == 0), depth, 2, options.depth_step)


def _jumps(filled: np.ndarray, wanted: np.ndarray, step: float) -> np.ndarray:
    """Wanted pixels beside which another one is farther by more than a share of the depth; 0 is no depth."""
    farthest = cv2.dilate(filled, _CROSS, borderType=cv2.BORDER_REPLICATE)
    return wanted & (farthest - filled > step * filled)


def _components(mask: np.ndarray) -> np.ndarray:
    _, labels = cv2.connectedComponents(np.ascontiguousarray(mask, dtype=np.uint8), connectivity=4, ltype=cv2.CV_32S)
    return labels


def _grown(labels: np.ndarray, free: np.ndarray, depth: np.ndarray, rounds: int, step: float) -> np.ndarray:
    """Let labels grow into free pixels, by a pixel per round and not across a depth jump."""
    labels = labels.astype(np.int32)
    shifts = ((0, 1), (0, -1), (1, 0), (-1, 0))
    rows, columns = np.nonzero(free)
    for _ in range(rounds):
        if rows.size == 0:
            break
        chosen = np.zeros(rows.size, np.int32)
        here = depth[rows, columns]
        for down, right in shifts:
            r = np.clip(rows + down, 0, labels.shape[0] - 1)
            c = np.clip(columns + right, 0, labels.shape[1] - 1)
            neighbour = labels[r, c]
            fits = (chosen == 0) & (neighbour > 0) & (np.abs(depth[r, c] - here) <= step * here)
            chosen = np.where(fits, neighbour, chosen)
        labels[rows, columns] = chosen
        left = chosen == 0
        rows, columns = rows[left], columns[left]
    return labels


_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
_ObjectTest = Callable[[np.ndarray, np.ndarray], bool]


def _object_test(
    depth: np.ndarray, camera: Camera, support: _Plane, walls: list[_Plane], options: SegmentationOptions
) -> _ObjectTest:
    """Whether a component, given by its pixels, is an object on the table and not the room behind it."""
    last_row, last_column = camera.height - 1, camera.width - 1

    def is_object(rows: np.ndarray, columns: np.ndarray) -> bool:
        step = max(1, rows.size // 2000)
        points = camera.unproject(columns[::step], rows[::step], depth[rows[::step], columns[::step]])
        heights = points @ support.equation[:3] + support.equation[3]
        if np.quantile(heights, 0.95) < options.min_height:
            return False
        at_border = rows.min() == 0 or columns.min() == 0 or rows.max() == last_row or columns.max() == last_column
        if not at_border:
            return True
        reach = options.plane_tolerance * _noise(points[:, 2])
        on_wall = [np.mean(np.abs(points @ wall.equation[:3] + wall.equation[3]) < 2 * reach) for wall in walls]
        return not any(share > 0.5 for share in on_wall)

    return is_object


def _ordered(
    labels: np.ndarray, least: int, most: int, accept: _ObjectTest | None = None
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Components with at least ``least`` pixels, renumbered from 1 by falling size, at most ``most`` of them."""
    counts = np.bincount(labels.ravel())
    counts[0] = 0
    order = [int(k) for k in np.argsort(-counts, kind="stable") if counts[k] >= least]
    pixels = np.flatnonzero(labels)
    short = np.uint16 if len(counts) < 2**16 else np.int32  # 16 bit integers are sorted by radix, ten times as fast
    pixels = pixels[np.argsort(labels.ravel()[pixels].astype(short), kind="stable")]
    ends = np.cumsum(counts)
    number = np.zeros(len(counts), np.int32)
    kept = 0
    for label in order:
        if kept == most:
            break
        rows, columns = np.divmod(pixels[ends[label] - counts[label] : ends[label]], labels.shape[1])
        if accept is None or accept(rows, columns):
            kept += 1
            number[label] = kept
    return number[labels], tuple(range(1, kept + 1))
