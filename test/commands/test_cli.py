"""The command line: what its files promise, exit codes, clouds and meshes, and a help that answers at once."""

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from python_process import run_python
from recover_runs import run

import sq_perception
from sq_perception.commands import main
from sq_perception.commands.console import progress
from sq_perception.geometry.metrics import thesis_iou, volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.recordings.frame_file import read

CUBE_BODY = ["0.25", "0.15", "0.1", "0.2", "0.8", "0.5", "0.45", "0.5", "0.2", "-0.3", "0.1", "0.9"]
CAN = ["0.05", "0.05", "0.08", "0.1", "1.0", "-5e-2", "0", "0.8", "0.7", "0.2", "0", "0.7"]
KEYS = {"size", "shape", "translation", "rotation", "score", "residual", "sigma_size", "seen", "status", "message"}
KEYS |= {"label", "pixels", "track", "taper", "objectness", "parts", "cavity"}


def strict(text):
    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def recover(*arguments):
    return main.main(["recover", *map(str, arguments), "--projection", "orthographic", "--method", "symmetry"])


def body_of(entry):
    return Superquadric(entry["size"], entry["shape"], entry["translation"], entry["rotation"])


def flat(parameters):
    return Superquadric.from_flat(np.array([float(value) for value in parameters]))


@pytest.fixture
def view(tmp_path):
    path = tmp_path / "view.png"
    assert main.main(["render", *CUBE_BODY, "--output", str(path)]) == 0
    return path


@pytest.mark.parametrize("suffix", ["png", "bmp", "npz"])
def test_rendered_cube_images_come_back(tmp_path, suffix):
    path, out = tmp_path / f"view.{suffix}", tmp_path / "out.json"
    assert main.main(["render", *CUBE_BODY, "-o", str(path)]) == 0
    assert recover(path, "--json", out, "--ignore-masks") == 0
    frame = strict(out.read_text())["frames"][0]
    assert (frame["file"], frame["coordinates"]) == (str(path), "cube")
    assert frame["ms"] > 0
    (entry,) = frame["superquadrics"]
    assert set(entry) == KEYS
    assert entry["label"] is None
    assert entry["status"] in ("converged", "weak")
    assert thesis_iou(body_of(entry), flat(CUBE_BODY)) > 0.98
    assert (len(entry["sigma_size"]), len(entry["seen"])) == (3, 3)
    assert all(0 <= share <= 1 for share in entry["seen"])
    assert entry["track"] is None


def test_pinhole_round_trips(tmp_path):
    for name in ("can.png", "can.npz"):
        path, out = tmp_path / name, tmp_path / "out.json"
        assert main.main(["render", *CAN, "--projection", "pinhole", "-o", str(path)]) == 0
        info = ["--camera-info", str(tmp_path / "can.yaml")] if name.endswith("png") else []
        assert main.main(["recover", str(path), *info, "--method", "symmetry", "--json", str(out)]) == 0
        frame = strict(out.read_text())["frames"][0]
        assert frame["coordinates"] == "optical"
        (entry,) = frame["superquadrics"]
        assert entry["label"] == (1 if name.endswith("npz") else None)
        assert volume_iou(body_of(entry), flat(CAN)) > 0.95
    with np.load(tmp_path / "can.npz") as archive:
        np.testing.assert_allclose(archive["superquadrics"][0], flat(CAN).to_flat())


def test_what_has_the_name_of_the_camera_beside_an_image_is_kept(tmp_path, capsys):
    (tmp_path / "can.yaml").write_text("mine")
    render = ["render", *CAN, "--projection", "pinhole", "-o", str(tmp_path / "can.png")]
    assert main.main(render) == 1
    assert "can.yaml" in capsys.readouterr().err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]
    (tmp_path / "can.yaml").unlink()
    assert [main.main(render), main.main(render)] == [0, 0]  # a pair of one's own is made again


