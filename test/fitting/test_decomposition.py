"""Several bodies to one object: how many, where, how sure; from clouds and from meshes."""

import numpy as np
import pytest
import trimesh

import sq_perception as sq
from sq_perception.fitting.decomposition import decompose_all


def body(size: list[float], shape: list[float], at: list[float]) -> sq.Superquadric:
    return sq.Superquadric(np.array(size), np.array(shape), np.array(at), np.array([0.0, 0.0, 0.0, 1.0]))


HAMMER = [body([0.01, 0.012, 0.1], [0.2, 0.8], [0, 0, 0]), body([0.05, 0.02, 0.02], [0.2, 0.3], [0, 0, 0.11])]


def surface(parts: list[sq.Superquadric], count: int, seed: int) -> np.ndarray:
    """Points of the surface of a union, even in area."""
    rng = np.random.default_rng(seed)
    areas = [float(trimesh.convex.convex_hull(part.sample_surface(3000, rng)).area) for part in parts]
    found = []
    for part, area in zip(parts, areas, strict=True):
        points = part.sample_surface(round(count * area / sum(areas)), rng)
        others = [other for other in parts if other is not part]
        found.append(points[np.all([other.gauge(points) > 1 for other in others] or [np.ones(len(points))], axis=0)])
    return np.concatenate(found)


def solid_iou(parts: sq.Parts, truth: list[sq.Superquadric], seed: int = 0) -> float:
    points = surface(truth, 2000, seed)
    low, high = points.min(axis=0), points.max(axis=0)
    grid = np.random.default_rng(seed).uniform(low - 0.1 * (high - low), high + 0.1 * (high - low), (20_000, 3))
    inside = np.any([part.gauge(grid) <= 1 for part in truth], axis=0)
    found = parts.contains(grid)
    return float(np.count_nonzero(inside & found) / np.count_nonzero(inside | found))


def test_a_hammer_is_a_handle_and_a_head_and_distances_are_those_of_the_nearer() -> None:
    parts = sq.decompose(surface(HAMMER, 4000, 1))
    assert len(parts) == 2
    assert parts.status == sq.Status.CONVERGED, parts.message
    assert solid_iou(parts, HAMMER) > 0.93
    assert parts.shares.sum() > 0.9
    assert (parts.shares[:-1] >= parts.shares[1:]).all()
    for fit in parts:
        assert np.isfinite(fit.covariance).all()
        assert (np.linalg.eigvalsh(fit.covariance) > 0).all()
    points = np.random.default_rng(5).uniform(-0.2, 0.2, (500, 3))
    each = np.stack([fit.signed_distance(points) for fit in parts])
    assert np.array_equal(parts.signed_distance(points), each.min(axis=0))
    assert (parts.signed_distance(points, 2.0) <= parts.signed_distance(points)).all()


def test_one_body_stays_one() -> None:
    for k, shape in enumerate([[0.1, 0.1], [1.0, 1.0], [0.2, 1.0]]):
        assert len(sq.decompose(surface([body([0.04, 0.05, 0.07], shape, [0, 0, 0])], 2000, k))) == 1


def test_most_bounds_the_number_and_the_same_comes_again() -> None:
    points = surface(HAMMER, 3000, 2)
    assert len(sq.decompose(points, most=1)) == 1
    first, again = sq.decompose(points), sq.decompose(points)
    assert first.superquadrics.to_numbers().tolist() == again.superquadrics.to_numbers().tolist()
    with pytest.raises(ValueError, match="most"):
        sq.decompose(points, most=0)


def test_many_objects_are_as_each_alone() -> None:
    clouds = [surface(HAMMER, 1500, 6), surface(HAMMER[:1], 1500, 7)]
    for together, cloud in zip(decompose_all(clouds, jobs=2), clouds, strict=True):
        assert together.superquadrics.to_numbers().tolist() == sq.decompose(cloud).superquadrics.to_numbers().tolist()


def test_neither_scale_nor_frame_changes_the_parts() -> None:
    points = surface(HAMMER, 3000, 3)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = sq.decompose(100 * points @ turn.T + [5.0, 6.0, 7.0])
    back = (moved.superquadrics.translation - [5.0, 6.0, 7.0]) @ turn / 100
    assert np.allclose(back, sq.decompose(points).superquadrics.translation, atol=2e-3)


def test_a_mesh_is_taken_apart() -> None:
    handle = trimesh.creation.cylinder(radius=0.01, height=0.2)
    head = trimesh.creation.box((0.1, 0.03, 0.03))
    head.apply_translation([0, 0, 0.115])
    parts = sq.decompose(trimesh.util.concatenate([handle, head]))
    assert len(parts) == 2
    where = np.array([[0, 0, -0.08], [0.045, 0, 0.115], [0.045, 0, -0.08]])
    assert parts.contains(where).tolist() == [True, True, False]
