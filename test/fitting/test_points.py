"""One body to points from all sides or some: closed forms, invariances, outliers, calibration, bad input."""

import tracemalloc

import numpy as np
import pytest
import trimesh

import sq_perception as sq
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.simulation.scenes import sample, thesis_bodies

BODY = sq.Superquadric(
    np.array([0.05, 0.03, 0.08]), np.array([0.3, 0.7]), np.array([0.1, -0.2, 0.5]), np.array([0.3, -0.2, 0.5, 0.8])
)


def cloud(body: sq.Superquadric, count: int, noise: float, outliers: float, seed: int) -> np.ndarray:
    """Points of the whole surface with normal noise, and outliers in a box half as large again."""
    rng = np.random.default_rng(seed)
    points = body.sample_surface(count, rng) + noise * rng.standard_normal((count, 3))
    low, high = body.bounding_box()
    strays = (low + high) / 2 + 0.75 * (high - low) * rng.uniform(-1, 1, (round(outliers * count), 3))
    points[: len(strays)] = strays
    return points[rng.permutation(count)]


def iou(fit: sq.Fit, body: sq.Superquadric) -> float:
    return float(volume_iou(fit.superquadric, body))


def test_an_exact_cloud_gives_the_body_back_and_a_straight_body_is_not_tapered() -> None:
    fit = sq.fit_points(cloud(BODY, 1200, 0.0, 0.0, 0))
    assert fit.status == sq.Status.CONVERGED, fit.message
    assert iou(fit, BODY) > 0.998
    assert np.allclose(np.sort(fit.superquadric.size), np.sort(BODY.size), rtol=1e-3)
    assert fit.inlier_share > 0.99
    assert not sq.fit_points(cloud(BODY, 1500, 0.001, 0.1, 2)).superquadric.taper.any()


@pytest.mark.parametrize("k", [(0.5, 0.5), (-0.4, 0.1)])
def test_a_tapered_body_is_found_as_one(k: tuple[float, float]) -> None:
    body = sq.Superquadric(BODY.size, BODY.shape, BODY.translation, BODY.rotation, np.array(k))
    points = cloud(body, 1500, 0.0, 0.0, 1)
    tapered, straight = sq.fit_points(points), sq.fit_points(points, taper=False)
    assert np.allclose(np.sort(np.abs(tapered.superquadric.taper)), np.sort(np.abs(k)), atol=0.01)
    assert not straight.superquadric.taper.any()
    assert tapered.residual < 0.2 * straight.residual


@pytest.mark.parametrize("outliers", [0.2, 0.6])
def test_outliers_are_told_from_the_body_and_counted(outliers: float) -> None:
    fit = sq.fit_points(cloud(BODY, 1500, 0.0005, outliers, 3))
    assert iou(fit, BODY) > 0.95
    assert fit.inlier_share == pytest.approx(1 - outliers, abs=0.05)
    assert fit.noise == pytest.approx(0.0005, rel=0.2)
    assert (fit.status == sq.Status.CONVERGED) == (outliers < 0.3), fit.message


def test_half_sizes_are_as_sure_as_they_are_right() -> None:
    """Of 40 bodies with noise and outliers; a share of 0.95 of 120 has a standard deviation of 0.02."""
    bodies = thesis_bodies(40, np.random.default_rng(4))
    within = []
    for k, body in enumerate(bodies):
        fit = sq.fit_points(cloud(body, 700, 0.03 * float(body.size.min()), 0.1, k))
        turn = np.abs(fit.superquadric.rotation_matrix.T @ body.rotation_matrix)
        error = fit.superquadric.size - body.size[turn.argmax(axis=1)]
        within += (np.abs(error) < 2 * fit.sigma_size).tolist()
    assert 0.87 < np.mean(within) <= 1.0


def test_neither_frame_nor_scale_nor_order_matters() -> None:
    points = cloud(BODY, 900, 0.001, 0.1, 5)
    fit = sq.fit_points(points)
    turn, shift, scale = quaternions.random(1, np.random.default_rng(6))[0], np.array([3.0, -1.0, 2.0]), 250.0
    moved = scale * points[np.random.default_rng(7).permutation(900)] @ quaternions.to_matrix(turn).T + shift
    other = sq.fit_points(moved)
    assert float(volume_iou(other.superquadric, fit.superquadric.transformed(turn, shift, scale))) > 0.995
    assert np.allclose(np.sort(other.sigma_size), scale * np.sort(fit.sigma_size), rtol=0.3)
    assert sq.fit_points(points).superquadric.to_numbers().tolist() == fit.superquadric.to_numbers().tolist()