def test_what_sixteen_bits_of_millimetres_cannot_say_is_no_reading(tmp_path, capsys):
    """A ball from 64 to 68 m in front, of which they can say the nearest part."""
    ball = ["2", "2", "2", "1", "1", "0", "0", "66", "0", "0", "0", "1", "--projection", "pinhole", "--focal", "4000"]
    for name in ("ball.png", "ball.npz"):
        assert main.main(["render", *ball, "-o", str(tmp_path / name)]) == 0
    assert capsys.readouterr().err.count("beyond 65.535 m") == 1
    millimetres = cv2.imread(str(tmp_path / "ball.png"), cv2.IMREAD_UNCHANGED)
    depth = np.load(tmp_path / "ball.npz")["depth"]
    assert np.nanmax(depth) > 65.54
    np.testing.assert_array_equal(millimetres > 0, depth < 65.5355)
    assert abs(millimetres / 1e3 - depth)[millimetres > 0].max() < 0.001


def test_sizes(tmp_path):
    path = tmp_path / "wide.png"
    assert main.main(["render", *CUBE_BODY, "-o", str(path), "--width", "100", "--height", "80"]) == 0
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape == (80, 100)
    assert read(path, projection="orthographic").camera == unit_cube.camera(100, 80)


def test_masks_name_the_bodies_and_unknown_is_null(tmp_path, view):
    frame = read(view, projection="orthographic")
    path, out = tmp_path / "masked.npz", tmp_path / "out.json"
    labels = np.where(np.isfinite(frame.depth), 200, 0).astype(np.uint8)
    labels[:2, :2] = 7
    depth = frame.depth.copy()
    depth[0, :2] = 0.5
    np.savez(path, depth=depth, labels=labels, projection="orthographic")
    assert main.main(["recover", str(path), "--method", "classic", "--json", str(out)]) == 0
    first, second = strict(out.read_text())["frames"][0]["superquadrics"]
    assert (first["label"], second["label"]) == (200, 7)
    assert second["status"] == "failed"
    assert second["residual"] is None
    assert (second["sigma_size"], second["score"]) == ([None, None, None], 0)


def test_a_line_is_printed_for_each_body_or_nothing_but_json(view, capsys):
    assert recover(view, "--json", "-") == 0
    assert len(strict(capsys.readouterr().out)["frames"]) == 1
    assert recover(view) == 0
    number = r"0\.\d{3,4}"
    sizes, deviations = " x ".join([number] * 3), r" \+-".join([number] * 3)
    line = rf"  0 converged {sizes} of the cube \(\+-{deviations}\) at 0\.\d\d "
    assert re.search(line, capsys.readouterr().out)


def test_pictures_are_drawn_one_a_frame(tmp_path, view):
    empty = tmp_path / "other" / "view.png"
    empty.parent.mkdir()
    cv2.imwrite(str(empty), np.zeros((64, 64), np.uint8))
    folder = tmp_path / "new" / "pictures"
    assert recover(view, empty, "--pictures", folder) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["view.png", "view_2.png"]
    picture = cv2.imread(str(folder / "view.png"))
    assert picture.shape[0] > 600
    assert picture.std() > 20


def test_a_missing_model_is_one_clear_line(tmp_path, view, capsys):
    command = ["recover", str(view), "--projection", "orthographic", "--model", str(tmp_path / "none.safetensors")]
    assert main.main(command) == 1
    assert "no such model file" in capsys.readouterr().err


CUBE, PINHOLE = ["render", *CUBE_BODY, "-o"], ["render", *CAN, "--projection", "pinhole", "-o"]
WRONG = [
    *([], ["recover"], ["fly"], ["train", "--seed", "-1"], ["train", "--threads", "-1"]),
    *(["recover", "a.npz", one] for one in ("--method=magic", "--projection=fisheye", "--max-objects=0")),
    *(["recover", "a.npz", "--json", "no/such/folder/out.json"], ["render", "1", "2", "3", "-o", "x.png"], CUBE[:-1]),
    *([*CUBE, "x.jpg"], [*PINHOLE, "x.bmp"], [*CUBE, "no/such/folder/x.png"], [*CUBE, "x.png", "--focal", "500"]),
    *(["render", wrong, *CUBE_BODY[1:], "-o", "x.png"] for wrong in ("-1", "nan")),
    ["render", *CUBE_BODY[:8], "0", "0", "0", "0", "-o", "x.png"],
    *([*CUBE, "x.png", "--width", width] for width in ("1", "0", "1000000")),
    [*CUBE, "x.png", "--width", "1000001", "--height", "2"],
    [*PINHOLE, "x.npz", "--width", "100000", "--height", "100000"],
    [*PINHOLE, "x.png", "--height", "0"],
]


