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
from sq_perception.geometry.kernels import gauge_derivatives, kernel, parallel_kernel, ray_entry
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera

MARGIN = 1.06
"""Side of the cube over the side of what is seen in it."""

HIDDEN = -0.5
"""Value of a pixel at which the object may go on unseen, in views that tell this from background."""

_NEAREST = 0.5 * (1 + 1 / MARGIN)
_OUTLIERS_PER_END = 1 / 500
_SURROUNDINGS = 1.2
"""More than MARGIN: under perspective the view's edges are not where those of the silhouette's box are."""
_NEARER = 0.04
"""What stands nearer than the object by this share of the view's side hides what is behind it."""
_NOTHING = -1e300
_BEHIND = -2e300
_FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class CanonicalView:
    """The image of one object in its own unit cube.

    Attributes
    ----------
    image : float32 (n, n)
        z of the visible surface, 0 for background.
    hidden : bool (n, n)
        Background pixels at which the object may go on unseen: something nearer stands there, or nothing was measured
        within the object's convex hull.  All False where :func:`from_mask` was not asked for it.
    rotation : (4,)
        Quaternion, optical frame to canonical frame.
    anchor : (3,)
        The optical frame's point that lands at (1/2, 1/2, z0), metres.
    extent : float
        Side of the cube, metres.
    """

    image: np.ndarray
    hidden: np.ndarray
    rotation: np.ndarray
    anchor: np.ndarray
    extent: float

    @property
    def marked(self) -> np.ndarray:
        """The image with :data:`HIDDEN` at the hidden pixels: the input of networks that tell them from background."""
        return np.where(self.hidden, np.float32(HIDDEN), self.image)

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


def from_mask(
    depth: np.ndarray,
    mask: np.ndarray,
    camera: Camera,
    pixels: int = 64,
    *,
    find_hidden: bool = False,
    plane: np.ndarray | None = None,
) -> CanonicalView:
    """The canonical view of the object under a mask.

    Parameters
    ----------
    depth : float (height, width)
        Metres, NaN where nothing was measured.
    mask : bool (height, width)
    camera : Camera
    pixels : int
        Side n of the view.
    find_hidden : bool
        Whether to look at the object's surroundings for what may hide a part of it.
    plane : (4,), optional
        What the object stands on, n.p + d = 0: seen in front of the object it hides nothing.

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
    look = np.eye(3)
    if camera.is_pinhole:
        _, toward = camera.rays(left + 0.5 * (width - 1), top + 0.5 * (height - 1))
        look = _rotation_to_z(toward / np.linalg.norm(toward))
    if find_hidden:
        left, top, width, height = _with_surroundings(left, top, width, height, camera)
    camera = camera.cropped(left, top, width, height)
    window = np.s_[top : top + height, left : left + width]
    depth, mask = depth[window], mask[window]
    seen = mask & np.isfinite(depth)
    rows, columns = np.nonzero(seen)
    measured = depth[seen].astype(np.float32)

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
    filled = _filled(image) if camera.is_pinhole or find_hidden else None
    points = _looked_at(filled, middle, matrix, anchor, extent, camera, pixels)
    z_view = _read(image, points, camera, cv2.BORDER_CONSTANT)
    value = (z_view - anchor[2]) / extent + _NEAREST
    value = np.where(np.isfinite(value), np.clip(value, 1 / 255, 1.0), 0.0).astype(np.float32)
    hidden = np.zeros(value.shape, dtype=bool)
    if find_hidden:
        assert filled is not None
        covered = _covered(depth, mask, filled, camera, matrix, plane, _NEARER * extent)
        hidden = (_read(covered.astype(np.float32), points, camera, cv2.BORDER_CONSTANT) > 0) & (value == 0)
    return CanonicalView(value, hidden, quaternions.from_matrix(matrix), matrix.T @ anchor, float(extent))


def _with_surroundings(left: int, top: int, width: int, height: int, camera: Camera) -> tuple[int, int, int, int]:
    """The part of the image that a square view of a box of pixels shows."""
    side = _SURROUNDINGS * max(width, height)
    right, bottom = left + width, top + height
    beside, above = int(np.ceil(0.5 * (side - width))) + 1, int(np.ceil(0.5 * (side - height))) + 1
    left, top = max(0, left - beside), max(0, top - above)
    return left, top, min(camera.width, right + beside) - left, min(camera.height, bottom + above) - top


def _covered(
    depth: np.ndarray,
    mask: np.ndarray,
    filled: np.ndarray,
    camera: Camera,
    matrix: np.ndarray,
    plane: np.ndarray | None,
    tolerance: float,
) -> np.ndarray:
    """Pixels (height, width) of the surroundings where the object may go on unseen; see :class:`CanonicalView`."""
    measured = np.isfinite(depth)
    hull = np.zeros(mask.shape, dtype=np.uint8)
    outline, _ = cv2.findContours((mask & measured).view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outline)), 1)
    # The hull's own border passes outside of a convex set of pixels.
    inside = cv2.erode(hull, np.ones((3, 3), np.uint8)) > 0
    rows, columns = np.nonzero(measured & ~mask)
    points = _coordinates(camera, columns, rows, depth[rows, columns].astype(np.float32))
    nearer = matrix[2].astype(np.float32) @ points > filled[rows, columns] + tolerance
    if plane is not None:
        nearer &= np.abs(np.asarray(plane[:3], dtype=np.float32) @ points + np.float32(plane[3])) > tolerance
    covered = ~measured & inside
    covered[rows[nearer], columns[nearer]] = True
    return covered


def _coordinates(camera: Camera, u: np.ndarray, v: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Points of pixels as (3, n): one contiguous row a coordinate, several times as fast to turn as (n, 3)."""
    points = np.empty((3, depth.size), dtype=np.float32)
    points[0] = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)[u]
    points[1] = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)[v]
    points[2] = depth
    if camera.is_pinhole:
        points[:2] *= depth
    return points


