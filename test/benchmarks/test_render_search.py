"""The grid search of figure 7.6: what it computes, and that the script draws it."""


import cv2
import numpy as np
import pytest
import render_search
import torch
from render_search import search
from unit_axis import soft_images

from sq_perception.geometry import Superquadric
from sq_perception.imaging import raycast, soft_render, unit_cube
from sq_perception.simulation.scenes import thesis_bodies


def test_error_is_that_of_the_two_renderers() -> None:
    bodies = thesis_bodies(2, np.random.default_rng(0))
    found = search(bodies, np.array([20.0, 117.3]), np.array([0.5, 4.82]), 32)
    tensors = Superquadric.from_flat(torch.tensor(bodies.to_flat()))
    soft = soft_images(tensors, soft_render.grid_points(32), 117.3, 0.5).numpy()
    error = 0.0
    for body, image in zip(bodies, soft, strict=True):
        depth, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera(32))
        error += np.abs(unit_cube.grey_from_depth(depth) / 255 - image).mean() / 2
    assert found.error[1, 0] == pytest.approx(error, rel=1e-4)
    assert found.best == (117.3, 4.82, found.error.min())


def test_thesis_parameters_do_as_well_as_the_thesis_says() -> None:
    found = search(thesis_bodies(4, np.random.default_rng(1)), np.array([117.3]), np.array([4.82]))
    assert found.best[2] < 0.0056


def test_the_script_prints_the_optimum_and_draws_the_map(capsys, tmp_path, monkeypatch) -> None:
    picture = tmp_path / "map.png"
    arguments = ["--bodies", "2", "--resolution", "16", "--steps", "4", "--picture", str(picture)]
    monkeypatch.setattr("sys.argv", ["render_search.py", *arguments])
    render_search.main()
    assert "least MAE" in capsys.readouterr().out
    assert cv2.imread(str(picture)) is not None
