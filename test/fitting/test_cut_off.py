"""What the border of the image cuts off: how long it is stays open, unless its shape tells."""

import numpy as np
import pytest
from table_scenes import VGA, Table

from sq_perception.fitting import surface_fit
from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.options import MODEL_ERROR, FitOptions
from sq_perception.fitting.priors import HullPrior
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import DIRECTIONS

CAN = (0.035, 0.035, 0.06), (0.1, 1.0)
BALL = (0.04, 0.04, 0.04), (1.0, 1.0)


def lower_half(size, shape, seed, as_thing=False, dark=0) -> tuple[Superquadric, Fit]:
    """A body of which the image shows the lower half, and its fit; of a thing, a hull is predicted that ends there.

    Above the image are ``dark`` rows without readings, as rectified ones have them.
    """
    table = Table(pitch=np.random.default_rng(seed).uniform(0.5, 1.1))
    body = table.body(0, 0, size, shape)
    depth, labels = table.see([body], noise=0.0007, seed=seed)
    rows = np.flatnonzero((labels == 1).any(axis=1))
    first = int(0.5 * (rows[0] + rows[-1]))
    depth[first - dark : first], labels[first - dark : first] = np.nan, 0
    first -= dark
    camera = VGA.cropped(0, first, VGA.width, VGA.height - first)
    options = FitOptions(plane=table.plane)
    if as_thing:
        shown = table.body(0, 0, (*size[:2], 0.65 * size[2]), shape)
        support = DIRECTIONS @ shown.translation + shown.support(DIRECTIONS)
        hull = HullPrior(DIRECTIONS, support, 0.003**2 * np.eye(len(support)), 2 * max(size[:2]))
        options = FitOptions(plane=table.plane, model_error=MODEL_ERROR, hull=hull)
    return body, surface_fit.fit(depth[first:], labels[first:] == 1, camera, options=options)


@pytest.mark.parametrize("dark", [0, 20])
@pytest.mark.parametrize("as_thing", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_a_can_may_be_longer_than_the_search_made_it(seed: int, as_thing: bool, dark: int) -> None:
    body, fit = lower_half(*CAN, seed, as_thing, dark)
    along = int(np.argmax(np.abs(fit.superquadric.rotation_matrix.T @ body.rotation_matrix[:, 2])))
    error = abs(fit.superquadric.size[along] - body.size[2])
    assert error < 3 * fit.sigma_size[along]
    assert fit.status == Status.WEAK or error < 0.1 * body.size[2]


@pytest.mark.parametrize("seed", range(3))
def test_the_curvature_of_a_ball_tells_how_large_it_is(seed: int) -> None:
    body, fit = lower_half(*BALL, seed)
    assert fit.status == Status.CONVERGED
    np.testing.assert_allclose(fit.superquadric.size, body.size, rtol=0.03)
