"""Cavities of vessels: an open cup has one where it is and as deep as it is, a full one and one from below has none."""

import numpy as np
import pytest
from table_scenes import VGA

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions
from sq_perception.simulation.rendering import render_things

RADIUS, HEIGHT, WALL, NOISE = 0.045, 0.1, 0.004, 0.001
SQUARE_EDGED = (0.05, 1.0)


@pytest.fixture(scope="module")
def recoverer():
    return Recoverer(method="symmetry", threads=1)


def see(pitch, depth):
    """The image of a cup 0.7 m away on a table, with a cavity so deep, its mask, and its rim's centre and axis."""
    up = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
    turn = quaternions.from_matrix(np.stack([[1.0, 0.0, 0.0], np.cross(up, [1.0, 0.0, 0.0]), up], axis=1))
    place = np.array([0.0, 0.0, 0.7])
    rim = place + 0.5 * HEIGHT * up
    cup = Superquadric.stack([Superquadric([RADIUS, RADIUS, HEIGHT / 2], SQUARE_EDGED, place, turn)])
    hole = Superquadric([RADIUS - WALL, RADIUS - WALL, depth or 1.0], SQUARE_EDGED, rim, turn)
    plane = np.append(up, 0.5 * HEIGHT - up @ place)
    image, index = render_things(
        cup, np.zeros(1, int), Superquadric.stack([hole] if depth else []), np.zeros(int(depth > 0), int), VGA, plane
    )
    image = image + NOISE * np.random.default_rng(0).standard_normal(image.shape)
    return image.astype(np.float32), (index == 0).astype(np.int32), rim, up


def cavity(recoverer, image, labels, parts=True):
    (found,) = recoverer.recover(image, VGA, labels, RecoveryOptions(method="symmetry", parts=parts)).bodies
    return found.cavity


@pytest.mark.parametrize("pitch", [0.8, 1.2])
@pytest.mark.parametrize("depth", [0.03, 0.07])
def test_an_open_cup_has_its_rim_and_its_depth(recoverer, pitch, depth):
    image, labels, rim, up = see(pitch, depth)
    found = cavity(recoverer, image, labels)
    assert found is not None
    np.testing.assert_allclose(found.rim, rim, atol=0.006)
    assert found.axis @ up > np.cos(0.06)
    np.testing.assert_allclose(found.half_widths, RADIUS, atol=0.004)
    if found.sees_floor:
        assert found.depth == pytest.approx(depth, abs=0.006)
    else:
        assert 0.01 < found.depth < depth + 0.006
    assert cavity(recoverer, image, labels, parts=False) is None  # looked for with parts alone


def test_a_floor_is_known_from_a_wall(recoverer):
    assert cavity(recoverer, *see(1.2, 0.03)[:2]).sees_floor
    assert not cavity(recoverer, *see(0.6, 0.09)[:2]).sees_floor


@pytest.mark.parametrize("pitch", [0.5, 0.8, 1.2, 1.5])
@pytest.mark.parametrize("depth", [0.0, 0.002])
def test_a_lid_is_no_cavity(recoverer, pitch, depth):
    assert cavity(recoverer, *see(pitch, depth)[:2]) is None


def test_an_opening_that_faces_away_is_not_guessed(recoverer):
    image, labels, _, _ = see(-0.4, 0.07)
    assert cavity(recoverer, image, labels) is None
