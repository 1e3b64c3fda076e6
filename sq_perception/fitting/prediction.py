"""What the image leaves open, from a prediction: a least squares fit joined with a network's guess.

Equation
--------
A fit x with covariance P that hardly knows its half size a_k meets a prediction of it, m with standard deviation r.
The best linear estimate of both is (Kalman 1960)

    K = P_k / (P_kk + r^2),      x <- x + K (m - a_k),      P <- P - K P_k^T

with P_k the k-th column.  P knows that the seen face stays where it is, so that the centre moves along with the half
size.  m is the extent of the predicted body along the axis in question, its support function, and thereby independent
of how prediction and fit order their axes.

Metres, one frame for both bodies.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sq_perception.fitting.fit import Fit, Status
from sq_perception.geometry.superquadric import Superquadric

PREDICTION_SHARE = 0.4
"""Standard deviation of a predicted half size, as a share of it."""
_OPEN_SHARE = 0.15
_LARGEST_CHANGE = 10.0


def is_open(fit: Fit) -> bool:
    """Whether a fit leaves a half size to a prediction: one with a standard deviation above 15 % of it."""
    if fit.status == Status.FAILED or not np.isfinite(fit.covariance).all():
        return False
    return bool((fit.sigma_size > _OPEN_SHARE * fit.superquadric.size).any())


def completed(fit: Fit, predicted: Superquadric, share: float = PREDICTION_SHARE) -> Fit:
    """The fit with those half sizes that it leaves open joined with the prediction's.

    Parameters
    ----------
    fit : Fit
        Half sizes with a standard deviation above 15 % of them count as open; where there are none, or the covariance
        is unknown, the fit itself is returned.
    predicted : Superquadric
        A single body in the frame of the fit.
    share : float
        Standard deviation of a predicted half size, as a share of it.

    Returns
    -------
    Fit
        Exponents, rotation, status and inliers stay; the message names what was joined.
    """
    size, shape = np.array(fit.superquadric.size), fit.superquadric.shape
    sigma = fit.sigma_size
    if not is_open(fit):
        return fit
    known = np.concatenate([size, shape, fit.superquadric.translation, np.zeros(3)])
    covariance = fit.covariance.copy()
    axes = fit.superquadric.rotation_matrix
    open_axes = np.flatnonzero(sigma > _OPEN_SHARE * size)
    for k in open_axes:
        extent = float(predicted.support(axes[None, :, k])[0])
        gain = covariance[:, k] / (covariance[k, k] + (share * extent) ** 2)
        known = known + gain * (extent - known[k])
        covariance = covariance - np.outer(gain, covariance[k])
    new_size = np.clip(known[:3], size / _LARGEST_CHANGE, size * _LARGEST_CHANGE)
    left = np.sqrt(np.diag(covariance)[:3])
    joined = ", ".join(f"{'xyz'[k]} {1e3 * new_size[k]:.0f} +- {1e3 * left[k]:.0f} mm" for k in open_axes)
    return replace(
        fit,
        superquadric=Superquadric(new_size, shape, known[5:8], fit.superquadric.rotation),
        covariance=0.5 * (covariance + covariance.T),
        message=f"half sizes open in the image, joined with the network's prediction: {joined}",
    )
