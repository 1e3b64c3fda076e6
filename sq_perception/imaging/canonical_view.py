"""The canonical view: what the network sees of one object, and the way back.

Equation
--------
The view is the thesis' world (:mod:`sq_perception.imaging.unit_cube`) fitted to one object: orthographic, unit cube,
x right, y up, z towards the viewer, pixel (row i, column j) of an n x n image at

    x = (j + 1/2) / n,   y = 1 - (i + 1/2) / n,   value = z in (0, 1],   0 for background.

It follows from the optical frame by

    p_canonical = R (p_optical - anchor) / extent + (1/2, 1/2, z0)

with R = diag(1, -1, -1) R_up R_look, where R_look turns the ray to the object's middle into the z axis (identity for an
orthographic camera), R_up undoes the roll of the camera, about the same axis, where the support tells it: a camera on a
wrist has any roll, and things stand as they do.  The anchor is at the silhouette's middle and the depth of the nearest
point, z0 = (1 + 1/margin)/2, and the extent such that silhouette and visible depth fill 1/margin of the cube.  Both
directions are exact; a superquadric stays one, since the map is a similarity.

What the network must learn shrinks: position, size and (for a pinhole camera) perspective are divided out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import regions
from sq_perception.imaging.camera import Camera, Lens
from sq_perception.imaging.raycast import point_at

MARGIN = 1.06  # side of the cube over the side of what is seen in it

HIDDEN = -0.5  # value of a pixel at which the object may go on unseen, in views that distinguish this from background
FLUSH = -0.25  # value of a pixel beside the object that is as near as its edge, in views that show steps
COVERED = -1.5  # value of a pixel of the object's mask at which nothing was measured, in views that show steps

NEAREST = 0.5 * (1 + 1 / MARGIN)  # z0: the value of the object's nearest point
OUTLIERS_PER_END = 1 / 500
"""Share of an object's depths, the nearest and the farthest, that do not count for its extent."""
_NEARER = 0.04  # share of the view's side by which something nearer than the object hides what is behind it
_FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class CanonicalView:
    """The image of one object in its own unit cube."""

    image: np.ndarray  # float32 (n, n), z of the visible surface, 0 for background
    beside: np.ndarray
    """float32 (n, n), how much nearer what was measured beside the object is than its nearest surface there, in sides
    of the view, -1 to 1: positive before it, 0 flush with it, -1 far behind it, on the plane, or not asked for. Where
    nothing was measured +inf within the mask, and NaN where the object may go on beyond it, else -1."""
    rotation: np.ndarray  # (4,), quaternion, optical frame to canonical frame
    anchor: np.ndarray  # (3,), the optical frame's point that lands at (1/2, 1/2, z0), metres
    extent: float  # side of the cube, metres

    @property
    def hidden(self) -> np.ndarray:
        """Background pixels (n, n) at which the object may go on unseen; all False where this was not asked for."""
        return ~(self.beside <= _NEARER)

    @property
    def marked(self) -> np.ndarray:
        """The image with :data:`HIDDEN` at the hidden pixels."""
        return np.where(self.hidden, np.float32(HIDDEN), self.image)

    @property
    def with_steps(self) -> np.ndarray:
        """The image with the steps s = :attr:`beside` in depth around the object, for networks that are shown them.

            COVERED                    nothing was measured, within the mask
            HIDDEN                     nothing was measured, beyond it
            HIDDEN (1 + root(s))       something nearer
            FLUSH (1 - root(-s))       flush to far behind: 0

        A thing mostly ends where something touches it, while what stands far before it says nothing of where it ends;
        flush readings beside it are its own where a mask is too small.  Roots, as steps that matter are of hundredths.
        """
        ahead, behind = np.sqrt(np.clip(self.beside, 0, 1)), np.sqrt(np.clip(-self.beside, 0, 1))
        step = np.where(self.hidden, HIDDEN * (1 + ahead), FLUSH * (1 - behind)).astype(np.float32)
        step[np.isnan(self.beside)] = HIDDEN
        step[self.beside == np.inf] = COVERED
        return np.where(self.image > 0, self.image, step)

    def to_canonical(self, body: Superquadric) -> Superquadric:
        """A NumPy body of the optical frame in the canonical frame."""
        rotated = quaternions.to_matrix(self.rotation) @ self.anchor
        shift = np.array([0.5, 0.5, NEAREST]) - rotated / self.extent
        return body.transformed(self.rotation, shift, 1 / self.extent)

    def plane_to_canonical(self, plane: np.ndarray) -> np.ndarray:
        """A plane (4,) n.p + d = 0 of the optical frame, metres, in the canonical frame and its unit."""
        normal = quaternions.to_matrix(self.rotation) @ plane[:3]
        offset = (plane[:3] @ self.anchor + plane[3]) / self.extent - normal @ np.array([0.5, 0.5, NEAREST])
        return np.append(normal, offset)

    def from_canonical(self, body: Superquadric) -> Superquadric:
        """A NumPy body of the canonical frame in the optical frame."""
        inverse = quaternions.conjugate(self.rotation)
        middle = quaternions.to_matrix(inverse) @ np.array([0.5, 0.5, NEAREST])
        return body.transformed(inverse, self.anchor - middle * self.extent, self.extent)