def _looked_at(
    filled: np.ndarray | None,
    z_guess: float,
    matrix: np.ndarray,
    anchor: np.ndarray,
    extent: float,
    camera: Camera,
    pixels: int,
) -> np.ndarray:
    """The point (pixels, pixels, 3) of the optical frame that each pixel of the view looks at.

    A view pixel fixes turned x and y but not z, and a pinhole pixel depends on all three.  Reading z at the projection
    of the last guess is a contraction wherever the surface is not almost parallel to the ray; three rounds suffice.
    Guesses that fall beside the object go on with the z of its nearest pixel, which ``filled`` (turned z) holds.
    """
    steps = ((np.arange(pixels) + 0.5) / pixels - 0.5) * extent
    x, y = np.meshgrid(anchor[0] + steps, anchor[1] - steps)
    z = np.full((pixels, pixels), z_guess)
    if camera.is_pinhole:
        assert filled is not None
        for _ in range(3):
            z = _read(filled, np.stack([x, y, z], axis=-1) @ matrix, camera, cv2.BORDER_REPLICATE)
    return np.stack([x, y, z], axis=-1) @ matrix


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


@dataclass(frozen=True, eq=False)
class Occluder:
    """Something opaque before each body (n,): all that lies beyond a front that came in from one side.

    In the plane of the view, in units of its side and from its middle, (u, v) are coordinates along and across the
    direction the occluder comes from; hidden is

        c < u - bow |v - offset|^power < c + thickness,

    c such that ``share`` of the body's pixels lie beyond the front.  bow = 0 is a straight edge, power 1 a corner,
    power 2 a round thing.

    Attributes
    ----------
    direction : (n,)
        Angle of u, radians from the view's x axis.
    bow, offset, power, thickness : (n,)
    share : (n,)
        Of the body's own pixels, 0 to below 1; 0 is no occluder.
    """

    direction: np.ndarray
    bow: np.ndarray
    offset: np.ndarray
    power: np.ndarray
    thickness: np.ndarray
    share: np.ndarray


