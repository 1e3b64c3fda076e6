"""The canonical view: what the network sees of one object, and the way back.

Equation
--------
The view is the thesis' world (:mod:`sq_perception.imaging.unit_cube`) fitted to one object: orthographic, unit cube,
x right, y up, z towards the viewer, pixel (row i, column j) of an n x n image at

    x = (j + 1/2) / n,   y = 1 - (i + 1/2) / n,   value = z in (0, 1],   0 for background.

It follows from the optical frame by

    p_canonical = R (p_optical - anchor) / extent + (1/2, 1/2, z0)

with R = diag(1, -1, -1) R_look, where R_look turns the ray to the object's middle into the z axis (identity for an
orthographic camera), the anchor at the silhouette's middle and the depth of the nearest point, z0 = (1 + 1/margin)/2,
and the extent such that silhouette and visible depth fill 1/margin of the cube.  Both directions are exact; a
superquadric stays one, since the map is a similarity.

What the network must learn shrinks: position, size and (for a pinhole camera) perspective are divided out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.kernels import gauge_derivatives, parallel_kernel, ray_entry
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera

MARGIN = 1.06
"""Side of the cube over the side of what is seen in it."""

_NEAREST = 0.5 * (1 + 1 / MARGIN)
_OUTLIERS_PER_END = 1 / 500
_NOTHING = -1e300
_FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class CanonicalView:
    """The image of one object in its own unit cube.

    Attributes
    ----------
    image : float32 (n, n)
        z of the visible surface, 0 for background.
    rotation : (4,)
        Quaternion, optical frame to canonical frame.
    anchor : (3,)
        The optical frame's point that lands at (1/2, 1/2, z0), metres.
    extent : float
        Side of the cube, metres.
    """

    image: np.ndarray
    rotation: np.ndarray
    anchor: np.ndarray
    extent: float

    def to_canonical(self, body: Superquadric) -> Superquadric:
        """A NumPy body of the optical frame in the canonical frame."""
        rotated = quaternions.to_matrix(self.rotation) @ self.anchor
        shift = np.array([0.5, 0.5, _NEAREST]) - rotated / self.extent
        return body.transformed(self.rotation, shift, 1 / self.extent)

    def from_canonical(self, body: Superquadric) -> Superquadric:
        """A NumPy body of the canonical frame in the optical frame."""
        inverse = quaternions.conjugate(self.rotation)
        middle = quaternions.to_matrix(inverse) @ np.array([0.5, 0.5, _NEAREST])
        return body.transformed(inverse, self.anchor - middle * self.extent, self.extent)


def from_mask(depth: np.ndarray, mask: np.ndarray, camera: Camera, pixels: int = 64) -> CanonicalView:
    """The canonical view of the object under a mask.

    Parameters
    ----------
    depth : float (height, width)
        Metres, NaN where nothing was measured.
    mask : bool (height, width)
    camera : Camera
    pixels : int
        Side n of the view.

    Raises
    ------
    ValueError
        If the images do not fit the camera, or no pixel of the mask has a depth.
    """
    camera.check_image(depth)
    camera.check_image(mask)
    left, top, width, height = cv2.boundingRect((mask & np.isfinite(depth)).view(np.uint8))
    if width == 0:
        raise ValueError("a canonical view needs at least one pixel with a depth under the mask")
    camera = camera.cropped(left, top, width, height)
    window = np.s_[top : top + height, left : left + width]
    seen = mask[window] & np.isfinite(depth[window])
    rows, columns = np.nonzero(seen)
    measured = depth[window][seen].astype(np.float32)

    look = np.eye(3)
    if camera.is_pinhole:
        _, toward = camera.rays(0.5 * (width - 1), 0.5 * (height - 1))
        look = _rotation_to_z(toward / np.linalg.norm(toward))
    matrix = _FLIP @ look
    x, y, z = matrix.astype(np.float32) @ _coordinates(camera, columns, rows, measured)
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    outliers = int(z.size * _OUTLIERS_PER_END)
    ordered = np.partition(z, [outliers, z.size // 2, z.size - 1 - outliers])
    farthest, middle, nearest = (float(ordered[k]) for k in (outliers, z.size // 2, z.size - 1 - outliers))
    pixel = max(1 / camera.fx, 1 / camera.fy) * (measured.min() if camera.is_pinhole else 1.0)
    extent = MARGIN * max(*(high - low + pixel), nearest - farthest)
    anchor = np.array([*(0.5 * (low + high)), nearest])

    image = np.full((camera.height, camera.width), np.nan, dtype=np.float32)
    image[seen] = z
    z_view = _resample(image, middle, matrix, anchor, extent, camera, pixels)
    value = (z_view - anchor[2]) / extent + _NEAREST
    value = np.where(np.isfinite(value), np.clip(value, 1 / 255, 1.0), 0.0).astype(np.float32)
    return CanonicalView(value, quaternions.from_matrix(matrix), matrix.T @ anchor, float(extent))


def _coordinates(camera: Camera, u: np.ndarray, v: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Points of pixels as (3, n): one contiguous row a coordinate, several times as fast to turn as (n, 3)."""
    points = np.empty((3, depth.size), dtype=np.float32)
    points[0] = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)[u]
    points[1] = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)[v]
    points[2] = depth
    if camera.is_pinhole:
        points[:2] *= depth
    return points


