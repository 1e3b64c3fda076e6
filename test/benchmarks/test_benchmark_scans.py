"""What the benchmark of scanned objects builds on: its rasteriser, its poses and its IoU, against the package's own."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh

from sq_perception.geometry import Superquadric, metrics, rotation
from sq_perception.geometry.mesh import mesh
from sq_perception.imaging import raycast

BODY = Superquadric([0.06, 0.04, 0.03], [0.3, 0.7], [0.05, -0.03, 0.7], [0.3, -0.2, 0.5, 0.8])


@pytest.fixture(scope="module")
def scene(repository: Path) -> Iterator[ModuleType]:
    with benchmarks_on_path(repository):
        yield importlib.import_module("mesh_scene")


@pytest.fixture(scope="module")
def hulls(repository: Path) -> Iterator[ModuleType]:
    with benchmarks_on_path(repository):
        yield importlib.import_module("hull_oracle")


@contextmanager
def benchmarks_on_path(repository: Path) -> Iterator[None]:
    """The benchmarks are scripts beside each other, no package."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(repository / "benchmarks"))
        yield


def test_a_rasterised_superquadric_is_the_ray_cast_one(scene: ModuleType) -> None:
    fine = mesh(BODY, 128)
    depth = scene.render(fine.vertices, fine.faces, scene.CAMERA)
    expected, _ = raycast.render(BODY, scene.CAMERA)
    seen, truly = np.isfinite(depth), np.isfinite(expected)
    assert (seen != truly).sum() <= 0.01 * truly.sum()
    # The facets lie inside the body, the more the flatter the ray: the median is what the sampling of the mesh costs.
    error = depth[seen & truly] - expected[seen & truly]
    assert error.min() > -1e-9
    assert np.median(error) < 5e-5


def test_neighbouring_triangles_leave_no_gap(scene: ModuleType) -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.1)).subdivide().subdivide()
    vertices = box.vertices @ rotation.to_matrix(rotation.from_rotation_vector(np.array([0.4, 0.3, 0.2]))).T
    seen = np.isfinite(scene.render(vertices + [0, 0, 0.6], box.faces, scene.CAMERA))
    for line in (*seen, *seen.T):
        inside = np.flatnonzero(line)
        assert len(inside) == 0 or len(inside) == inside[-1] - inside[0] + 1


def test_a_resting_mesh_stands_on_the_plane_it_is_seen_on(scene: ModuleType, rng: np.random.Generator) -> None:
    block = trimesh.creation.box((0.04, 0.07, 0.1))
    poser = scene.resting(block)
    for _ in range(5):
        view = scene.view(block, poser, rng)
        height = (block.vertices @ view.rotation.T + view.translation) @ view.plane[:3] + view.plane[3]
        assert height.min() == pytest.approx(0, abs=1e-9)
        assert np.sum(height < 1e-9) == 4
        assert view.plane[3] > 0
        points = view.camera.points(view.depth)
        beside = points[~view.mask & np.isfinite(view.depth)] @ view.plane[:3] + view.plane[3]
        assert abs(np.median(beside)) < 1e-3
        assert (points[view.mask] @ view.plane[:3] + view.plane[3] > -0.01).all()


def test_iou_with_a_hull_is_the_iou_of_the_bodies(hulls: ModuleType, rng: np.random.Generator) -> None:
    columns = hulls.Columns.of(mesh(BODY, 128).vertices)
    assert columns.volume == pytest.approx(float(BODY.volume()), rel=2e-3)
    assert columns.iou(BODY) > 0.995
    for _ in range(5):
        turn, shift = rotation.from_rotation_vector(rng.normal(0, 0.2, 3)), rng.normal(0, 0.01, 3)
        moved = BODY.transformed(turn, BODY.translation - rotation.to_matrix(turn) @ BODY.translation + shift)
        assert columns.iou(moved) == pytest.approx(float(metrics.volume_iou(moved, BODY, 128)), abs=3e-3)
