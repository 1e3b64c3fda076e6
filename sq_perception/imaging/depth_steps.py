"""Depth steps: where two neighbouring pixels see different surfaces, and regions that do not cross them.

    z_far - z_near > step * z_near

A share of the depth and no length, as the footprint of a pixel grows with the depth too: a surface shows a step of its
own only where it is seen at less than about atan(1 / (fx step)) radians, some 7 degrees for a VGA camera and 1.5 %.
Images are float (height, width), 0 where there is no depth.
"""

from __future__ import annotations

import cv2
import numpy as np

CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
_NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0))


def edges(filled: np.ndarray, wanted: np.ndarray, step: float) -> np.ndarray:
    """Wanted pixels beside which another one is farther by more than a share of the depth; 0 is no depth."""
    farthest = cv2.dilate(filled, CROSS, borderType=cv2.BORDER_REPLICATE)
    return wanted & (farthest - filled > step * filled)


def components(mask: np.ndarray) -> np.ndarray:
    """Labels int32 (height, width) of the 4-connected parts of a mask, from 1; 0 outside."""
    _, labels = cv2.connectedComponents(np.ascontiguousarray(mask, dtype=np.uint8), connectivity=4, ltype=cv2.CV_32S)
    return labels


def separated(depth: np.ndarray, wanted: np.ndarray, step: float) -> np.ndarray:
    """Components of the wanted pixels, cut where neighbouring depths jump; the cut pixels are given back."""
    filled = np.where(wanted, depth, np.float32(0))
    kept = wanted & ~edges(filled, wanted, step)
    labels = components(cv2.morphologyEx(kept.astype(np.uint8), cv2.MORPH_OPEN, CROSS))
    return grown(labels, wanted & (labels == 0), depth, 2, step)


def grown(labels: np.ndarray, free: np.ndarray, depth: np.ndarray, rounds: int, step: float) -> np.ndarray:
    """Let labels grow into free pixels, by a pixel per round and not across a depth step."""
    labels = labels.astype(np.int32)
    rows, columns = np.nonzero(free)
    for _ in range(rounds):
        if rows.size == 0:
            break
        chosen = np.zeros(rows.size, np.int32)
        here = depth[rows, columns]
        for down, right in _NEIGHBOURS:
            r = np.clip(rows + down, 0, labels.shape[0] - 1)
            c = np.clip(columns + right, 0, labels.shape[1] - 1)
            neighbour = labels[r, c]
            fits = (chosen == 0) & (neighbour > 0) & (np.abs(depth[r, c] - here) <= step * here)
            chosen = np.where(fits, neighbour, chosen)
        labels[rows, columns] = chosen
        left = chosen == 0
        rows, columns = rows[left], columns[left]
    return labels