def _resample(
    z_image: np.ndarray,
    z_guess: float,
    matrix: np.ndarray,
    anchor: np.ndarray,
    extent: float,
    camera: Camera,
    pixels: int,
) -> np.ndarray:
    """Turned z of what each pixel of the view sees, NaN where that is nothing.

    A view pixel fixes turned x and y but not z, and a pinhole pixel depends on all three.  Reading z at the projection
    of the last guess is a contraction wherever the surface is not almost parallel to the ray; three rounds suffice.
    Guesses that fall beside the object go on with the z of its nearest pixel.
    """
    steps = ((np.arange(pixels) + 0.5) / pixels - 0.5) * extent
    x, y = np.meshgrid(anchor[0] + steps, anchor[1] - steps)
    z = np.full((pixels, pixels), z_guess)
    if camera.is_pinhole:
        filled = _filled(z_image)
        for _ in range(3):
            z = _read(filled, np.stack([x, y, z], axis=-1) @ matrix, camera, cv2.BORDER_REPLICATE)
    return _read(z_image, np.stack([x, y, z], axis=-1) @ matrix, camera, cv2.BORDER_CONSTANT)


def _read(image: np.ndarray, points: np.ndarray, camera: Camera, border: int) -> np.ndarray:
    """The image at the projections of points (n, n, 3); NaN beyond a constant border."""
    uv = camera.project(points).astype(np.float32)
    return cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_NEAREST, borderMode=border, borderValue=float("nan"))


