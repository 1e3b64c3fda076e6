"""Depth steps: where two neighbouring pixels see different surfaces, and regions that do not cross them.

    z_far - z_near > step * z_near

A share of the depth and no length, as the footprint of a pixel grows with the depth too: a surface shows a step of its
own only where it is seen at less than about atan(1 / (fx step)) radians, some 7 degrees for a VGA camera and 1.5 %.
Images are float (height, width), 0 where there is no depth.

Coherent masks
--------------
A convex body has no step in its visible surface.  Masks that come from colour, or that a sensor widens at edges, hold
pixels that measured the background, or what stands in front, instead.  A piece that touches the largest one across a
step, or is tiny, goes, and so does one that mostly goes on beyond the mask: it is the fringe of something else.  One
beyond a gap (a bar in front of the body) stays, and so does a large one across a step whose border is a border in the
depth as well: things need not be convex, and the head of a tool hides where its grip begins.
"""

from __future__ import annotations

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel

CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
STEP = 0.015  # share of the depth by which neighbouring pixels of one surface differ at most


def edges(filled: np.ndarray, wanted: np.ndarray, step: float) -> np.ndarray:
    """Wanted pixels beside which another one is farther by more than a share of the depth; 0 is no depth."""
    farthest = cv2.dilate(filled, CROSS, borderType=cv2.BORDER_REPLICATE)
    return wanted & (farthest - filled > step * filled)


def components(mask: np.ndarray) -> np.ndarray:
    """Labels int32 (height, width) of the 4-connected parts of a mask, from 1; 0 outside."""
    _, labels = cv2.connectedComponents(np.ascontiguousarray(mask, dtype=np.uint8), connectivity=4, ltype=cv2.CV_32S)
    return labels


def separate(depth: np.ndarray, wanted: np.ndarray, step: float = STEP) -> np.ndarray:
    """Components of the wanted pixels, cut where neighbouring depths jump; the cut pixels are given back."""
    filled = np.where(wanted, depth, np.float32(0))
    labels = components(wanted & ~edges(filled, wanted, step))
    return grow(labels, wanted & (labels == 0), depth, 2, step)


def grow(labels: np.ndarray, free: np.ndarray, depth: np.ndarray, rounds: int, step: float) -> np.ndarray:
    """Let labels grow into free pixels, by a pixel per round and not across a depth step."""
    grown = np.array(labels, dtype=np.int32, order="C")
    _grow(grown, np.flatnonzero(free), np.ascontiguousarray(depth, dtype=np.float32), rounds, np.float32(step))
    return grown


@kernel
def _grow(labels: np.ndarray, free: np.ndarray, depth: np.ndarray, rounds: int, step: np.float32) -> None:
    """As :func:`grow`, in place; a pixel takes the label of its neighbour to the right, left, below or above."""
    height, width = labels.shape
    chosen = np.empty(free.size, np.int32)
    left = free.size
    for _ in range(rounds):
        for k in range(left):
            v, u = free[k] // width, free[k] % width
            limit = step * depth[v, u]
            chosen[k] = 0
            for side in range(4):
                v2, u2 = v + (side == 2) - (side == 3), u + (side == 0) - (side == 1)
                inside = 0 <= v2 < height and 0 <= u2 < width
                if inside and labels[v2, u2] > 0 and abs(depth[v2, u2] - depth[v, u]) <= limit:
                    chosen[k] = labels[v2, u2]
                    break
        kept = 0
        for k in range(left):
            if chosen[k] > 0:
                labels[free[k] // width, free[k] % width] = chosen[k]
            else:
                free[kept] = free[k]
                kept += 1
        if kept == left:
            return
        left = kept


def shown_step(footprint: float) -> float:
    """Depth step, metres, that ends what a network is shown and a score is measured on, for pixels so wide."""
    return 10.0 * footprint + 0.002


@kernel
def coherent(depth: np.ndarray, inside: np.ndarray, jump: float) -> np.ndarray:
    """The mask (height, width) without the pieces that are of something else; a step is more than ``jump`` metres.
    Pixels without depth, NaN, belong to no piece and stay."""
    # Share of a piece's pixels, or of the border pixels of one across a step, that lie beside pixels of its depth
    # outside the mask, from which on it is a fringe.
    fringe = 1 / 3
    height, width = depth.shape
    label = np.zeros((height, width), np.int32)
    rows, columns = np.empty(height * width, np.int32), np.empty(height * width, np.int32)  # still to look at
    largest, largest_size, pieces = 0, 0, 0
    sizes, outside, border = np.zeros((3, height * width // 2 + 2), np.int32)
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
        # Share of the largest piece's pixels below which a piece is tiny.
        kept[k] = sizes[k] >= 0.02 * largest_size and outside[k] < fringe * sizes[k]
    for v in range(height):
        for u in range(width):
            if label[v, u] != largest:
                continue
            for side in range(4):
                v2, u2 = v + (side == 0) - (side == 1), u + (side == 2) - (side == 3)
                if 0 <= v2 < height and 0 <= u2 < width and label[v2, u2] > 0:
                    k = label[v2, u2]
                    # Least share of the largest piece's pixels that a part across a step has. With such parts 6 of 729
                    # simulated things are fitted otherwise, on average 2 % of IoU better, and six recorded vessels gain
                    # 1.8 %.
                    kept[k] = sizes[k] >= 0.1 * largest_size and outside[k] < fringe * border[k]
    kept[0] = kept[largest] = True
    coherent = inside.copy()
    for v in range(height):
        for u in range(width):
            coherent[v, u] = inside[v, u] and kept[label[v, u]]
    return coherent
