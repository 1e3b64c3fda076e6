"""The coherent part of a mask: what a depth step separates from the object is something else.

A convex body has no step in its visible surface.  Masks that come from colour, or that a sensor widens at edges, hold
pixels that measured the background, or what stands in front, instead.  A piece that touches the largest one across a
step, or is tiny, goes, and so does one that mostly goes on beyond the mask: it is the fringe of something else.  One
beyond a gap (a bar in front of the body) stays, and so does a large one across a step whose border is a border in the
depth as well: things need not be convex, and the head of a tool hides where its grip begins.

Metres; float depth, NaN where nothing was measured.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.kernels import kernel

_SMALLEST_PIECE = 0.02
"""Share of the largest piece's pixels below which a piece is tiny."""
_FRINGE = 1 / 3
"""Share of a piece's pixels, or of the border pixels of one across a step, that lie beside pixels of its depth outside
the mask, from which on it is a fringe."""
_PART = 0.1
"""Least share of the largest piece's pixels that a part across a step has.  With such parts 6 of 729 simulated things
are fitted otherwise, on average 2 % of IoU better, and six recorded vessels gain 1.8 %."""
_STEP_PIXELS, _STEP = 10.0, 0.002
"""Pixel widths, and metres: together a step that ends what a network is shown and a score is measured on."""


def shown_step(footprint: float) -> float:
    """Depth step, metres, beyond which a neighbour is not of the object, for pixels ``footprint`` metres wide."""
    return _STEP_PIXELS * footprint + _STEP


@kernel
def coherent(depth: np.ndarray, inside: np.ndarray, jump: float) -> np.ndarray:
    """The mask (height, width) without the pieces that are of something else; a step is more than ``jump`` metres.

    Pixels without depth belong to no piece and stay.
    """
    height, width = depth.shape
    label = np.zeros((height, width), np.int32)
    rows, columns = np.empty(height * width, np.int32), np.empty(height * width, np.int32)  # still to look at
    largest, largest_size, pieces = 0, 0, 0
    outside = np.zeros(height * width // 2 + 2, np.int32)
    border = np.zeros(height * width // 2 + 2, np.int32)
    sizes = np.zeros(height * width // 2 + 2, np.int32)
    for start_v in range(height):
        for start_u in range(width):
            if not inside[start_v, start_u] or label[start_v, start_u] > 0:
                continue
            if not np.isfinite(depth[start_v, start_u]) or pieces + 1 >= sizes.shape[0]:
                continue
            pieces += 1
            label[start_v, start_u] = pieces
            rows[0], columns[0] = start_v, start_u
            top = 1
            size, beside, edge = 0, 0, 0
            while top > 0:
                top -= 1
                v, u = rows[top], columns[top]
                size += 1
                goes_on, is_border = False, False
                for side in range(4):
                    v2, u2 = v + (side == 0) - (side == 1), u + (side == 2) - (side == 3)
                    if v2 < 0 or u2 < 0 or v2 >= height or u2 >= width or label[v2, u2] > 0:
                        continue
                    if not inside[v2, u2]:
                        is_border = True
                        goes_on |= abs(depth[v2, u2] - depth[v, u]) <= jump
                        continue
                    if abs(depth[v2, u2] - depth[v, u]) <= jump:
                        label[v2, u2] = pieces
                        rows[top], columns[top] = v2, u2
                        top += 1
                beside += goes_on
                edge += is_border
            sizes[pieces], outside[pieces], border[pieces] = size, beside, edge
            if size > largest_size:
                largest, largest_size = pieces, size
    if pieces <= 1:
        return inside
    kept = np.ones(pieces + 1, np.bool_)
    for k in range(1, pieces + 1):
        kept[k] = sizes[k] >= _SMALLEST_PIECE * largest_size and outside[k] < _FRINGE * sizes[k]
    for v in range(height):
        for u in range(width):
            if label[v, u] != largest:
                continue
            for side in range(4):
                v2, u2 = v + (side == 0) - (side == 1), u + (side == 2) - (side == 3)
                if 0 <= v2 < height and 0 <= u2 < width and label[v2, u2] > 0:
                    k = label[v2, u2]
                    kept[k] = sizes[k] >= _PART * largest_size and outside[k] < _FRINGE * border[k]
    kept[0] = kept[largest] = True
    coherent = inside.copy()
    for v in range(height):
        for u in range(width):
            coherent[v, u] = inside[v, u] and kept[label[v, u]]
    return coherent