def test_density_does_not_matter_and_a_million_points_are_thinned() -> None:
    dense = cloud(BODY, 20_000, 0.0005, 0.2, 8)
    huge = np.concatenate([dense] * 50) + 1e-4 * np.random.default_rng(9).standard_normal((1_000_000, 3))
    for points in (dense, huge):
        fit = sq.fit_points(points)
        assert iou(fit, BODY) > 0.97
        assert fit.inlier_share == pytest.approx(0.8, abs=0.05)


def test_half_a_cloud_says_that_it_is_one() -> None:
    """Of a box seen face-on, depth and the place of the back are open; of one seen from a corner they are not."""
    box = sq.Superquadric.at_origin(np.array([0.05, 0.04, 0.03]), np.array([0.1, 0.1]))
    points = box.sample_surface(6000, np.random.default_rng(10))
    assert sq.fit_points(points[points[:, 2] > 0.0299]).status != sq.Status.CONVERGED
    corner = sq.fit_points(points[box.normals(points) @ [0.5, 0.6, 0.62] > 0.2])
    assert "seen from one side" in corner.message
    assert iou(corner, box) > 0.9


def test_normals_tell_inside_from_outside() -> None:
    points = cloud(BODY, 800, 0.0005, 0.0, 11)
    normals = 3.0 * BODY.normals(points)
    normals[::7] = np.nan
    assert iou(sq.fit_points(points, normals), BODY) > 0.98


def test_a_mesh_is_fitted_by_points_of_its_faces() -> None:
    fit = sq.fit_mesh(trimesh.creation.cylinder(radius=0.03, height=0.1))
    assert iou(fit, sq.Superquadric.at_origin(np.array([0.03, 0.03, 0.05]), np.array([0.1, 1.0]))) > 0.97
    broken = trimesh.Trimesh(np.eye(3), np.array([[0, 1, 2]]), process=False)
    broken.faces = np.array([[0, 1, 7]])
    with pytest.raises(ValueError, match="mesh"):
        sq.fit_mesh(broken)


@pytest.mark.parametrize("fit", [sq.fit_points, sq.decompose])
@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((1, 3)), "1 points; a fit needs 12"),
        (np.ones((50, 3)), "one line"),
        (np.linspace(0, 1, 50)[:, None] * [1.0, 2.0, 3.0], "one line"),
        (np.random.default_rng(0).random((400, 3)) * [1.0, 1.0, 0.0], "one plane"),
        (np.where(np.arange(600)[:, None] % 3, cloud(BODY, 600, 0.0, 0.0, 14), np.nan), "converged"),
        (np.tile(cloud(BODY, 1000, 0.0, 0.0, 15), (1000, 1)), "converged"),
    ],
    ids=["one", "same", "line", "plane", "gaps", "million"],
)
def test_hard_clouds_get_an_answer_in_words(fit, points: np.ndarray, reason: str) -> None:
    tracemalloc.start()
    answer = fit(points)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert answer.status == (sq.Status.CONVERGED if reason == "converged" else sq.Status.FAILED)
    assert reason in answer.message
    assert peak < 16 * points.nbytes + 1e8


def test_a_mesh_without_area_and_a_scene_are_no_sure_body() -> None:
    frame = sample()
    rows, columns = np.nonzero(np.isfinite(frame.depth))
    scene = frame.camera.unproject(columns, rows, frame.depth[rows, columns].astype(float))
    for fit in (sq.fit_points, sq.decompose):
        assert fit(scene).status != sq.Status.CONVERGED
    for fit in (sq.fit_mesh, sq.decompose):
        with pytest.raises(ValueError, match="faces with an area"):
            fit(trimesh.Trimesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), process=False))


def test_two_objects_in_one_cloud_are_no_sure_body() -> None:
    other = BODY.transformed(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.3, 0.0, 0.0]))
    both = np.concatenate([cloud(BODY, 700, 0.0, 0.0, 12), cloud(other, 700, 0.0, 0.0, 13)])
    assert sq.fit_points(both).status != sq.Status.CONVERGED
    parts = sq.decompose(both)
    assert len(parts) == 2
    middles = np.array([BODY.translation, other.translation, (BODY.translation + other.translation) / 2])
    assert parts.contains(middles).tolist() == [True, True, False]


def test_misuse_raises() -> None:
    points = cloud(BODY, 600, 0.0, 0.0, 14)
    for wrong, message in (
        ({"points": np.zeros((5, 2))}, "shape"),
        ({"points": np.full((5, 3), np.nan)}, "no finite point"),
        ({"points": points, "normals": np.zeros((3, 3))}, "normals"),
        ({"points": points, "outliers": 1.0}, "outliers"),
        ({"points": points, "sigma": 0.0}, "sigma"),
    ):
        with pytest.raises(ValueError, match=message):
            sq.fit_points(**wrong)
