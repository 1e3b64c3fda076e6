"""The Python of the documents runs, on things of the kind that its comments name."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from sq_perception import Camera, Superquadric
from sq_perception.imaging import raycast

CAMERA = Camera(80, 60, 100.0, 100.0, 39.5, 29.5)
BODY = Superquadric([0.05, 0.04, 0.06], [0.2, 0.9], [0.0, 0.0, 0.5], [0.7, 0.1, 0.1, 0.7])


def names() -> dict[str, Any]:
    depth, index = raycast.render(BODY, CAMERA)
    depth = np.where(np.isfinite(depth), depth, 0.8).astype(np.float32)
    seen = {"depth": depth, "mask": index >= 0, "camera": CAMERA, "last_body": BODY, "true_depth": depth}
    known = {"rng": np.random.default_rng(1), "z": np.array([0.5]), "cosine": np.array([0.7])}
    return {**seen, **known, "table": np.array([0.0, 0.0, -1.0, 0.8])}


def run(repository: Path, page: str, given: dict[str, Any]) -> dict[str, Any]:
    text = (repository / "docs" / page).read_text(encoding="utf-8")
    for snippet in re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
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


def test_the_surface_fit(repository: Path) -> None:
    found = run(repository, "surface_fit.md", names())["found"]
    np.testing.assert_allclose(found.superquadric.translation, BODY.translation, atol=0.03)


def test_sensors(repository: Path) -> None:
    given = names()
    before = given["true_depth"]
    measured = run(repository, "sensors.md", given)["depth"]
    assert measured.shape == before.shape
    assert np.nanmedian(np.abs(measured - before)) < 0.01


def test_tracking(repository: Path) -> None:
    from sq_perception.recovery.recoverer import Recoverer

    depth = names()["depth"]
    frames = [(0.1 * k, depth, np.eye(4)) for k in range(2)]
    given = {"frames": frames, "recoverer": Recoverer(method="symmetry"), "camera": CAMERA}
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
