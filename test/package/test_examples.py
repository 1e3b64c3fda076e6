"""Every script of examples/ runs as it stands, in a folder of its own, and its numbers are those of the sample."""

import importlib
import re
import runpy
import sys
from pathlib import Path

import pytest
from python_process import run_python

from sq_perception.simulation.scenes import THINGS

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
CARTON = sorted(1e3 * edge for edge in THINGS["carton"][0])
SAID = {
    "bag": (r"table.mcap 102\.0+ \{1: ", 1),
    "cloud": (r"label \d: .* mm|the can: .* IoU 0\.9", 5),
    "first_body": (r"(WEAK|CONVERGED) .* mm \+- ", 4),
    "grasp": (r"^0\.\d\d body \d at", 3),
    "parts_of_a_mug": (r"of the points: .* mm", 2),
    "planner_scene": (r"^table\.(urdf|sdf|xml|yml) ", 4),
    "renderer_gradient": (r"half height 0\.(29|30)\d of 0\.300", 1),
    "training": (r"bodies: \d+ mm", 1),
    "two_cameras": (r"^(one camera|two) .* mm \+- ", 8),
}
"""What each prints, and on how many lines at the least."""
NEEDS = {"training": "torch", "renderer_gradient": "torch", "bag": "mcap"}


def test_every_example_has_a_test_and_is_short() -> None:
    scripts = {path.stem: path.read_text(encoding="utf-8").splitlines() for path in EXAMPLES.glob("*.py")}
    assert set(scripts) == set(SAID) | {"ros_node", "pick_with_an_arm"}
    assert all(lines[0].startswith('"""') for lines in scripts.values())
    assert all(len(lines) <= 42 for name, lines in scripts.items() if name != "pick_with_an_arm")


@pytest.mark.parametrize("name", SAID)
def test_an_example_runs(name, tmp_path, monkeypatch, capsys):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *(["2"] if name == "training" else [])])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    words, lines = SAID[name]
    said = capsys.readouterr().out
    assert len(re.findall(words, said, re.MULTILINE)) >= lines, said
    if name == "first_body":
        edges = sorted(float(edge) for edge in re.findall(r"(\d+)x(\d+)x(\d+) mm", said)[0])
        assert edges == pytest.approx(CARTON, abs=8.0)


def test_the_example_of_a_node_reads_what_recover_node_answers(tmp_path):
    """The node of the package in a process of its own, the example in another one."""
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    children = importlib.import_module("started_nodes").Children
    remapped = ["--ros-args", "-r", "depth/image:=/camera/depth", "-r", "depth/camera_info:=/camera/info"]
    with children() as running:
        node = running.start("recover_node", remapped)
        done = run_python(EXAMPLES / "ros_node.py", cwd=tmp_path)
        found = re.findall(r"^\d+ x \d+ x \d+ mm at", done.stdout, re.MULTILINE)
        assert len(found) == len(THINGS), "\n".join([done.stdout, *node.last_lines()])


def test_an_arm_clears_the_table_by_what_the_nodes_answer(tmp_path):
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    pytest.importorskip("mujoco", reason="needs the extra 'picking'")
    film = tmp_path / "arm.gif"
    done = run_python(EXAMPLES / "pick_with_an_arm.py", "--film", film, cwd=tmp_path)
    assert "the table is empty" in done.stdout, done.stdout + done.stderr
    assert film.read_bytes()[:3] == b"GIF"
