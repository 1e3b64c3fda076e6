"""The demonstration from its parts to real processes: who is paired with whom, what is printed, what is left behind."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("rclpy", reason="rclpy missing: install the extra 'ros' or source ROS 2")

import sq_perception
from sq_perception.commands import children as children_module
from sq_perception.commands import demo, demonstration
from sq_perception.commands.children import Child, Children, parameter_arguments
from sq_perception.evaluation.demo_figure import demo_figure
from sq_perception.evaluation.demo_table import alike, demo_table, pair
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.nodes import fast_dds

ROOT = str(Path(sq_perception.__file__).parent.parent)
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def boxes(*centres: float) -> Superquadric:
    """Like boxes of different length beside each other on the x axis."""
    count = len(centres)
    size = np.array([[0.03, 0.04, 0.05 + 0.01 * k] for k in range(count)]).reshape(count, 3)
    translation = np.array([[x, 0.0, 1.0] for x in centres]).reshape(count, 3)
    return Superquadric(size, np.full((count, 2), 0.3), translation, np.tile(IDENTITY, (count, 1)))


# Pairs


def test_the_same_bodies_in_another_order_are_paired_with_full_overlap() -> None:
    truth = boxes(0.0, 0.3, 0.6)
    order = np.array([2, 0, 1])
    pairs = pair(truth, truth[order])
    assert [(one.truth, one.recovered) for one in pairs] == [(0, 1), (1, 2), (2, 0)]
    assert [one.iou for one in pairs] == [1.0, 1.0, 1.0]


def test_what_is_missing_and_what_is_too_much_is_said() -> None:
    pairs = pair(boxes(0.0, 0.5), boxes(0.0, 5.0))
    assert [(one.truth, one.recovered) for one in pairs] == [(0, 0), (1, None), (None, 1)]
    assert pairs[1].iou is None
    assert pair(boxes(), boxes(0.0))[0].truth is None
    assert pair(boxes(0.0), boxes())[0].recovered is None


def test_two_blocks_that_overlap_by_half_have_an_iou_of_a_third() -> None:
    block = Superquadric(np.full((1, 3), 0.1), np.full((1, 2), 0.02), np.zeros((1, 3)), IDENTITY[None])
    moved = Superquadric(block.size, block.shape, np.array([[0.1, 0.0, 0.0]]), block.rotation)
    assert pair(block, moved)[0].iou == pytest.approx(1 / 3, abs=0.02)


def test_of_the_eight_forms_the_one_like_the_truth_is_shown(rng: np.random.Generator) -> None:
    body = Superquadric(np.array([0.03, 0.05, 0.04]), np.array([0.4, 0.7]), np.zeros(3), rng.normal(size=4))
    for form in body.equivalent_forms():
        shown = alike(form, body)
        np.testing.assert_allclose(shown.size, body.size)
        np.testing.assert_allclose(np.abs(shown.rotation @ body.rotation), 1.0)


# Table


def shown(truth: Superquadric | None, one: Superquadric, other: Superquadric, **latencies) -> list[str]:
    """The rows of the table as a terminal of 200 columns has them, and the line below it; blanks are single ones."""
    console = Console(width=200, file=io.StringIO())
    methods = {"recover_node": one, "fitter_node": other}
    results = {name: (bodies, np.full(len(bodies), 0.0012)) for name, bodies in methods.items()}
    console.print(demo_table(truth, results, "mm", "image 7", latencies))
    text = console.file.getvalue().translate(str.maketrans("│┃┏┓┡┩└┘├┤━─╇┴┳┼", " " * 16))
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert lines[0] == "image 7"
    return [line for line in lines if line and (line[0].isdigit() or "mm" in line or "stamp" in line)]


def test_the_table_says_sizes_overlap_and_delay() -> None:
    truth = boxes(0.0, 0.3)
    rows = shown(truth, truth, truth[:1], recover_node=[10.0, 20.0, 90.0], fitter_node=[])
    assert rows == [
        "1 30 40 50 mm 0.30 0.30 30 40 50 mm 0.30 0.30 100.0 % 30 40 50 mm 0.30 0.30 100.0 %",
        "2 30 40 60 mm 0.30 0.30 30 40 60 mm 0.30 0.30 100.0 % not found",
        "stamp to result, median: CNN + fit 20 ms, classic fit -",
    ]


def test_without_truth_the_residual_stands_in() -> None:
    rows = shown(None, boxes(0.0), boxes(0.0, 3.0))
    assert rows[:2] == [
        "1 30 40 50 mm 0.30 0.30 1.2 mm 30 40 50 mm 0.30 0.30 1.2 mm",
        "30 40 60 mm 0.30 0.30",
    ]


def test_an_image_without_any_body_has_an_empty_table() -> None:
    assert shown(boxes(), boxes(), boxes()) == ["stamp to result, median: CNN + fit -, classic fit -"]


@pytest.mark.parametrize("count", [0, 2])
def test_the_figure_is_drawn_whatever_was_found(count: int) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    bodies = list(boxes(*(0.25 * k - 0.1 for k in range(count))))
    depth = np.full((48, 64), np.nan)
    if bodies:
        depth, _ = raycast.render(Superquadric.stack(bodies), camera)
    figure = demo_figure(depth, camera, bodies, [("a", bodies, ""), ("b", bodies[:1], "")], None, "heading")
    figure.canvas.draw()


# Processes


def environment() -> tuple[dict[str, str], str]:
    """An environment with a mark that all children inherit."""
    mark = f"SQ_DEMO_TEST={uuid.uuid4().hex}"
    name, value = mark.split("=")
    return {**os.environ, name: value, "COLUMNS": "160"}, mark


def marked(mark: str) -> dict[int, str]:
    """Process ids and command lines of all living processes with the mark."""
    living = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "environ").read_bytes():
                living[int(folder.name)] = (folder / "cmdline").read_text()
        except OSError:
            continue
    return living


class Demo(subprocess.Popen[str]):
    """The command in a folder; all that it starts inherits its mark."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        env, self.mark = environment()
        code = f"import sys; sys.path[:1] = [{ROOT!r}]; from sq_perception.commands.main import main; sys.exit(main())"
        super().__init__(
            [sys.executable, "-c", code, "demo", *arguments],
            cwd=folder,
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def ended(self, code: int = 0, within: float = 180.0) -> str:
        """What it said, when it has ended with this code, and without a trace."""
        said, _ = self.communicate(timeout=within)
        assert self.returncode == code, said
        assert "Traceback" not in said
        assert marked(self.mark) == {}
        return said


def wait_for(condition: object, seconds: float = 90.0) -> None:
    assert callable(condition)
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.1)


