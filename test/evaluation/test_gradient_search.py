"""Walks down a loss: they go down, rest where the loss is least, get stuck where the thesis says, and can be seen."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from sq_perception.commands import main
from sq_perception.evaluation.gradient_search import Subject, Walk, walk
from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.learning.regressor import RegressorConfig
from sq_perception.simulation.scenes import thesis_bodies

BODY = "0.25 0.15 0.1 0.2 0.8 0.5 0.45 0.5 0.2 -0.3 0.1 0.9"


@pytest.fixture(scope="module")
def subject() -> Subject:
    return Subject.random(7)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "view.png"
    assert main.main(["render", *BODY.split(), "--output", str(path)]) == 0
    return path


def truth_of(subject: Subject) -> Superquadric:
    assert subject.truth is not None
    return subject.truth


def turned(body: Superquadric, axis: int, degrees: float = 90.0) -> Superquadric:
    turn = quaternions.from_rotation_vector(np.deg2rad(degrees) * np.eye(3)[axis])
    return replace(body, rotation=quaternions.multiply(body.rotation, turn))


def walked(subject: Subject, start: Superquadric, loss: str, steps: int) -> Walk:
    return walk(subject, start, loss, steps)


def disturbed(body: Superquadric, rng: np.random.Generator) -> Superquadric:
    """Another body nearby: sizes by about a quarter, exponents by 0.2, angles by 17 degrees an axis."""
    return Superquadric(
        np.clip(body.size * np.exp(0.25 * rng.standard_normal(3)), *RegressorConfig().size_range),
        np.clip(body.shape + 0.2 * rng.standard_normal(2), 0.15, 0.95),
        body.translation + 0.06 * rng.standard_normal(3),
        quaternions.multiply(body.rotation, quaternions.from_rotation_vector(0.3 * rng.standard_normal(3))),
    )


class TestParametrisation:
    def test_decoding_undoes_encoding(self) -> None:
        bodies = thesis_bodies(50, np.random.default_rng(0))
        ranges = RegressorConfig()
        again = ranges.decode(torch.from_numpy(ranges.encode(bodies)))
        assert np.abs(again.size.numpy() - bodies.size).max() < 1e-9
        assert np.abs(again.translation.numpy() - bodies.translation).max() < 1e-9
        assert np.abs(again.shape.numpy() - bodies.shape).max() < 1e-3  # exponents on their limit leave it by so much
        assert quaternions.geodesic_angle(again.rotation.numpy(), np.array(bodies.rotation)).max() < 1e-6

    def test_the_limits_have_a_slope_and_what_lies_beyond_is_refused(self) -> None:
        ranges = RegressorConfig()
        sharp = Superquadric([ranges.size_range[0]] * 3, [0.1, 1.0], [0.5] * 3, [0, 0, 0, 1.0])
        raw = torch.from_numpy(ranges.encode(sharp)).requires_grad_()
        ranges.decode(raw).shape.sum().backward()
        assert raw.grad is not None
        assert (raw.grad[3:5] > 0).all()
        for wrong in (replace(sharp, size=np.full(3, 5.0)), replace(sharp, shape=np.array([0.1, 1.5]))):
            with pytest.raises(ValueError, match="expected values in"):
                ranges.encode(wrong)


class TestWalk:
    @pytest.mark.parametrize(
        ("loss", "steps", "reached"), [("occupancy", 80, 0.95), ("render", 50, 0.8), ("least_squares_free", 80, 0.85)]
    )
    def test_a_disturbed_start_goes_down_to_the_body(
        self, subject: Subject, loss: str, steps: int, reached: float
    ) -> None:
        start = disturbed(truth_of(subject), np.random.default_rng([7, 1]))
        found = walked(subject, start, loss, steps)
        assert found.iou is not None
        assert len(found) == len(found.bodies) == len(found.iou) == steps + 1
        assert volume_iou(found.bodies[0], start) == pytest.approx(1, abs=0.01)
        assert found.losses[-1] < 0.2 * found.losses[0]
        assert found.iou[0] < 0.75
        assert found.iou[-1] > reached

    def test_the_truth_stays_put_under_occupancy(self, subject: Subject) -> None:
        found = walked(subject, truth_of(subject), "occupancy", 20)
        assert found.iou is not None
        assert found.iou.min() > 0.99
        assert found.losses.max() < 1e-6

    def test_a_quarter_turn_is_a_trap_for_the_rotation_alone(self, subject: Subject) -> None:
        """Figures 6.3 and 6.4: with all else given, a perpendicular body finds no way back; a lesser turn does."""
        trapped = walked(subject, turned(truth_of(subject), 2), "occupancy_rotation", 100)
        free = walked(subject, turned(truth_of(subject), 2, 30.0), "occupancy_rotation", 100)
        assert trapped.iou is not None
        assert free.iou is not None
        assert trapped.iou.max() < 0.8
        assert np.ptp(trapped.losses[-40:]) < 1e-3 * trapped.losses[-1]
        assert free.iou[-1] > 0.99
        np.testing.assert_array_equal(trapped.bodies.size, np.broadcast_to(truth_of(subject).size, (101, 3)))

    def test_all_parameters_lead_out_of_the_trap(self, subject: Subject) -> None:
        """Chapter 6.5.3: the sizes change places where the rotation alone would have to pass over a ridge."""
        found = walked(subject, turned(truth_of(subject), 2), "occupancy", 100)
        assert found.iou is not None
        assert found.iou[-1] > 0.95

    def test_misuse_is_named(self, subject: Subject) -> None:
        start = truth_of(subject)
        with pytest.raises(ValueError, match="not known"):
            walk(replace(subject, truth=None), start, "dual", 1)
        with pytest.raises(ValueError, match="expected one of"):
            walk(subject, start, "magic", 1)
        with pytest.raises(ValueError, match="no object"):
            Subject.of_image(np.full((32, 32), np.nan, np.float32), subject.camera.cropped(0, 0, 32, 32))


class TestCommand:
    def test_writes_film_frames_and_table(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        film, folder, table = tmp_path / "walk.gif", tmp_path / "frames", tmp_path / "walk.csv"
        command = ["gradient-search", "--seed", "3", "--start", "truth", "--turn", "0", "30", "0", "--steps", "2"]
        assert main.main([*command, "--output", str(film)]) == 0
        assert main.main([*command, "--output", str(folder), "--table", str(table)]) == 0
        assert "IoU" in capsys.readouterr().out
        with Image.open(film) as opened:
            assert (opened.format, getattr(opened, "n_frames", 1)) == ("GIF", 3)
        assert [path.name for path in sorted(folder.iterdir())] == [f"step_{k:05d}.png" for k in range(3)]
        picture = cv2.imread(str(folder / "step_00002.png"))
        assert picture is not None
        assert picture.std() > 20
        with table.open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == 3
        last = Superquadric.from_flat(np.array([float(rows[-1][k]) for k in list(rows[-1])[3:]]))
        truth = thesis_bodies(1, np.random.default_rng(3))[0]
        assert volume_iou(last, truth) == pytest.approx(float(rows[-1]["iou"]), abs=0.01)  # both in the cube frame

    def test_an_image_without_truth_is_walked_on_by_what_it_shows(self, tmp_path: Path, image: Path) -> None:
        table = tmp_path / "walk.csv"
        command = ["gradient-search", str(image), "--loss", "least_squares", "--turn", "0", "0", "40", "--steps", "20"]
        assert main.main([*command, "--table", str(table)]) == 0
        with table.open(newline="") as file:
            steps = list(csv.DictReader(file))
        start = [float(steps[0][name]) for name in ("t1", "t2")]
        np.testing.assert_allclose(start, [float(word) for word in BODY.split()[5:7]], atol=0.05)
        assert float(steps[-1]["loss"]) < float(steps[0]["loss"])
        assert steps[-1]["iou"] == ""

    @pytest.mark.parametrize(
        ("wrong", "sentence"),
        [
            (["IMAGE", "--loss", "occupancy"], "compares with the true body"),
            (["IMAGE", "--loss", "render", "--start", "truth"], "needs the true body"),
            (["IMAGE", "--loss", "render", "--learning-rate", "nan"], "expected a positive number"),
            (["IMAGE", "--loss", "render", "--output", "walk.mp4"], ".gif or a folder"),
            (["IMAGE", "--seed", "1"], "IMAGE, or --seed"),
            (["--seed", "1", "--steps", "0"], "--steps"),
            ([], "IMAGE, or --seed"),
        ],
    )
    def test_misuse_is_refused_in_words(
        self, image: Path, wrong: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        words = [str(image) if word == "IMAGE" else word for word in wrong]
        assert main.main(["gradient-search", *words]) == main.USAGE
        assert sentence in " ".join(capsys.readouterr().err.split())

    def test_a_missing_image_is_a_failure(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main.main(["gradient-search", "missing.png", "--loss", "render"]) == main.FAILURE
        assert "no such file" in capsys.readouterr().err
