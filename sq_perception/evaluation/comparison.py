"""Recovered bodies beside true ones: who is whom, and in comparable numbers.

Bodies are paired so that the sum of the distances of their centres is least; a pair farther apart than the sum of their
largest half sizes is none.  Of the 8 parameter vectors of one body, the one most like the truth is shown:

    least  | log size - log true size | + angle between the rotations      (natural logarithm, radians)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric

_POINTS = 48
"""Points along each edge of the box in which an overlap is counted: fewer than for figures, as every frame is shown."""


@dataclass(frozen=True, eq=False)
class Pair:
    """One object: what it is and what was made of it; at least one of both is there.

    Attributes
    ----------
    truth, recovered
        Indices into the batches, or None.
    iou
        Volume overlap of whole bodies, 0 to 1; None without a partner.
    """

    truth: int | None
    recovered: int | None
    iou: float | None = None


def pair(truth: Superquadric, recovered: Superquadric) -> list[Pair]:
    """Pairs of two batches (n,) and (m,): every true body in order, then what was recovered without being there."""
    distance = np.linalg.norm(truth.translation[:, None] - recovered.translation[None], axis=-1)
    partner: dict[int, int] = {}
    for i, k in zip(*linear_sum_assignment(distance), strict=True):
        if distance[i, k] <= truth.size[i].max() + recovered.size[k].max():
            partner[int(i)] = int(k)
    overlap: dict[int, float] = {}
    if partner:
        both = recovered[np.array(list(partner.values()))], truth[np.array(list(partner))]
        overlap = dict(zip(partner, volume_iou(*both, _POINTS).tolist(), strict=True))
    pairs = [Pair(i, partner.get(i), overlap.get(i)) for i in range(len(truth))]
    found = set(partner.values())
    return pairs + [Pair(None, k) for k in range(len(recovered)) if k not in found]


def alike(body: Superquadric, model: Superquadric) -> Superquadric:
    """The parameter vector of ``body`` that is most like that of ``model``; both single."""
    forms = body.equivalent_forms()
    stretch = np.linalg.norm(np.log(forms.size / model.size), axis=-1)
    turn = quaternions.geodesic_angle(forms.rotation, np.broadcast_to(model.rotation, forms.rotation.shape))
    return forms[int(np.argmin(stretch + turn))]
