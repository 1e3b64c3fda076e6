"""Parts and cavities of objects: what was seen of them is found, and nothing else is."""

from types import SimpleNamespace

import numpy as np
import pytest
from table_scenes import VGA, Table

from sq_perception.fitting.fit import Fit, Status
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.decomposition import decompose
from sq_perception.recovery.parts import Evidence
from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions, render_recovery
from sq_perception.simulation.rendering import render_things

WITH_PARTS = RecoveryOptions(method="symmetry", parts=True)
NOISE = 0.001
ROUND = (0.2, 1.0)


@pytest.fixture(scope="module")
def recoverer():
    return Recoverer(method="symmetry", threads=1)


def hammer(table):
    """A handle that lies along x, and a head across its end."""
    handle = table.body(0.0, 0.0, (0.09, 0.014, 0.014), height=0.006)
    return [handle, table.body(0.1, 0.0, (0.018, 0.06, 0.02))]


def see_as_one(table, bodies, seed, others=()):
    depth, labels = table.see([*bodies, *others], NOISE, seed)
    return depth, np.where((labels > 0) & (labels <= len(bodies)), 1, np.where(labels > 0, 2, 0)).astype(np.int32)


def union_iou(one, other):
    low, high = (np.array(ends) for ends in zip(*(body.bounding_box() for body in [*one, *other]), strict=True))
    tested = np.random.default_rng(0).uniform(low.min(axis=0), high.max(axis=0), (20_000, 3))
    inside = [np.any([body.gauge(tested) <= 1 for body in bodies], axis=0) for bodies in (one, other)]
    return np.count_nonzero(inside[0] & inside[1]) / np.count_nonzero(inside[0] | inside[1])


@pytest.mark.parametrize("seed", range(4))
def test_a_hammer_is_its_handle_and_its_head(recoverer, seed):
    table = Table(pitch=0.9 + 0.1 * seed, distance=0.7)
    bodies = hammer(table)
    depth, labels = see_as_one(table, bodies, seed)
    (found,) = recoverer.recover(depth, VGA, labels, WITH_PARTS).bodies
    assert found.parts is not None
    assert len(found.parts) == 2
    assert found.parts.shares.sum() > 0.9
    assert all(fit.status != Status.FAILED and np.isfinite(fit.covariance).all() for fit in found.parts)
    assert union_iou(found.solids, bodies) > union_iou([found.superquadric], bodies) + 0.15


def test_the_body_is_the_same_with_parts_and_without(recoverer):
    table = Table(distance=0.7)
    depth, labels = see_as_one(table, hammer(table), 0)
    (without,) = recoverer.recover(depth, VGA, labels, RecoveryOptions(method="symmetry")).bodies
    (found,) = recoverer.recover(depth, VGA, labels, WITH_PARTS).bodies
    np.testing.assert_array_equal(found.superquadric.to_numbers(), without.superquadric.to_numbers())
    assert without.parts is None
    assert len(without.solids) == 1


def test_an_object_of_a_frame_is_decomposed_like_a_cloud():
    table = Table(distance=0.7)
    bodies = hammer(table)
    depth, labels = see_as_one(table, bodies, 0)
    frame = SimpleNamespace(depth=depth, camera=VGA, labels=labels)
    parts = decompose(frame)
    assert union_iou(list(parts.superquadrics), bodies) > 0.6
    assert len(parts) == 2
    assert len(decompose(frame, most=1)) == 1
    for wrong in (None, np.zeros_like(labels), labels + 2 * (np.arange(labels.shape[1]) < 40)):
        with pytest.raises(ValueError, match="labels: expected the mask of one object"):
            decompose(SimpleNamespace(depth=depth, camera=VGA, labels=wrong))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("size", "shape"), [((0.05, 0.03, 0.06), (0.1, 0.1)), ((0.03, 0.03, 0.06), ROUND)])
def test_a_box_and_a_can_are_one_body(recoverer, size, shape, seed):
    table = Table(pitch=0.6 + 0.2 * seed)
    depth, labels = table.see([table.body(0.0, 0.0, size, shape, turn=0.5 * seed)], NOISE, seed)
    (found,) = recoverer.recover(depth, VGA, labels, WITH_PARTS).bodies
    assert found.parts is None