def test_the_demonstration_shows_draws_and_leaves_nothing_running(tmp_path: Path) -> None:
    said = Demo(tmp_path, "--seconds", "4", "--output-dir", "out").ended()
    number, row = r"[\d ]+ mm +│ [\d. ]+ ", r"│ +\d │ +"
    rows = re.findall(row + number + "│ +(?:" + number + r"│ +([\d.]+) %|not found)", said)
    assert rows, said
    assert np.median([float(overlap or 0) for overlap in rows]) > 80, said
    assert "demo.png" in said
    picture = cv2.imread(str(tmp_path / "out" / "demo.png"))
    assert picture.shape[1] > 1000
    assert (tmp_path / "out" / "demo.glb").read_bytes()[:4] == b"glTF"


def test_a_recorded_grey_image_is_recognised_and_recovered(tmp_path: Path) -> None:
    body = Superquadric(np.array([0.2, 0.15, 0.25]), np.array([0.3, 0.5]), np.array([0.5, 0.5, 0.5]),
                        np.array([0.3, 0.2, 0.1, 0.9]))  # fmt: skip
    depth, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera())
    cv2.imwrite(str(tmp_path / "body.bmp"), unit_cube.grey_from_depth(depth))
    said = Demo(tmp_path, "--frame", "body.bmp", "--seconds", "1").ended()
    sizes = re.search(r"│ +1 │ +([\d.]+) ([\d.]+) ([\d.]+) ", said)
    assert sizes is not None, said
    assert sorted(map(float, sizes.groups())) == pytest.approx([0.15, 0.2, 0.25], abs=0.01)
    assert (tmp_path / "demo.png").is_file()


