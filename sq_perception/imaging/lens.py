"""What a camera's pixels see, compiled: :meth:`Camera.unproject` one pixel at a time; metres, optical frame."""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.kernels import Triple, inline_kernel, kernel
from sq_perception.imaging.camera import Lens


@inline_kernel
def point_at(u: int, v: int, z: float, lens: Lens) -> Triple:
    """The point that a pixel sees at a depth."""
    scale = z if lens.is_pinhole else 1.0
    return (u - lens.cx) / lens.fx * scale, (v - lens.cy) / lens.fy * scale, z


@kernel
def heights(depth: np.ndarray, mask: np.ndarray, lens: Lens, plane: np.ndarray) -> np.ndarray:
    """Heights (h, w) above a plane (4,) of what the pixels of a mask (h, w) see, by their depths; NaN elsewhere."""
    found = np.full(depth.shape, np.nan)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if mask[v, u]:
                x, y, z = point_at(u, v, np.float64(depth[v, u]), lens)
                found[v, u] = plane[0] * x + plane[1] * y + plane[2] * z + plane[3]
    return found
