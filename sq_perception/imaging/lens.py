"""What a camera's pixels see, compiled: :meth:`Camera.unproject` one pixel at a time."""

from __future__ import annotations

from sq_perception.geometry.kernels import Triple, inline_kernel
from sq_perception.imaging.camera import Lens


@inline_kernel
def point_at(u: int, v: int, z: float, lens: Lens) -> Triple:
    """The point that a pixel sees at a depth."""
    scale = z if lens.is_pinhole else 1.0
    return (u - lens.cx) / lens.fx * scale, (v - lens.cy) / lens.fy * scale, z