@pytest.mark.parametrize("projection", ["orthographic", "pinhole"])
def test_the_nodes_expect_what_an_npz_holds(projection: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes that expect another projection refuse each of its images."""
    asked: list[dict[str, object]] = []
    monkeypatch.setattr(demonstration, "run", lambda camera, *_: asked.append(camera) or 0)
    path = tmp_path / "body.npz"
    np.savez(
        path, depth=np.full((20, 20), 0.5), K=np.array([[20, 0, 9.5], [0, 20, 9.5], [0, 0, 1.0]]), projection=projection
    )
    assert demo.main(["--frame", str(path), "--output-dir", str(tmp_path)]) == 0
    assert [camera["projection"] for camera in asked] == [projection]


def test_ctrl_c_ends_it_at_any_time_without_a_trace(tmp_path: Path) -> None:
    process = Demo(tmp_path, "--seconds", "60")
    wait_for(lambda: len(marked(process.mark)) >= 4)
    process.send_signal(signal.SIGINT)
    process.ended(within=60.0)


def test_a_ctrl_c_that_got_lost_is_noticed() -> None:
    """As in a callback of a weak reference, whose exceptions Python prints and forgets."""
    before = signal.getsignal(signal.SIGINT)
    with Children() as children:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            children.dead()
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_node_is_started_leaves_none_behind(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """It comes when the process exists and nobody knows it yet."""
    started: list[Child] = []

    class Interrupted(Child):
        def __init__(self, *given: object) -> None:
            super().__init__(*given)  # type: ignore[arg-type]
            started.append(self)
            signal.raise_signal(number)

    monkeypatch.setattr(children_module, "Child", Interrupted)
    with pytest.raises(KeyboardInterrupt), Children(environment()[0]) as children:
        children.start("synthetic_depth_node")
    assert [child.exit_code is None for child in started] == [False]


def test_a_node_that_dies_is_named_and_ends_the_demonstration(tmp_path: Path) -> None:
    process = Demo(tmp_path, "--seconds", "60")

    def victims() -> list[int]:
        return [pid for pid, command in marked(process.mark).items() if "e.fitter_node(" in command]

    wait_for(victims)
    os.kill(victims()[0], signal.SIGKILL)
    assert "fitter_node has ended with exit code -9" in process.ended(1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--frame", "missing.npz"], "missing.npz: no such file"),
        (["--frame", "text.npz"], "text.npz"),
        (["--seconds", "0"], "--seconds: expected a number above 0"),
    ],
)
def test_a_frame_that_cannot_be_read_is_refused_before_anything_starts(
    arguments: list[str], words: str, tmp_path: Path
) -> None:
    (tmp_path / "text.npz").write_text("not a frame")
    assert words in Demo(tmp_path, *arguments).ended(2)


def test_a_child_that_cannot_start_says_why() -> None:
    with Children() as children:
        children.start("synthetic_depth_node", parameter_arguments({"rate": -1.0}))
        wait_for(lambda: children.dead() is not None)
        ended = children.dead()
        assert ended is not None
        assert ended.exit_code == 1
        assert "rate" in "\n".join(ended.last_lines())


def test_a_child_that_does_not_listen_is_killed_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(children_module, "_PATIENCE", 0.5)
    children = Children()
    child = children.start("synthetic_depth_node")
    monkeypatch.setattr(child, "interrupt", lambda: None)
    children.stop()
    assert children.killed == ["synthetic_depth_node"]
    assert child.exit_code == -signal.SIGKILL


def test_what_children_said_is_forgotten_when_they_have_stopped() -> None:
    """Not when they are collected, which is a ResourceWarning."""
    children = Children()
    child = children.start("synthetic_depth_node")
    children.stop()
    with pytest.raises(ValueError, match="closed file"):
        child.last_lines()


def test_the_profile_is_only_set_where_the_user_has_not_chosen_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(fast_dds.VARIABLE, raising=False)
    assert fast_dds.profile_path().is_file()
    assert fast_dds.additions() == {fast_dds.VARIABLE: str(fast_dds.profile_path())}
    monkeypatch.setenv(fast_dds.VARIABLE, "mine.xml")
    assert fast_dds.additions() == {}
