"""The thesis' figures of merit, body by body, and their summary (thesis, chapter 5.4).

| figure | definition | summary |
| --- | --- | --- |
| IoU | equation 5.1, 64^3 points of the unit cube | mean, standard deviation, min, max, share over 85 % |
| volume IoU | the same over the box around both bodies | mean, standard deviation |
| Delta A | (a1 a2 a3)^ / (a1 a2 a3) - 1, equation 5.2 | mean |
| Delta E | (e1 + e2)^ / (e1 + e2) - 1, equation 5.3 | mean |
| Delta T | t^ - t, equation 5.4, in sides of the cube | mean of each coordinate |

Rotations, q^ predicted, q true, r = q^-1 q^ = (v, w):

| angle | definition | range |
| --- | --- | --- |
| shortest arc, figure 6.3 | 2 atan2(|v|, w), the signs of the quaternions as they are | 0 to 2 pi |
| axes | least over the 4 half turns of the body | 0 to 120 degrees |
| symmetric | least over the 8 parameter vectors of the body | 0 to 98.4 degrees |
| any order | least over the 24 rotations of a cube about the body's axes | 0 to 62.8 degrees |

q and -q are one rotation, so that the first is symmetric about pi wherever signs are arbitrary, and 0, pi (about an
axis of the body) and 2 pi are the same body.  The symmetric angle does not depend on how a body is written; it takes a
quarter turn about z for none, whatever the sizes, as the IoU shows that.  Where e1 is about e2 and any axis may
pass for z, only the last one is small for bodies that are alike.  The summary counts bodies whose axes angle is 70
to 110 degrees as quarter turns.

A body that was not recovered has IoU 0, and NaN in everything that compares parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sq_perception.geometry import metrics
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric

GOOD_IOU = 0.85


@dataclass(frozen=True, eq=False)
class FiguresOfMerit:
    """Figures of n bodies, arrays (n,), ``delta_t`` (n, 3); fractions and radians, see the module.  ``milliseconds`` is
    the execution time of each image by itself, NaN where it was not measured."""

    iou: np.ndarray
    volume_iou: np.ndarray
    delta_a: np.ndarray
    delta_e: np.ndarray
    delta_t: np.ndarray
    shortest_arc: np.ndarray
    axes_angle: np.ndarray
    symmetric_angle: np.ndarray
    any_order_angle: np.ndarray
    milliseconds: np.ndarray

    def __len__(self) -> int:
        return len(self.iou)

    @classmethod
    def of(
        cls, prediction: Superquadric, truth: Superquadric, recovered: np.ndarray | None = None,
        milliseconds: np.ndarray | None = None,
    ) -> FiguresOfMerit:
        """Compare batches (n,) of the cube frame.

        prediction, truth: NumPy.
        recovered: bool (n,), where False, there is no prediction and what stands in its place does not count.
        milliseconds: (n,).
        """
        count = len(truth)
        missing = np.zeros(count, bool) if recovered is None else ~np.asarray(recovered, dtype=bool)
        turns = truth.equivalent_forms().rotation
        # The 8 and a cyclic exchange of the axes, x to y to z to x and back, make the 24 rotations of a cube.
        cycles = np.array([[0.5, 0.5, 0.5, 0.5], [-0.5, -0.5, -0.5, 0.5]])
        orders = np.stack([turns, *(quaternions.multiply(turns, cycle + 0 * turns) for cycle in cycles)])
        angles = quaternions.geodesic_angle(np.broadcast_to(prediction.rotation, orders.shape), orders)

        def known(values: np.ndarray) -> np.ndarray:
            return np.where(missing.reshape(-1, *[1] * (values.ndim - 1)), np.nan, values)

        return cls(
            np.where(missing, 0.0, metrics.thesis_iou(prediction, truth)),
            np.where(missing, 0.0, metrics.volume_iou(prediction, truth)),
            known(prediction.size.prod(axis=-1) / truth.size.prod(axis=-1) - 1),
            known(prediction.shape.sum(axis=-1) / truth.shape.sum(axis=-1) - 1),
            known(prediction.translation - truth.translation),
            known(shortest_arc(prediction.rotation, truth.rotation)), known(angles[0, :4].min(axis=0)),
            known(angles[0].min(axis=0)), known(angles.min(axis=(0, 1))),
            np.full(count, np.nan) if milliseconds is None else np.asarray(milliseconds, dtype=float),
        )

    def summary(self) -> dict[str, Any]:
        """Means over a test set, as in the thesis' tables, JSON values by name: fractions and radians.  Parameters are
        compared over the ``recovered`` bodies, times over the ``timed`` ones; NaN where there is none."""
        recovered = np.isfinite(self.delta_a)
        times = self.milliseconds[np.isfinite(self.milliseconds)]
        axes = self.axes_angle[recovered]
        low, high = np.deg2rad([70.0, 110.0])
        return {
            "bodies": len(self),
            "recovered": int(recovered.sum()),
            **_statistics("iou", self.iou, np.mean, np.std, np.median, np.min, np.max),
            "over_85": _of(np.mean, self.iou > GOOD_IOU),
            **_statistics("volume_iou", self.volume_iou, np.mean, np.std),
            "delta_a": _of(np.mean, self.delta_a[recovered]),
            "delta_e": _of(np.mean, self.delta_e[recovered]),
            "delta_t": [_of(np.mean, coordinate) for coordinate in self.delta_t[recovered].T],
            "quarter_turns": _of(np.mean, (axes > low) & (axes < high)),
            "symmetric_angle_median": _of(np.median, self.symmetric_angle[recovered]),
            "any_order_angle_median": _of(np.median, self.any_order_angle[recovered]),
            "timed": times.size,
            **_statistics("milliseconds", times, np.mean, np.std, np.median),
            "milliseconds_p95": _of(lambda values: np.percentile(values, 95), times),
        }


def shortest_arc(predicted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Angle 0 to 2 pi of the rotation from predicted to true quaternions (..., 4), signs as they are (figure 6.3)."""
    between = quaternions.multiply(quaternions.conjugate(predicted), true)
    return 2 * np.arctan2(np.linalg.norm(between[..., :3], axis=-1), between[..., 3])


def _statistics(name: str, values: np.ndarray, *statistics: Callable[[np.ndarray], np.floating]) -> dict[str, float]:
    return {f"{name}_{statistic.__name__}": _of(statistic, values) for statistic in statistics}


def _of(statistic: Callable[[np.ndarray], np.floating], values: np.ndarray) -> float:
    return float(statistic(values)) if len(values) else float("nan")