def render_views(
    bodies: Superquadric,
    pixels: int = 64,
    levels: np.ndarray | None = None,
    distance: np.ndarray | None = None,
    occluder: Occluder | None = None,
    miss: np.ndarray | None = None,
) -> tuple[np.ndarray, Superquadric]:
    """Canonical views of single bodies, without the detour over an image: the source of training data.

    A canonical view is orthographic whatever camera took the image, but a pinhole camera sees less of the body: of a
    convex body just the points whose normals point to it.  Rays along z, less what faces away from the eye, are so the
    view of an image with any number of pixels.  The view is fitted to what is visible, as :func:`from_mask` does it.

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
    occluder : Occluder, optional
        What stands before the bodies; its pixels are :data:`HIDDEN`.
    miss : (n, 4), optional
        How far the view's middle (x, y), nearest depth (z) and the logarithm of its side are off, the first three in
        sides: errors of a mask and of noisy depths.

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
    fronts = np.zeros((len(bodies), 6))
    if occluder is not None:
        if not ((occluder.share >= 0) & (occluder.share < 1)).all():
            raise ValueError("occluder: expected shares of at least 0 and below 1")
        columns = (occluder.direction, occluder.bow, occluder.offset, occluder.power, occluder.thickness)
        fronts[:] = np.stack([*columns, occluder.share], axis=-1)
    misses = np.zeros((len(bodies), 4)) if miss is None else np.array(miss, dtype=float)
    _render_views(flat, matrices, anchor, side, steps, pinhole, eye, fronts, misses, images)
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
    fronts: np.ndarray,
    misses: np.ndarray,
    images: np.ndarray,
) -> None:
    """Render, read off what is visible, and render again until the extent is that of the visible part."""
    pixels = images.shape[1]
    for k in numba.prange(flat.shape[0]):
        a1, a2, a3, e1, e2, t1, t2, t3 = flat[k, :8]
        m = matrices[k]
        eye_1, eye_2, eye_3 = m[2, 0] * (eye[k] - t3), m[2, 1] * (eye[k] - t3), m[2, 2] * (eye[k] - t3)
        middle_x, middle_y, unit = anchor[k, 0], anchor[k, 1], side[k]
        occluded = fronts[k, 5] > 0.0
        measured = pinhole[k] or occluded
        missed = misses[k, 0] != 0.0 or misses[k, 1] != 0.0 or misses[k, 2] != 0.0 or misses[k, 3] != 0.0
        front = np.inf
        surface = np.empty((pixels, pixels))
        seen = np.empty(pixels * pixels)
        reach = np.empty(pixels * pixels)
        last_round = _MOST_ROUNDS - 1
        for turn in range(_MOST_ROUNDS + 1):
            hits = 0
            first_row, last_row, first_column, last_column = pixels, -1, pixels, -1
            for i in range(pixels):
                for j in range(pixels):
                    x = anchor[k, 0] + ((j + 0.5) / pixels - 0.5) * side[k]
                    y = anchor[k, 1] - ((i + 0.5) / pixels - 0.5) * side[k]
                    if occluded:
                        distance = _front_distance((x - middle_x) / unit, (y - middle_y) / unit, fronts[k])
                        if front < distance < front + fronts[k, 4]:
                            surface[i, j] = _BEHIND
                            continue
                    x -= t1
                    y -= t2
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
                        if occluded:
                            reach[hits] = distance
                        hits += 1
                        first_row, last_row = min(first_row, i), max(last_row, i)
                        first_column, last_column = min(first_column, j), max(last_column, j)
            if hits == 0 or turn > last_round:
                break
            if occluded and turn == 0:
                front = np.sort(reach[:hits])[int((1.0 - fronts[k, 5]) * (hits - 1))]
                continue
            ordered = np.sort(seen[:hits])
            outliers = int(hits * _OUTLIERS_PER_END)
            anchor[k, 2] = ordered[hits - 1 - outliers]
            extent = ordered[hits - 1 - outliers] - ordered[outliers]
            if measured:
                extent = max(extent, max(last_row - first_row, last_column - first_column) * side[k] / pixels)
            else:
                extent = max(extent, side[k] / MARGIN)
            done = abs(extent * MARGIN - side[k]) <= (_SAME_EXTENT + 1.5 * measured / pixels) * side[k]
            if done and not missed:
                break
            if measured:
                anchor[k, 0] += (0.5 * (first_column + last_column + 1) / pixels - 0.5) * side[k]
                anchor[k, 1] -= (0.5 * (first_row + last_row + 1) / pixels - 0.5) * side[k]
            side[k] = extent * MARGIN
            if missed and (done or turn == last_round):
                for axis in range(3):
                    anchor[k, axis] += misses[k, axis] * side[k]
                side[k] *= np.exp(misses[k, 3])
                last_round = turn
        for i in range(pixels):
            for j in range(pixels):
                if surface[i, j] > _NOTHING:
                    value = (surface[i, j] - anchor[k, 2]) / side[k] + _NEAREST
                    images[k, i, j] = min(max(value, 1 / 255), 1.0)
                elif surface[i, j] == _BEHIND:
                    images[k, i, j] = HIDDEN


@kernel
def _front_distance(x: float, y: float, front: np.ndarray) -> float:
    """How far a point of the view lies in the direction of an occluder, its bow taken off; see :class:`Occluder`."""
    cosine, sine = np.cos(front[0]), np.sin(front[0])
    across = abs(cosine * y - sine * x - front[2])
    return cosine * x + sine * y - front[1] * across ** front[3]
