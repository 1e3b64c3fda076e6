"""Depth steps: where two neighbouring pixels see different surfaces, and regions that do not cross them.

    z_far - z_near > step * z_near

A share of the depth and no length, as the footprint of a pixel grows with the depth too: a surface shows a step of its
own only where it is seen at less than about atan(1 / (fx step)) radians, some 7 degrees for a VGA camera and 1.5 %.
Images are float (height, width), 0 where there is no depth.
"""

from __future__ import annotations

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel

CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
STEP = 0.015
"""Share of the depth by which neighbouring pixels of one surface differ at most."""


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