def _filled(image: np.ndarray) -> np.ndarray:
    """The image with each NaN replaced by the nearest number."""
    empty = np.isnan(image).astype(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    known = image[empty == 0]
    by_label = np.zeros(nearest.max() + 1, dtype=np.float32)
    by_label[nearest[empty == 0]] = known
    return by_label[nearest]


def _rotation_to_z(direction: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that turns a unit direction with positive z into the z axis."""
    x, y, z = direction
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def render_views(
    bodies: Superquadric, pixels: int = 64, levels: np.ndarray | None = None, distance: np.ndarray | None = None
) -> tuple[np.ndarray, Superquadric]:
    """Canonical views of whole, unoccluded bodies, without the detour over an image: the source of training data.

    A canonical view is orthographic whatever camera took the image, but a pinhole camera sees less of the body: of a
    convex body just the points whose normals point to it.  Rays along z, less what faces away from the eye, are so the
    view of an image with any number of pixels.

    Parameters
    ----------
    bodies : Superquadric
        NumPy batch (n,), in a frame like the cube's: y up, z towards the viewer.
    pixels : int
        Side of the views.
    levels : (n,), optional
        Grey levels per unit of the bodies' frame: depths are rounded down to them, as in an image of integers.
    distance : (n,), optional
        Distance of a pinhole camera from the nearest face of the body's box, in the bodies' unit; infinite, as by
        default, for an orthographic camera.

    Returns
    -------
    images : float32 (n, pixels, pixels)
    bodies : Superquadric
        The batch in the canonical frame of its views.
    """
    lower, upper = bodies.bounding_box()
    side = MARGIN * (upper - lower)[:, :2].max(axis=1)
    anchor = np.stack([0.5 * (lower[:, 0] + upper[:, 0]), 0.5 * (lower[:, 1] + upper[:, 1]), upper[:, 2]], axis=-1)
    flat = np.ascontiguousarray(bodies.to_flat(), dtype=float)
    matrices = np.ascontiguousarray(bodies.rotation_matrix, dtype=float)
    images = np.zeros((len(bodies), pixels, pixels), dtype=np.float32)
    steps = np.zeros(len(bodies)) if levels is None else 1 / np.asarray(levels, dtype=float)
    away = np.full(len(bodies), np.inf) if distance is None else np.asarray(distance, dtype=float)
    if (away <= 0).any():
        raise ValueError("distance: expected positive distances of the camera")
    pinhole = np.isfinite(away)
    eye = upper[:, 2] + np.where(pinhole, away, 0.0)
    _render_views(flat, matrices, anchor, side, steps, pinhole, eye, images)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    shift = np.array([0.5, 0.5, _NEAREST]) - anchor / side[:, None]
    return images, bodies.transformed(identity, shift, 1 / side[:, None])


_MOST_ROUNDS = 4
_SAME_EXTENT = 0.005


@parallel_kernel
def _render_views(
    flat: np.ndarray,
    matrices: np.ndarray,
    anchor: np.ndarray,
    side: np.ndarray,
    quantum: np.ndarray,
    pinhole: np.ndarray,
    eye: np.ndarray,
    images: np.ndarray,
) -> None:
    """Render, read off what is visible, and render again until the extent is that of the visible part."""
    pixels = images.shape[1]
    for k in numba.prange(flat.shape[0]):
        a1, a2, a3, e1, e2, t1, t2, t3 = flat[k, :8]
        m = matrices[k]
        eye_1, eye_2, eye_3 = m[2, 0] * (eye[k] - t3), m[2, 1] * (eye[k] - t3), m[2, 2] * (eye[k] - t3)
        surface = np.empty((pixels, pixels))
        for _ in range(_MOST_ROUNDS):
            hits = 0
            seen = np.empty(pixels * pixels)
            first_row, last_row, first_column, last_column = pixels, -1, pixels, -1
            for i in range(pixels):
                for j in range(pixels):
                    x = anchor[k, 0] + ((j + 0.5) / pixels - 0.5) * side[k] - t1
                    y = anchor[k, 1] - ((i + 0.5) / pixels - 0.5) * side[k] - t2
                    ox, oy, oz = m[0, 0] * x + m[1, 0] * y, m[0, 1] * x + m[1, 1] * y, m[0, 2] * x + m[1, 2] * y
                    hit, t = ray_entry(ox, oy, oz, -m[2, 0], -m[2, 1], -m[2, 2], a1, a2, a3, e1, e2)
                    surface[i, j] = _NOTHING
                    if hit and pinhole[k]:
                        px, py, pz = ox - t * m[2, 0], oy - t * m[2, 1], oz - t * m[2, 2]
                        _, nx, ny, nz, _, _ = gauge_derivatives(px, py, pz, a1, a2, a3, e1, e2)
                        hit = nx * (eye_1 - px) + ny * (eye_2 - py) + nz * (eye_3 - pz) > 0.0
                    if hit:
                        z = t3 - t
                        if quantum[k] > 0.0:
                            z = (np.floor(z / quantum[k]) + 0.5) * quantum[k]
                        surface[i, j] = z
                        seen[hits] = z
                        hits += 1
                        first_row, last_row = min(first_row, i), max(last_row, i)
                        first_column, last_column = min(first_column, j), max(last_column, j)
            if hits == 0:
                break
            seen = np.sort(seen[:hits])
            outliers = int(hits * _OUTLIERS_PER_END)
            anchor[k, 2] = seen[hits - 1 - outliers]
            extent = seen[hits - 1 - outliers] - seen[outliers]
            if pinhole[k]:
                extent = max(extent, max(last_row - first_row, last_column - first_column) * side[k] / pixels)
            else:
                extent = max(extent, side[k] / MARGIN)
            if abs(extent * MARGIN - side[k]) <= (_SAME_EXTENT + 1.5 * pinhole[k] / pixels) * side[k]:
                break
            if pinhole[k]:
                anchor[k, 0] += (0.5 * (first_column + last_column + 1) / pixels - 0.5) * side[k]
                anchor[k, 1] -= (0.5 * (first_row + last_row + 1) / pixels - 0.5) * side[k]
            side[k] = extent * MARGIN
        for i in range(pixels):
            for j in range(pixels):
                if surface[i, j] > _NOTHING:
                    value = (surface[i, j] - anchor[k, 2]) / side[k] + _NEAREST
                    images[k, i, j] = min(max(value, 1 / 255), 1.0)
