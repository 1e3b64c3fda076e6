"""The demonstration: who is paired with whom, the picture, and the command as a process."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy missing: install the extra 'ros' or source ROS 2")

from sq_perception import Camera, Superquadric
from sq_perception.commands.demo import match
from sq_perception.evaluation.recovery_figure import demo_figure


def boxes(*centres: float) -> Superquadric:
    """Like boxes of different length beside each other on the x axis."""
    each = enumerate(centres)
    return Superquadric.stack(
        [Superquadric([0.03, 0.04, 0.05 + 0.01 * k], [0.3, 0.3], [x, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]) for k, x in each]
    )


def test_bodies_are_paired_by_their_overlap_whatever_their_order() -> None:
    truth = boxes(0.0, 0.3, 0.6)
    for body, (found, overlap) in zip(truth, match(truth, truth[np.array([2, 0, 1])]), strict=True):
        assert found is not None
        np.testing.assert_array_equal(found.to_flat(), body.to_flat())
        assert overlap == 1.0
    assert match(boxes(0.0, 0.5), boxes(0.0, 5.0))[1] == (None, 0.0), "what overlaps nothing is no partner"
    assert match(boxes(0.0), boxes()) == [(None, 0.0)]


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sq_perception", "demo", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_it_shows_how_well_both_methods_do_and_draws_the_last_image(tmp_path: Path) -> None:
    process = start(tmp_path, "--seconds", "4", "--output-dir", "out")
    said, errors = process.communicate(timeout=240)
    assert (process.returncode, errors) == (0, "")
    (network,) = re.findall(r"^network \+ fit +(\d+) % +([\d.]+) %", said, re.MULTILINE)
    assert int(network[0]) > 90
    assert float(network[1]) > 70
    assert "demo.png" in said
    assert cv2.imread(str(tmp_path / "out" / "demo.png")).shape[1] > 1000
    assert (tmp_path / "out" / "demo.glb").read_bytes()[:4] == b"glTF"


def test_ctrl_c_ends_it_without_a_trace(tmp_path: Path) -> None:
    process = start(tmp_path, "--seconds", "60")
    assert process.stdout is not None
    assert "Ctrl-C ends" in process.stdout.readline()
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")


def test_a_picture_without_bodies_is_drawn() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    demo_figure(np.full((48, 64), np.nan), camera, [], {"a": [], "b": []}).canvas.draw()