@pytest.mark.parametrize("arguments", WRONG)
def test_wrong_usage_is_code_two_and_no_traceback(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main.main(arguments) == 2
    assert capsys.readouterr().err
    assert not list(tmp_path.iterdir())


HEAVY = ("torch", "numpy", "numba", "scipy", "cv2", "matplotlib", "rich", "rclpy")


def test_help_waits_for_nothing_that_computes():
    code = (
        "import sys; from sq_perception.commands import main\n"
        "for words in ([], *([name] for name in main.COMMANDS)):\n"
        f"    print('LOADED', *words, main.main([*words, '--help']), *sorted(set({HEAVY!r}) & set(sys.modules)))"
    )
    done = run_python("-c", code)
    loaded = [line for line in done.stdout.splitlines() if line.startswith("LOADED")]
    assert loaded == ["LOADED 0", *(f"LOADED {name} 0" for name in main.COMMANDS)]
    for words in ("--steps", "least_squares_free", "mse", "What is minimised", "Views a step", "--fit-bodies"):
        assert words in done.stdout
    assert len(re.findall("^usage: sq-perception", done.stdout, re.MULTILINE)) == len(loaded)


def test_the_package_runs_as_a_module_and_says_its_version():
    version = run_python("-m", "sq_perception", "--version").stdout
    assert version == f"sq-perception {sq_perception.__version__}\n"
    assert "examples:" in run_python("-m", "sq_perception", "recover", "--help").stdout


def test_demo_without_ros_says_what_is_missing(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert main.main(["demo"]) == 1
    assert "demo needs ROS 2 in Python: pip install" in capsys.readouterr().err


def test_a_file_that_is_called_like_the_standard_output_is_no_output(tmp_path, monkeypatch, capsys):
    """It is read where masks or the files of a bag are."""
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((30, 40), np.uint16))
    (tmp_path / "-").write_text("what somebody has left")
    monkeypatch.chdir(tmp_path)
    assert run("a.png", "--camera-info", "50,50,19.5,14.5", "--masks", ".", "--json", "-") == 0
    assert "input" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("output", "words"),
    [("/dev/full", "sq-perception: the standard output: No space left on device\n"), ("a closed pipe", "")],
)
def test_what_cannot_be_printed_is_code_one_and_no_exception(output, words):
    """Buffered, as in a user's shell, so that it fails when all is done."""
    into, of = os.pipe()
    os.close(into)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with os.fdopen(of, "wb") if output == "a closed pipe" else open(output, "wb") as sink:
        command = [sys.executable, "-m", "sq_perception", "--version"]
        done = subprocess.run(command, stdout=sink, stderr=subprocess.PIPE, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (1, words)


def test_json_on_a_closed_standard_output_is_wrong_usage(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    assert run(tmp_path / "a.npz", "--json", "-") == 2
    assert "--json: the standard output is closed" in capsys.readouterr().err


@pytest.mark.parametrize("name", [b"$1$_$2_$.npz", b"caf\xe9.npz"])
def test_a_frame_may_be_called_anything(tmp_path, name, monkeypatch):
    """What Matplotlib takes for a formula, and what is no UTF-8, in pictures, meshes, tables and on the terminal."""
    path = Path(os.fsdecode(os.path.join(os.fsencode(tmp_path), name)))
    depth = np.full((30, 40), 1.0, np.float32)
    depth[8:22, 10:30] = 0.8
    np.savez(path, depth=depth, K=[[50, 0, 19.5], [0, 50, 14.5], [0, 0, 1]], labels=(depth < 0.9).astype(int))
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="utf-8"))
    outputs = ("--pictures", tmp_path, "--meshes", tmp_path, "--csv", tmp_path / "out.csv")
    assert run(path, *outputs) == 0
    assert sys.stdout.buffer.getvalue()
    assert {found.suffix for found in tmp_path.iterdir()} == {".npz", ".png", ".glb", ".csv"}
    assert "weak" in (tmp_path / "out.csv").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", ["train-things", "train-masks"])
