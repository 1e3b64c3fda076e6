"""How far a soft-rendered body agrees with a view: the score of a recovery, compiled.

    1 - sum |X - T| / sum max(X, T),

X the view and T the body's image of :mod:`sq_perception.imaging.soft_render` (a test proves it): the
intersection over union of the two solids between each surface and the back of the cube, hence one number for a wrong
silhouette and a wrong depth alike.  A line of sight is walked, some voxels at once, from where it comes near the body
until nothing more passes: voxels whose occupancy is below e^-NEGLIGIBLE, and what lies behind as much of the body,
change no digit that is kept.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.geometry.elementary import exp2
from sq_perception.geometry.kernels import box_interval, gauge, kernel

THESIS_SHARPNESS = 117.3  # sharpness s of the thesis' renderer
THESIS_TAU = 4.82
_NEGLIGIBLE = 30.0
_PER_E = math.log2(math.e)  # the logarithm of e to base 2
_AT_ONCE = 16
"""Voxels walked at once, for vector code: some 8 lie where a surface is soft, and 7 of a solid let nothing pass."""


@kernel
def agreement(
    image: np.ndarray, stride: int, parameters: np.ndarray, rotation: np.ndarray, sharpness: float, tau: float
) -> float:
    """Intersection over union of what the view and the body show, at every ``stride``-th row and column.

    ``image`` (n, n) is that of a canonical view; the body is ``parameters`` a1 a2 a3 e1 e2 t1 t2 t3 k_x k_y and
    ``rotation`` (3, 3), object to canonical frame.
    """
    n = image.shape[0]
    a1, a2, a3, e1, e2, t1, t2, t3, k1, k2 = parameters
    reach = math.sqrt(1.0 + _NEGLIGIBLE / sharpness)
    ez1, ez2, ez3 = rotation[2]
    wide = reach * a1 * (1.0 + abs(k1)), reach * a2 * (1.0 + abs(k2)), reach * a3
    depths, lefts = np.empty(_AT_ONCE), np.empty(_AT_ONCE)
    difference, union = 0.0, 0.0
    for i in range(0, n, stride):
        y = 1.0 - (i + 0.5) / n - t2
        for j in range(0, n, stride):
            x = (j + 0.5) / n - t1
            # The line of sight at z = 0, in the object's frame; z grows along it.
            ox = rotation[0, 0] * x + rotation[1, 0] * y - ez1 * t3
            oy = rotation[0, 1] * x + rotation[1, 1] * y - ez2 * t3
            oz = rotation[0, 2] * x + rotation[1, 2] * y - ez3 * t3
            lowest, highest = box_interval((ox, oy, oz), (ez1, ez2, ez3), wide)
            # Voxel k = 0 .. n - 1 from the viewer has its centre at z = 1 - (k + 1/2) / n.
            k = math.ceil(max((1.0 - highest) * n - 0.5, 0.0)) if lowest <= highest else n
            last = math.floor(min((1.0 - lowest) * n - 0.5, n - 1.0)) if lowest <= highest else -1
            k = min(k, n)
            passed, left, depth = float(k), 1.0, 0.0
            while k <= last and depth < _NEGLIGIBLE:
                for v in range(_AT_ONCE):
                    z = 1.0 - (k + v + 0.5) / n
                    g = gauge(ox + z * ez1, oy + z * ez2, oz + z * ez3, a1, a2, a3, e1, e2, k1, k2)
                    outside = min(sharpness * (g * g - 1.0), 2.0 * _NEGLIGIBLE)
                    depths[v] = tau / (1.0 + exp2(_PER_E * outside))
                for v in range(_AT_ONCE):
                    depth += depths[v]
                    depths[v] = depth
                for v in range(_AT_ONCE):
                    lefts[v] = exp2(-_PER_E * min(depths[v], 2.0 * _NEGLIGIBLE))
                within = min(_AT_ONCE, n - k)
                for v in range(within):
                    passed += lefts[v]
                left = lefts[within - 1]
                k += within
            rendered = 1.0 - (passed + (n - k) * left) / n
            seen = float(image[i, j])
            difference += abs(seen - rendered)
            union += max(seen, rendered)
    return 1.0 - difference / union if union > 0.0 else 1.0
