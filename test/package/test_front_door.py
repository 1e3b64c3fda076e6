"""What ``import sq_perception`` offers: the names, their price, and the lines of README and documents that use them."""

import ast
import json
import pkgutil
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
from python_process import run_python

import sq_perception
from sq_perception import Camera, Superquadric
from sq_perception.imaging import raycast

_SNIPPET = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def offered_to_type_checkers() -> dict[str, str]:
    """Name and origin of everything that the package imports for mypy alone."""
    tree = ast.parse(Path(sq_perception.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    found = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        found.update({alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names})
    return found


@pytest.mark.parametrize("name", sorted(set(sq_perception.__all__) - {"__version__"}))
def test_every_name_is_what_type_checkers_take_it_for(name: str) -> None:
    value = getattr(sq_perception, name)
    module, _, there = offered_to_type_checkers()[name].rpartition(".")
    assert value is getattr(sys.modules[module], there)
    assert value.__doc__


def test_nothing_else_is_offered() -> None:
    assert set(offered_to_type_checkers()) | {"__version__"} == set(sq_perception.__all__)
    assert set(sq_perception.__all__) <= set(dir(sq_perception))
    with pytest.raises(AttributeError, match="no attribute 'Recoverers'"):
        _ = sq_perception.Recoverers


def test_every_name_is_in_the_reference(repository: Path) -> None:
    page = (repository / "docs" / "api.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^::: (\S+)$", page, re.MULTILINE))
    assert set(offered_to_type_checkers().values()) <= shown
    pytest.importorskip("sensor_msgs", reason="message packages missing: install the extra 'ros' or source ROS 2")
    for name in shown:
        pkgutil.resolve_name(name)


def test_names_are_loaded_when_they_are_used() -> None:
    """A clock would measure the machine: what takes time is counted instead."""
    code = (
        "import sys; before = set(sys.modules); import sq_perception\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names)\n"
        "assert new == {'sq_perception'}, new\n"
        "sq_perception.Camera\n"
        "assert 'sq_perception.imaging.camera' in sys.modules\n"
        "assert not {'torch', 'numba', 'cv2', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "from sq_perception import *\n"
        "assert Recoverer.__module__ == 'sq_perception.recovery.recoverer'\n"
    )
    run_python("-c", code)


def snippets(page: Path) -> list[str]:
    return _SNIPPET.findall(page.read_text(encoding="utf-8"))


def test_the_readme_runs_as_it_stands(repository: Path, tmp_path: Path) -> None:
    """Its shell lines on files, and its script on what the first of them wrote."""
    text = (repository / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    (block,) = (block for block in blocks if "sq-perception sample" in block)
    lines = [line.partition("#")[0].split() for line in block.splitlines()]
    true, *_ = [run_python("-m", "sq_perception", *line[1:], cwd=tmp_path).stdout for line in lines]
    result = json.loads((tmp_path / "result.json").read_text())
    found = [sorted(2e3 * half for half in body["size"]) for body in result["frames"][0]["superquadrics"]]
    known = [sorted(map(float, edges)) for edges in re.findall(r"(\d+) x (\d+) x (\d+) mm", true)]
    assert len(found) == len(known) == 4
    np.testing.assert_allclose(sorted(found, key=max), sorted(known, key=max), atol=6)
    assert "full edges" in (tmp_path / "page.html").read_text()
    grasps = json.loads((tmp_path / "grasps.json").read_text())["frames"][0]["bodies"]
    assert [body["body"] for body in grasps] == [0, 1, 2, 3]
    assert all(body["grasps"] for body in grasps)
    assert (tmp_path / "pictures" / "table.png").is_file()

    said = run_python("-c", snippets(repository / "README.md")[0], cwd=tmp_path).stdout
    assert re.findall(r"^(\d) (converged|weak): full edges \[.*\] mm \+- \[.*\] mm$", said, re.MULTILINE), said
    assert (tmp_path / "table.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "table.glb").read_bytes()[:4] == b"glTF"


def test_the_reader_of_the_outputs_page_runs(repository: Path) -> None:
    """Up to its spinning, which never ends."""
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    script = snippets(repository / "docs" / "outputs.md")[0]
    code = f"import rclpy; rclpy.spin = lambda node: print(node.get_name())\n{script}\nprint(read.__name__)"
    assert run_python("-c", code).stdout.split() == ["reader", "read"]


def test_all_snippets_of_the_documents_are_python(repository: Path) -> None:
    for page in (repository / "README.md", *sorted((repository / "docs").glob("*.md"))):
        for text in snippets(page):
            compile(text, page.name, "exec")


def test_read_frame_finds_the_camera_beside_an_image(tmp_path: Path) -> None:
    """As the command does: in the file of the folder, or in that of the image's name."""
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((48, 64), 700, np.uint16))
    with pytest.raises(ValueError, match=r"depth\.png"):
        sq_perception.read_frame(tmp_path / "depth.png")
    matrix = {"rows": 3, "cols": 3, "data": [60.0, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}
    text = f"image_width: 64\nimage_height: 48\ncamera_matrix: {json.dumps(matrix)}\n"
    (tmp_path / "camera_info.yaml").write_text(text + "distortion_model: plumb_bob\n")
    frame = sq_perception.read_frame(tmp_path / "depth.png")
    assert (frame.camera.fx, frame.camera.width) == (60, 64)
    np.testing.assert_allclose(frame.depth, 0.7)


CAMERA = Camera(80, 60, 100.0, 100.0, 39.5, 29.5)
BODY = Superquadric([0.05, 0.04, 0.06], [0.2, 0.9], [0.0, 0.0, 0.5], [0.7, 0.1, 0.1, 0.7])


def names() -> dict[str, Any]:
    depth, index = raycast.render(BODY, CAMERA)
    depth = np.where(np.isfinite(depth), depth, 0.8).astype(np.float32)
    seen = {"depth": depth, "mask": index >= 0, "camera": CAMERA, "last_body": BODY, "true_depth": depth}
    known = {"rng": np.random.default_rng(1), "z": np.array([0.5]), "cosine": np.array([0.7])}
    return {**seen, **known, "table": np.array([0.0, 0.0, -1.0, 0.8])}


def run(repository: Path, page: str, given: dict[str, Any]) -> dict[str, Any]:
    for snippet in snippets(repository / "docs" / page):
        exec(compile(snippet, page, "exec"), given)  # noqa: S102
    return given


def test_the_reference(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    given = run(repository, "api.md", {})
    assert len(given["found"]) == 5
    assert "IoU 0.83" in capsys.readouterr().out
    np.testing.assert_allclose(given["can"].gauge(given["points"]), 1, atol=1e-9)
    assert given["surface"].volume == pytest.approx(float(given["can"].volume()), rel=0.02)
    assert (tmp_path / "cans.stl").stat().st_size > 1000


def test_the_pages_on_the_fit_sensors_and_tracking(repository: Path) -> None:
    found = run(repository, "surface_fit.md", names())["found"]
    np.testing.assert_allclose(found.superquadric.translation, BODY.translation, atol=0.03)
    depth, measured = names()["true_depth"], run(repository, "sensors.md", names())["depth"]
    assert np.nanmedian(np.abs(measured - depth)) < 0.01
    frames = [(0.1 * k, depth, np.eye(4)) for k in range(2)]
    given = {"frames": frames, "recoverer": sq_perception.Recoverer(method="symmetry"), "camera": CAMERA}
    assert run(repository, "tracking.md", given)["track"].observation == 0


def test_outputs(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The service is a stand-in that has answered; test_nodes_wiring.py asks a real one."""
    pytest.importorskip("shape_msgs", reason="needs the extra 'ros'")
    from std_msgs.msg import Header
    from std_srvs.srv import Trigger

    from sq_msgs_py.answers import text_of
    from sq_msgs_py.superquadrics import to_message
    from sq_perception.recordings.publication import truth_array

    bodies = truth_array(Superquadric.stack([BODY]))
    given = {"message": to_message(bodies, Header())}
    rclpy = MagicMock()
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)  # nothing is to be spun
    given |= {"node": rclpy.create_node(), "Trigger": Trigger, "PlanningScene": object}
    given["superquadrics"] = Superquadric.stack([BODY])
    monkeypatch.chdir(tmp_path)
    asked = given["node"].create_client().call_async()
    asked.result.return_value = Trigger.Response(success=True, message=text_of(bodies, Header(frame_id="map"), ""))
    run(repository, "outputs.md", given)
    assert given["answer"].frame_id == "map"
    np.testing.assert_array_equal(given["answer"].bodies.size, bodies.size)
    assert (tmp_path / "scene.sdf").is_file()
    _check_octomap_recipe(given, monkeypatch)


def _check_octomap_recipe(given: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The octomap is cleared for what is new or has moved, not for what is said again or goes."""
    import soft_messages
    from std_msgs.msg import Header

    from sq_msgs_py.collision_objects import Scene, planning_scene
    from sq_perception.recordings.publication import truth_array

    soft_messages.install(monkeypatch)
    scene, here = Scene(), truth_array(Superquadric.stack([BODY, BODY]))
    there = replace(here, translation=here.translation + [0.0, 0.0, 0.1])

    def cleared(bodies: Any, again: bool = False) -> int:
        if again:
            scene.repeat()
        before = given["clear"].call_async.call_count
        message = planning_scene(scene.changes(bodies, Header(frame_id="map")))
        assert message.is_diff
        given["on_scene"](message)
        return given["clear"].call_async.call_count - before

    assert [cleared(here), cleared(here), cleared(here, again=True), cleared(there)] == [1, 0, 0, 1]
    assert [cleared(there.where(there.id == there.id[0])), cleared(there)] == [0, 1]


def test_bags(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    pytest.importorskip("mcap", reason="needs the extra 'bags'")
    from sq_perception.recordings.frame_file import RecordedFrame
    from sq_perception.recordings.result_bag import ResultBag
    from sq_perception.recovery.recoverer import Recoverer

    given = names()
    monkeypatch.chdir(tmp_path)
    frame = RecordedFrame(given["depth"], CAMERA, None, "a")
    recovery = Recoverer(method="symmetry").recover(frame.depth, CAMERA, given["mask"].astype(np.int32))
    with ResultBag("results.mcap") as bag:
        bag.add(frame, recovery, None)
    run(repository, "bags.md", given)
    assert re.search(r"s  body 1: \[.*\] mm", capsys.readouterr().out)
