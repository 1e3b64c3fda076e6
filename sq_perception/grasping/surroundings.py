"""The surroundings of the bodies: the table, other measured points, and unseen space."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.imaging import hole_filling
from sq_perception.imaging.camera import Camera, Lens

_MOST = 6000  # maximum number of kept points


@dataclass(frozen=True, eq=False)
class Surroundings:
    """All that a gripper must avoid beside the bodies, in their frame.

    Raises
    ------
    ValueError
        For arrays of another form, a plane that is none, or an image without its camera, or of one that is no pinhole.
    """

    plane: np.ndarray | None = None
    """(4,), what the bodies stand on: the height above it is n.p + d, n up and of length 1."""
    points: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    """(j, 3), measured points of objects; the table's are not among them."""
    depth: np.ndarray | None = None
    """In metres, NaN for no reading, if the frame is the optical one: space behind its surfaces is unseen."""
    camera: Camera | None = None
    """The pinhole camera of ``depth``."""

    def __post_init__(self) -> None:
        if self.plane is not None:
            plane = np.asarray(self.plane, dtype=float)
            if plane.shape != (4,) or not np.isfinite(plane).all() or abs(np.linalg.norm(plane[:3]) - 1) > 1e-3:
                raise ValueError(f"plane: expected a unit normal and a distance (4,), got {self.plane}")
            object.__setattr__(self, "plane", plane)
        points = np.asarray(self.points, dtype=float)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points: expected shape (j, 3), got {points.shape}")
        points = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)])
        object.__setattr__(self, "points", points)
        if (self.depth is None) != (self.camera is None):
            raise ValueError("depth, camera: expected both or neither")
        if self.camera is not None and self.depth is not None:
            if not self.camera.is_pinhole:
                raise ValueError("camera: expected a pinhole camera, got an orthographic one")
            object.__setattr__(self, "depth", self.camera.readings(self.depth))

    @classmethod
    def of_image(cls, depth: np.ndarray, camera: Camera, plane: np.ndarray | None) -> Surroundings:
        """Extract from a depth image its plane, points 8 mm above it thinned to a spacing of 5 mm, and what it hides.
        ``depth`` is in metres, not positive or not finite where nothing was measured, its camera a pinhole one."""
        depth = camera.readings(depth)
        z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
        if plane is None:
            rows, columns = np.nonzero(np.isfinite(z))
        else:
            across = plane[0] * (np.arange(camera.width) - camera.cx) / camera.fx
            down = plane[1] * (np.arange(camera.height) - camera.cy) / camera.fy
            rows, columns = np.nonzero(z * (across + down[:, None] + plane[2]) + plane[3] > 0.008)
        points = camera.unproject(columns, rows, z[rows, columns].astype(float))
        _, kept = np.unique(np.floor(points / 0.005) @ [1.0, 1e4, 1e8], return_index=True)
        if len(kept) > _MOST:
            kept = kept[np.linspace(0, len(kept) - 1, _MOST).astype(int)]
        return cls(plane, points[kept], hole_filling.fill(z)[0], camera)

    def down(self, places: np.ndarray) -> np.ndarray:
        """Return unit vectors (k, 3) downwards at places (k, 3): to the plane, or away from the frame's origin."""
        if self.plane is not None:
            return np.broadcast_to(-self.plane[:3], places.shape)
        length = np.linalg.norm(places, axis=1, keepdims=True)
        return np.where(length > 1e-6, places / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])

    def unseen(self, frames: np.ndarray, boxes: np.ndarray) -> np.ndarray:
        """Return the share (k,) of boxes (k, m, 6) at frames (k, 3, 4) that is 15 mm behind what the image shows."""
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)])
        local = boxes[:, :, None, :3] + corners * boxes[:, :, None, 3:]
        places = local.reshape(len(frames), -1, 3) @ frames[:, :, :3].transpose(0, 2, 1) + frames[:, None, :, 3]
        return np.asarray(np.mean(self.beyond(places) < -0.015, axis=1))

    def hidden_share(self, places: np.ndarray) -> np.ndarray:
        """Return the share (...,) of places (..., j, 3) that the image does not show to be empty for another 5 mm."""
        return np.asarray(np.mean(~(self.beyond(places) > 0.005), axis=-1))

    def beyond(self, places: np.ndarray) -> np.ndarray:
        """Return how far the reading at the pixel of places (..., 3) is behind them, metres; NaN for no reading."""
        if self.depth is None or self.camera is None:
            return np.full(places.shape[:-1], np.nan)
        camera, flat = self.camera, np.ascontiguousarray(places, dtype=float).reshape(-1, 3)
        at = _pixels_at(flat, camera.width, camera.height, camera.lens)
        found = np.where(at >= 0, self.depth.ravel()[at] - flat[:, 2], np.nan)
        return np.asarray(found.reshape(places.shape[:-1]))


@kernel
def _pixels_at(places: np.ndarray, width: int, height: int, lens: Lens) -> np.ndarray:
    """Return the flat index (k,) of the pixels that show places (k, 3); -1 outside the image or behind the camera."""
    found = np.full(len(places), -1)
    for k in range(len(places)):
        z = places[k, 2]
        if z > 1e-3:
            column, row = np.rint(lens.fx * places[k, 0] / z + lens.cx), np.rint(lens.fy * places[k, 1] / z + lens.cy)
            if 0 <= column < width and 0 <= row < height:
                found[k] = int(row) * width + int(column)
    return found