def from_mask(
    depth: np.ndarray, mask: np.ndarray, camera: Camera, pixels: int = 64, *, find_hidden: bool = False,
    plane: np.ndarray | None = None, missing_is_hidden: bool = False,
) -> CanonicalView:
    """The canonical view of the object under a mask.

    depth: float (height, width), metres, NaN where nothing was measured.
    mask: bool (height, width).
    pixels: Side n of the view.
    find_hidden: Whether to look at the object's surroundings for what may hide a part of it.
    plane: (4,), what the object stands on, n.p + d = 0, n up: it tells the camera's roll, and seen in front of the
        object it hides nothing.
    missing_is_hidden: Whether the object may go on at every pixel without a reading, on it and beside it, and beyond
        the image; asks for ``find_hidden`` too.  A mask that covers pixels without a reading was not made of readings,
        and so knows where the object ends: beside such a mask they show nothing of it.  By default a pixel that
        measured nothing hides something within the object's convex hull only.

    Raises ValueError if the images do not fit the camera, or no pixel of the mask has a depth.
    """
    camera.check_image(depth)
    camera.check_image(mask)
    left, top, width, height = _box(depth, mask, missing_is_hidden)
    if width == 0:
        raise ValueError("a canonical view needs at least one pixel with a depth under the mask")
    find_hidden |= missing_is_hidden
    whole = camera
    look, wider = np.eye(3), 1.0
    if camera.is_pinhole:
        look, wider = _looking_at(left + 0.5 * (width - 1), top + 0.5 * (height - 1), camera, plane)
    if find_hidden:
        left, top, width, height = _with_surroundings(left, top, width, height, camera, wider)
    camera = camera.cropped(left, top, width, height)
    window = np.s_[top : top + height, left : left + width]
    depth, mask = np.ascontiguousarray(depth[window], dtype=np.float32), np.ascontiguousarray(mask[window])

    matrix = _FLIP @ look
    unread = float(depth[mask & np.isfinite(depth)].mean()) if missing_is_hidden else np.nan
    image, low, high, closest = _rotate(depth, mask, unread, camera.lens, matrix)
    z = image[np.isfinite(image)]
    outliers = int(z.size * OUTLIERS_PER_END)
    ordered = np.partition(z, [outliers, z.size // 2, z.size - 1 - outliers])
    farthest, middle, nearest = (float(ordered[k]) for k in (outliers, z.size // 2, z.size - 1 - outliers))
    pixel = max(1 / camera.fx, 1 / camera.fy) * (closest if camera.is_pinhole else 1.0)
    extent = MARGIN * max(*(high - low + pixel), nearest - farthest)
    anchor = np.array([*(0.5 * (low + high)), nearest])

    # Each NaN replaced by the nearest number, where one is asked for.
    is_asked = camera.is_pinhole or (find_hidden and bool((np.isfinite(depth) & ~mask).any()))
    filled = image.ravel()[regions.nearest(~np.isnan(image))] if is_asked else image
    nearer = np.full(mask.shape, np.float32(-np.inf))
    if find_hidden:
        read = mask & np.isfinite(depth)
        is_drawn = missing_is_hidden and bool((mask & ~read).any())  # not made of readings
        lost = mask if is_drawn else np.ones_like(mask)
        if not missing_is_hidden:  # within the convex hull, whose own border passes outside of a convex set of pixels
            lost = cv2.erode(regions.convex_hull(read.view(np.uint8)), np.ones((3, 3), np.uint8)).view(bool)
        ground = np.array([0.0, 0.0, 0.0, np.inf]) if plane is None else np.asarray(plane, dtype=float)
        nearer = _nearer(depth, mask, filled, lost, camera.lens, matrix, ground, _NEARER * float(extent))
    beyond = (-left, -top, whole.width - left, whole.height - top) if missing_is_hidden else (0, 0, 0, 0)
    value, beside = _resample(image, filled, nearer, beyond, camera.lens, matrix, anchor, extent, middle, pixels)
    return CanonicalView(value, beside, quaternions.from_matrix(matrix), matrix.T @ anchor, float(extent))


def full_frame(depth: np.ndarray, mask: np.ndarray, camera: Camera, pixels: int) -> CanonicalView:
    """The object in the whole unit cube, uncropped, as in the thesis' images: pixels at column / (n - 1).

    depth, mask, pixels: As in :func:`from_mask`.
    camera: Orthographic, of the unit cube (:mod:`sq_perception.imaging.unit_cube`).

    Raises ValueError for a pinhole camera, or images that do not fit the camera.
    """
    if camera.is_pinhole:
        raise ValueError("a full frame shows the unit cube: expected an orthographic camera, got a pinhole camera")
    camera.check_image(depth)
    camera.check_image(mask)
    x, y = np.meshgrid(np.linspace(0, 1, pixels), np.linspace(0, 1, pixels))
    seen = np.where(mask, depth, np.nan).astype(np.float32)
    u, v = np.moveaxis(camera.project(np.stack([x, y, np.zeros_like(x)], axis=-1)).astype(np.float32), -1, 0)
    image = 1 - cv2.remap(seen, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    image = np.where(np.isfinite(image), np.clip(image, 1 / 255, 1.0), 0.0).astype(np.float32)
    # The cube is the optical frame turned by _FLIP and shifted by (0, 1, 1).
    anchor = _FLIP @ (np.array([0.5, 0.5, NEAREST]) - np.array([0.0, 1.0, 1.0]))
    beside = np.full_like(image, -1.0)
    return CanonicalView(image, beside, quaternions.from_matrix(_FLIP), anchor, 1.0)


def upright(normal: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) about the optical axis that undoes a camera's roll, by the support's normal (3,), upwards."""
    x, y, _ = normal
    across = float(np.hypot(x, y))
    # Least part of a support's normal across the optical axis that tells the roll, 12 degrees; and cosine of a roll
    # that counts as none: networks have seen as much.
    if across < 0.2 or -y > float(np.cos(np.deg2rad(15.0))) * across:
        return np.eye(3)
    c, s = -y / across, x / across
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _looking_at(u: float, v: float, camera: Camera, plane: np.ndarray | None) -> tuple[np.ndarray, float]:
    """R_up R_look (3, 3) for the ray of a pixel, and how many times wider than a box the turned box may be."""
    toward = camera.unproject(np.array(u), np.array(v), np.array(1.0))
    look = _rotation_to_z(toward / np.linalg.norm(toward))
    up = upright(plane[:3]) if plane is not None else np.eye(3)
    return up @ look, float(np.abs(up[0]).sum() ** 2)


def _with_surroundings(
    left: int, top: int, width: int, height: int, camera: Camera, wider: float
) -> tuple[int, int, int, int]:
    """The part of the image, as a box, that a square view of a box of pixels shows; ``wider`` as by
    :func:`_looking_at`."""
    # Side of the part of the image that is looked at, in sides of the silhouette's box; more than MARGIN, as under
    # perspective the view's edges are not where those of the box are.
    side = 1.2 * wider * max(width, height)
    right, bottom = left + width, top + height
    beside, above = int(np.ceil(0.5 * (side - width))) + 1, int(np.ceil(0.5 * (side - height))) + 1
    left, top = max(0, left - beside), max(0, top - above)
    return left, top, min(camera.width, right + beside) - left, min(camera.height, bottom + above) - top


def _box(depth: np.ndarray, mask: np.ndarray, whole: bool) -> tuple[int, int, int, int]:
    """Box of the pixels of a mask that have a depth, or of the ``whole`` mask; of width 0 where none has one."""
    left, top, width, height = regions.box(np.ascontiguousarray(mask))
    window = np.s_[top : top + height, left : left + width]
    inner_left, inner_top, inner_width, inner_height = regions.box(mask[window] & np.isfinite(depth[window]))
    if whole and inner_width > 0:
        return left, top, width, height
    return left + inner_left, top + inner_top, inner_width, inner_height


@kernel
def _rotate(
    depth: np.ndarray, mask: np.ndarray, unread: float, lens: Lens, matrix: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Turned z (height, width) of the measured pixels of a mask, NaN elsewhere; least, largest turned (x, y); least z.
    Unless ``unread`` is NaN, the (x, y) of other pixels of the mask, as deep as that, are among those."""
    image = np.full(depth.shape, np.float32(np.nan))
    low, high, closest = np.full(2, np.inf), np.full(2, -np.inf), np.inf
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            is_read = np.isfinite(depth[v, u])
            if mask[v, u] and (is_read or np.isfinite(unread)):
                x, y, z = point_at(u, v, np.float64(depth[v, u]) if is_read else unread, lens)
                for k in range(2):
                    along = matrix[k, 0] * x + matrix[k, 1] * y + matrix[k, 2] * z
                    low[k], high[k] = min(low[k], along), max(high[k], along)
                if is_read:
                    image[v, u] = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z
                    closest = min(closest, z)
    return image, low, high, closest


@kernel
def _nearer(
    depth: np.ndarray, mask: np.ndarray, filled: np.ndarray, lost: np.ndarray, lens: Lens, matrix: np.ndarray,
    plane: np.ndarray, tolerance: float,
) -> np.ndarray:
    """How much nearer than the object, whose depth is in ``filled``, each reading beside it is, metres; -inf on object
    and plane.  Without a reading +inf within the mask and NaN beyond it where set in ``lost``, else -inf."""
    nearer = np.full(depth.shape, np.float32(-np.inf))
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if not np.isfinite(depth[v, u]):
                if lost[v, u]:
                    nearer[v, u] = np.inf if mask[v, u] else np.nan
            elif not mask[v, u]:
                x, y, z = point_at(u, v, np.float64(depth[v, u]), lens)
                height = plane[0] * x + plane[1] * y + plane[2] * z + plane[3]
                if abs(height) > tolerance:
                    nearer[v, u] = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z - filled[v, u]
    return nearer


@kernel
def _resample(
    image: np.ndarray, filled: np.ndarray, nearer: np.ndarray, whole: tuple[int, int, int, int], lens: Lens,
    matrix: np.ndarray, anchor: np.ndarray, extent: float, z_guess: float, pixels: int,
) -> tuple[np.ndarray, np.ndarray]:
    """``image`` and ``beside`` (pixels, pixels) of a view, each from the nearest pixel of a crop (height, width).

    A view pixel fixes turned x and y but not z, and a pinhole pixel depends on all three.  Reading z at the projection
    of the last guess is a contraction wherever the surface is not almost parallel to the ray; three rounds suffice.
    Guesses that fall beside the object go on with the z of its nearest pixel, which ``filled`` (turned z) holds.
    ``whole`` is left, top, right and bottom of the whole image in the crop: beyond it the object may go on.  Where it
    is empty, that is not asked.
    """
    rounds = 3  # readings of z that settle where a pixel of the view looks
    fx, fy, cx, cy, pinhole = lens
    height, width = image.shape
    left, top, right, bottom = whole
    value, beside = np.zeros((pixels, pixels), np.float32), np.full((pixels, pixels), np.float32(-1))
    z, us, vs = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    for i in range(pixels):
        y = anchor[1] - ((i + 0.5) / pixels - 0.5) * extent
        z[:] = z_guess
        for step in range(rounds + 1):
            for j in range(pixels):  # without a branch: vector code
                x = anchor[0] + ((j + 0.5) / pixels - 0.5) * extent
                px = x * matrix[0, 0] + y * matrix[1, 0] + z[j] * matrix[2, 0]
                py = x * matrix[0, 1] + y * matrix[1, 1] + z[j] * matrix[2, 1]
                pz = x * matrix[0, 2] + y * matrix[1, 2] + z[j] * matrix[2, 2]
                scale = 1 / pz if pinhole else 1.0
                ahead = pz > 0 or not pinhole
                us[j] = np.rint(fx * px * scale + cx) if ahead else np.inf
                vs[j] = np.rint(fy * py * scale + cy) if ahead else np.inf
            if not pinhole or step == rounds:
                break
            for j in range(pixels):
                z[j] = filled[int(min(max(vs[j], 0), height - 1)), int(min(max(us[j], 0), width - 1))]
        for j in range(pixels):
            u, v = us[j], vs[j]
            if 0 <= u < width and 0 <= v < height:
                seen = image[int(v), int(u)]
                if np.isfinite(seen):
                    value[i, j] = min(max((seen - anchor[2]) / extent + NEAREST, 1 / 255), 1.0)
                else:
                    step = nearer[int(v), int(u)] / extent
                    beside[i, j] = min(max(step, -1.0), 1.0) if step < np.inf else step
            if right > left and not (left <= u < right and top <= v < bottom):
                beside[i, j] = np.nan
    return value, beside


def _rotation_to_z(direction: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that turns a unit direction with positive z into the z axis."""
    x, y, z = direction
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])
