"""The parts of one object, from its points, its mesh, or what a depth camera saw of it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from sq_perception.fitting import decomposition
from sq_perception.fitting.decomposition import MOST_PARTS
from sq_perception.fitting.fit import Parts
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.recovery.recoverer import Recoverer


def decompose(
    thing: Any, normals: np.ndarray | None = None, *, most: int = MOST_PARTS, sigma: float | None = None
) -> Parts:
    """The parts of one object, at most ``most`` of them.

    Parameters
    ----------
    thing : (n, 3), a mesh or a frame
        Points or a mesh as for :func:`sq_perception.fitting.decomposition.decompose`; or what has ``depth``, ``camera``
        and ``labels``, the mask of one object, as ``sq.read_frame`` gives it: then parts are those of
        :mod:`sq_perception.recovery.parts`, and an object of more than ``most`` is one body.
    normals, sigma
        Of points and meshes.

    Raises
    ------
    ValueError
        If an argument has the wrong form, or there is nothing finite in it.
    """
    if not (hasattr(thing, "depth") and hasattr(thing, "camera")):
        return decomposition.decompose(thing, normals, most=most, sigma=sigma)
    if most < 1:
        raise ValueError(f"most: expected 1 or more parts, got {most}")
    if thing.labels is None:
        raise ValueError("labels: expected the mask of one object, got none")
    found = _recoverer().recover(thing.depth, thing.camera, thing.labels, RecoveryOptions(parts=True)).bodies
    if len(found) != 1:
        raise ValueError(f"labels: expected the mask of one object that was measured, got {len(found)} objects")
    fit, parts = found[0].fit, found[0].parts
    if parts is not None and len(parts) <= most:
        return parts
    return Parts.of([fit], np.array([fit.inlier_share]), fit.noise, fit.milliseconds)


@lru_cache(maxsize=1)
def _recoverer() -> Recoverer:
    return Recoverer()