@pytest.mark.parametrize("seed", range(3))
def test_a_head_that_is_hidden_is_not_invented(recoverer, seed):
    """A box stands before the head: the handle alone is seen, and is one body."""
    table = Table(pitch=0.7, distance=0.7)
    bodies = hammer(table)
    others = [table.body(0.11, -0.06, (0.04, 0.09, 0.09))]
    assert not (table.see([*bodies, *others])[1] == 2).any()
    depth, labels = see_as_one(table, bodies, seed, others)
    found = next(body for body in recoverer.recover(depth, VGA, labels, WITH_PARTS).bodies if body.label == 1)
    assert found.parts is None


def test_parts_are_seen_where_the_object_was(recoverer):
    table = Table(pitch=1.0, distance=0.7)
    depth, labels = see_as_one(table, hammer(table), 0)
    rendered, index = render_recovery(recoverer.recover(depth, VGA, labels, WITH_PARTS), VGA)
    both = np.count_nonzero((index == 0) & (labels == 1))
    assert both > 0.9 * np.count_nonzero((index == 0) | (labels == 1))
    assert np.median(np.abs(rendered - depth)[(index == 0) & (labels == 1)]) < 2 * NOISE


def test_what_a_body_leaves_unexplained_is_counted_by_hand():
    """Before a wall 1 m behind stands a square plate, 0.2 by 0.2 m, at 1 m, all of whose pixels are noise of 10 mm off:
    a body of its width that is 20 mm too near misses each by 2 noise levels, one twice as wide covers free pixels too.
    """
    camera = Camera(100, 100, 100.0, 100.0, 49.5, 49.5)
    v, u = np.indices((100, 100))
    mask = np.maximum(np.abs(u - 49.5), np.abs(v - 49.5)) < 10
    evidence = Evidence(np.where(mask, 1.0, 2.0), mask, camera, 0.01)

    def plate(near, half):
        at = near * half
        body = Superquadric([at, at, 0.05], [0.05, 0.05], [0.0, 0.0, near + 0.05], [0.0, 0.0, 0.0, 1.0])
        return Fit(body, 0.0, Status.CONVERGED, "")

    assert evidence.weigh([plate(1.0, 0.1)]).misfit == pytest.approx(0.0, abs=0.01)
    assert evidence.weigh([plate(0.98, 0.1)]).misfit == pytest.approx(4.0, rel=0.01)
    wide = evidence.weigh([plate(1.0, 0.2)])
    assert wide.through == pytest.approx(3.0, rel=0.02)
    assert wide.misfit == pytest.approx(27.0, rel=0.02)
    halves = evidence.weigh([plate(1.0, 0.05), plate(1.001, 0.1)])
    np.testing.assert_allclose(halves.shares, [0.25, 0.75], atol=0.02)


@pytest.mark.parametrize("pixels", [1, 12, 23])
def test_fewer_pixels_than_two_bodies_need_give_no_parts_and_no_error(recoverer, pixels):
    table = Table(distance=0.7)
    depth, labels = see_as_one(table, hammer(table), 0)
    few = np.zeros_like(labels)
    few.flat[np.flatnonzero(labels == 1)[:: max(1, np.count_nonzero(labels == 1) // pixels)][:pixels]] = 1
    assert all(body.parts is None for body in recoverer.recover(depth, VGA, few, WITH_PARTS).bodies)


RADIUS, HEIGHT, WALL = 0.045, 0.1, 0.004
SQUARE_EDGED = (0.05, 1.0)


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


def test_a_floor_is_known_from_a_wall_and_an_opening_that_faces_away_is_not_guessed(recoverer):
    assert cavity(recoverer, *see(1.2, 0.03)[:2]).sees_floor
    assert not cavity(recoverer, *see(0.6, 0.09)[:2]).sees_floor
    image, labels, _, _ = see(-0.4, 0.07)
    assert cavity(recoverer, image, labels) is None


@pytest.mark.parametrize("pitch", [0.5, 0.8, 1.2, 1.5])
@pytest.mark.parametrize("depth", [0.0, 0.002])
def test_a_lid_is_no_cavity(recoverer, pitch, depth):
    assert cavity(recoverer, *see(pitch, depth)[:2]) is None
