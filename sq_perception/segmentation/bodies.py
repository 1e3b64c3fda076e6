"""Bodies of the pixels that are above a support, or of all there are: patches, grouped, corrected, at full resolution.

Steps 2 to 5 of :mod:`sq_perception.segmentation.segments`.  Metres and pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.imaging import depth_steps
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import (
    convex_parts,
    patch_grouping,
    standing,
    support_plane,
    support_surface,
    surface_patches,
)
from sq_perception.segmentation.support_surface import SupportSurface

LEAST_SIGMA = 5e-4
"""Noise of the depth at one metre that is assumed at least, metres: rendered images have none."""
_FOOT_PIXELS = 3
"""Up to which the foot of a thing reaches below what is clearly above the support."""
_AROUND = 40
"""Pixels around all that is above the support in which its noise is measured; two of the longest chords at VGA."""


def above(seen: standing.Seen, relative: np.ndarray, valid: np.ndarray, support: SupportSurface) -> np.ndarray:
    """Bodies (labels from 1, unordered) of what is above the support; heights are 0 where depths are."""
    known, camera = seen.known, seen.camera
    labels = np.zeros(known.shape, np.int32)
    # Half of the tolerance band is a compromise: bent depth of real cameras stays below, thin objects stay above.
    clear = cv2.blur(relative, (3, 3)) > max(0.5 * support_plane.TOLERANCE, 4 * support.sigma)
    # The mean beside a tall body is that of its height: the pixel itself decides there.
    above = relative > max(0.25 * support_plane.TOLERANCE, 2 * support.sigma)
    above &= ~support_surface.risen(relative, known, valid, camera)
    clear &= above
    clear &= ~standing.furniture(seen, clear)
    left, top, width, height = cv2.boundingRect(clear.view(np.uint8))
    if width == 0:
        return labels
    top, left = max(top - _AROUND, 0), max(left - _AROUND, 0)
    window = slice(top, top + height + 2 * _AROUND), slice(left, left + width + 2 * _AROUND)
    # Contiguous, as kernels are compiled for arrays of a kind.
    flat = valid[window] & (np.abs(relative[window]) < support_plane.TOLERANCE)
    known, clear = np.ascontiguousarray(known[window]), np.ascontiguousarray(clear[window])
    camera = camera.cropped(left, top, known.shape[1], known.shape[0])
    holds = partial(seen.options.is_small, up=support.plane.equation[:3])
    inside = taken_apart(known, clear, camera, support.sigma, holds, flat)
    foot = above[window] & (inside == 0)
    labels[window] = depth_steps.grown(inside, foot, known, _FOOT_PIXELS, depth_steps.STEP)
    return labels


def taken_apart(
    depth: np.ndarray,
    wanted: np.ndarray,
    camera: Camera,
    sigma: float,
    holds: Callable[[np.ndarray], bool],
    flat: np.ndarray | None = None,
) -> np.ndarray:
    """Bodies (labels from 1, unordered) of the wanted pixels, taken apart at steps and concave edges."""
    sigma = max(sigma, LEAST_SIGMA)
    patches = surface_patches.find(depth, wanted, camera, sigma, flat)
    if patches is None:
        return convex_parts.corrected(depth_steps.separated(depth, wanted), depth, camera, sigma, holds)
    body = patch_grouping.bodies(patches, camera)
    labels = _refined(body[patches.labels].astype(np.int32), patches, depth, wanted)
    return convex_parts.corrected(labels, depth, camera, sigma, holds)


def _refined(body: np.ndarray, patches: surface_patches.Patches, depth: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Labels (height, width) from those of the samples; beside a step, of the one whose depth is most alike."""
    unsure = patches.stepped | (body == 0)
    known = np.pad(np.where(body > 0, patches.depth, np.float32(np.inf)), 1, constant_values=np.inf)
    return np.asarray(_fine(body, unsure, known, depth, wanted, patches.stride, np.float32(depth_steps.STEP)))


@kernel
def _fine(
    body: np.ndarray,
    unsure: np.ndarray,
    known: np.ndarray,
    depth: np.ndarray,
    wanted: np.ndarray,
    stride: int,
    step: np.float32,
) -> np.ndarray:
    """The same; ``known`` are the depths of labelled samples in a frame of one sample, inf for others."""
    labels = np.zeros(depth.shape, np.int32)
    rows, columns = body.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if not wanted[v, u]:
                continue
            if not unsure[v // stride, u // stride]:
                labels[v, u] = body[v // stride, u // stride]
                continue
            r, c = (v + stride // 2) // stride, (u + stride // 2) // stride
            least = step * depth[v, u]
            for i in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, columns)):
                    off = abs(known[i + 1, j + 1] - depth[v, u])
                    if off < least:
                        least = off
                        labels[v, u] = body[i, j]
    return labels