def test_a_training_that_is_interrupted_says_so_by_its_code(tmp_path, command, monkeypatch, capsys):
    pytest.importorskip("torch", reason="needs the extra 'train'")
    from sq_perception.learning import shard_training
    from sq_perception.learning.training import Stopped

    def interrupted(*_):
        raise Stopped("the same command goes on")

    monkeypatch.setattr(shard_training, "train", interrupted)
    assert main.main([command, str(tmp_path), "--output", str(tmp_path)]) == 130
    assert "the same command goes on" in capsys.readouterr().err


def test_a_bar_that_no_terminal_shows_writes_nothing(capsys):
    """Not even an empty line, as rich before 14.3 ends it with."""
    with progress() as bar:
        bar.add_task("recovering", total=1)
        bar.console.line()
    assert capsys.readouterr().err == ""


BODY = Superquadric([0.03, 0.04, 0.09], [0.2, 1.0], [0.02, -0.03, 0.6], [0.2, 0.1, 0.0, 1.0])


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    """A cloud of a whole object before where a camera might have been."""
    path = tmp_path / "whole.ply"
    trimesh.PointCloud(BODY.sample_surface(4000, np.random.default_rng(0))).export(path)
    return path


def test_a_cloud_becomes_a_line_and_json(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.json"
    assert main.main(["fit", str(whole), "--json", str(out)]) == 0
    assert "0 converged 80.0 x 60.0 x 180.0" in capsys.readouterr().out
    document = json.loads(out.read_text())
    assert document["format"] == "sq_perception.points"
    (entry,) = document["files"]
    (body,) = entry["superquadrics"]
    assert entry["points"] == 4000
    assert np.allclose(np.sort(body["size"]), np.sort(BODY.size), rtol=0.01)
    assert np.allclose(body["translation"], BODY.translation, atol=1e-3)
    assert np.shape(body["covariance"]) == (11, 11)


def test_meshes_and_arrays_are_read_and_parts_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh.creation.cylinder(radius=0.03, height=0.1).export(tmp_path / "can.obj")
    np.save(tmp_path / "cloud.npy", BODY.sample_surface(1000, np.random.default_rng(1)))
    assert main.main(["fit", str(tmp_path / "can.obj"), str(tmp_path / "cloud.npy"), "--most", "3", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)["files"]
    assert [len(entry["superquadrics"]) for entry in found] == [1, 1]


def test_what_cannot_be_read_is_said_and_the_rest_follows(whole, tmp_path, capsys) -> None:
    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9999999\nend_header\n")
    assert main.main(["fit", str(broken), str(tmp_path / "none.stl"), str(tmp_path / "some.txt"), str(whole)]) == 1
    shown = capsys.readouterr()
    for name, reason in (("broken.ply", ""), ("none.stl", "No such file"), ("some.txt", ".stl")):
        assert f"{name}: " in shown.err
        assert reason in shown.err
    assert "0 converged" in shown.out


def test_a_plane_fails_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "plane.npy", np.random.default_rng(2).random((500, 3)) * [1.0, 1.0, 0.0])
    assert main.main(["fit", str(tmp_path / "plane.npy")]) == 0
    assert "failed: all points lie on one plane" in capsys.readouterr().out


def test_recover_sends_the_cloud_of_a_whole_object_here(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["recover", str(whole), "--method", "symmetry"]) == 1
    assert "sq-perception fit takes clouds of whole objects" in capsys.readouterr().err
