"""sq-perception grasp: what is in its JSON, its pictures and meshes, and wrong usage."""

import json

import cv2
import numpy as np
import pytest
import trimesh

from sq_perception import Camera, Superquadric
from sq_perception.commands import grasp_run, main
from sq_perception.simulation.rendering import render_things
from sq_perception.simulation.thing_setting import optical_from_table

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
EYE = np.array([0.0, 0.0, 0.6])


@pytest.fixture
def frame(tmp_path):
    """A can of 6 x 10 cm on a table, 45 degrees from above."""
    look = optical_from_table(np.pi / 4, 0.0)
    can = Superquadric([[0.03, 0.03, 0.05]], [[0.1, 1.0]], [[0.0, 0.0, 0.05]], [[0.0, 0.0, 0.0, 1.0]])
    can = can.transformed(look, EYE)
    up = can.rotation_matrix[0][:, 2]
    plane = np.append(up, -up @ EYE)
    depth, thing = render_things(can, np.zeros(1), Superquadric.stack([]), np.zeros(0), CAMERA, plane)
    path = tmp_path / "can.npz"
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
    np.savez(path, depth=depth, K=CAMERA.matrix, labels=(thing + 1).astype(np.int32))
    return path


def test_why_there_are_no_grasps_is_said(tmp_path, capsys):
    assert main.main(["grasp", str(tmp_path / "none.npz"), "--json", "-"]) == 1
    assert "none.npz" in capsys.readouterr().err
    np.savez(tmp_path / "dark.npz", depth=np.full((120, 160), np.nan, np.float32), K=CAMERA.matrix)
    assert main.main(["grasp", str(tmp_path / "dark.npz")]) == 0
    assert "dark.npz: the image holds no depth" in capsys.readouterr().err


def test_a_can_is_grasped_across_and_everything_is_written(frame, tmp_path, capsys):
    out = tmp_path / "out.json"
    command = ["grasp", str(frame), "--json", str(out), "--pictures", str(tmp_path), "--meshes", str(tmp_path)]
    assert main.main(command) == 0
    document = json.loads(out.read_text())
    assert document["options"] == {"gripper": "panda", "friction": 0.5}
    (body,) = document["frames"][0]["bodies"]
    best = body["grasps"][0]
    assert body["reason"] == ""
    assert best["width"] == pytest.approx(0.06, abs=0.006)
    assert best["score"] > 0.7
    assert np.linalg.norm(np.array(best["position"]) - EYE) < 0.12
    assert (tmp_path / "can.png").stat().st_size > 1000
    names = set(trimesh.load_scene(tmp_path / "can.glb").geometry)
    assert names == {"body_0", "grasp_0_left", "grasp_0_right", "grasp_0_hand"}
    assert "mm open" in capsys.readouterr().out


def test_a_body_that_failed_has_the_reason_and_its_number(frame, tmp_path, capsys):
    recorded = dict(np.load(frame))
    labels = np.where(recorded["labels"] == recorded["labels"][60, 80], 7, 0)
    labels[0, :3] = 2
    np.savez(frame, **{**recorded, "labels": labels})
    out = tmp_path / "out.json"
    assert main.main(["grasp", str(frame), "--json", str(out)]) == 0
    can, failed = json.loads(out.read_text())["frames"][0]["bodies"]
    assert (can["body"], failed["body"]) == (0, 1)
    assert (can["label"], can["reason"]) == (7, "")
    assert can["grasps"]
    assert (failed["label"], failed["grasps"]) == (2, [])
    assert failed["reason"].startswith("failed: ")
    assert f"  1 {failed['reason']}" in capsys.readouterr().out


@pytest.mark.parametrize(("height", "width"), [(2, 2000), (400, 2)])
def test_pictures_of_strips_can_be_looked_at(height, width, tmp_path):
    path, out = tmp_path / "strip.npz", tmp_path / "out.json"
    np.savez(path, depth=np.full((height, width), 0.5, np.float32), K=np.array([[50, 0, 1], [0, 50, 1], [0, 0, 1.0]]))
    assert main.main(["grasp", str(path), "--json", str(out), "--pictures", str(tmp_path)]) == 0
    rows, columns, _ = cv2.imread(str(tmp_path / "strip.png")).shape
    assert max(rows / columns, columns / rows) == pytest.approx(10, rel=0.01)
    assert len(json.loads(out.read_text())["frames"]) == 1


def test_no_input_is_replaced(frame, tmp_path, capsys):
    """A depth image in the folder of the pictures, or named for the JSON."""
    depth = np.load(frame)["depth"]
    image = tmp_path / "depth.png"
    cv2.imwrite(str(image), np.nan_to_num(1000 * depth).astype(np.uint16))
    before = image.read_bytes()
    camera = ["--camera-info", "200,200,79.5,59.5"]
    for option, value in (("--pictures", tmp_path), ("--json", image)):
        assert main.main(["grasp", str(image), *camera, option, str(value)]) == 2
        assert f"{option}: " in capsys.readouterr().err
        assert image.read_bytes() == before


def test_a_full_disk_is_a_sentence(frame, capsys):
    assert main.main(["grasp", str(frame), "--json", "/dev/full"]) == 1
    assert "No space left" in capsys.readouterr().err


@pytest.mark.parametrize(("end", "code"), [(KeyboardInterrupt(), 130), (OSError("No space left"), 1)])
def test_what_is_done_is_kept_when_a_run_ends_early(frame, tmp_path, capsys, monkeypatch, end, code):
    """Beside a file of an earlier run, in place of none."""
    out = tmp_path / "out.json"
    for there, written in ((None, out), ("of a whole run", tmp_path / "out.partial.json")):
        answers = iter([[], end])

        def bodies(*_, answers=answers):
            if isinstance(answer := next(answers), BaseException):
                raise answer
            return answer

        monkeypatch.setattr(grasp_run, "_bodies", bodies)
        if there:
            out.write_text(there)
        assert main.main(["grasp", str(frame), str(frame), "--json", str(out)]) == code
        assert len(json.loads(written.read_text())["frames"]) == 1
        assert {130: "is kept", 1: "No space left"}[code] in (err := capsys.readouterr().err)
        assert (there is not None) == (f"see {written}" in err) == (out.read_text() == there)


def test_a_frame_that_cannot_be_recovered_costs_no_other_one(frame, tmp_path, capsys, monkeypatch):
    """Such as one of a camera that takes no image, principal point 1e300: its points are no numbers."""
    out, answers = tmp_path / "out.json", iter([[], ValueError("expected finite numbers"), []])

    def bodies(*_):
        if isinstance(answer := next(answers), Exception):
            raise answer
        return answer

    monkeypatch.setattr(grasp_run, "_bodies", bodies)
    assert main.main(["grasp", *[str(frame)] * 3, "--json", str(out)]) == 1
    assert len(json.loads(out.read_text())["frames"]) == 2
    assert f"{frame}: can.npz: expected finite numbers" in capsys.readouterr().err


def test_frames_of_one_name_have_a_picture_each_and_their_warnings_are_told(frame, tmp_path, capsys):
    other = tmp_path / "far" / frame.name
    other.parent.mkdir()
    recorded = dict(np.load(frame))
    np.savez(other, **{**recorded, "depth": 1000 * recorded["depth"]})
    assert main.main(["grasp", str(frame), str(other), "--pictures", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["can.png", "can_2.png"]
    assert "for millimetres the depth scale is 1000" in capsys.readouterr().err


def test_the_frames_of_a_bag_are_told_apart_by_their_stamps(frame, tmp_path, capsys, monkeypatch):
    pytest.importorskip("mcap", reason="needs the extra 'bags'")
    bag, out = tmp_path / "bag.mcap", tmp_path / "out.json"
    assert main.main(["recover", str(frame), str(frame), "--method", "classic", "--mcap", str(bag)]) == 0
    monkeypatch.setattr(grasp_run, "_bodies", lambda *_: [])
    capsys.readouterr()
    assert main.main(["grasp", str(bag), str(frame), "--json", str(out)]) == 0
    first, second, file = json.loads(out.read_text())["frames"]
    assert second["stamp"]["nanosec"] - first["stamp"]["nanosec"] == 100_000_000
    assert file["stamp"] is None
    assert len(set(capsys.readouterr().out.splitlines())) == 3
    assert main.main(["grasp", str(bag), "--topic", "/elsewhere"]) == 1
    assert "no images on /elsewhere" in capsys.readouterr().err


@pytest.mark.parametrize("wrong", [["--gripper", "claw"], ["--friction", "0"], ["--json", "nowhere/out.json"]])
def test_wrong_usage_is_told(frame, wrong, capsys):
    assert main.main(["grasp", str(frame), *wrong]) == 2
    assert "sq-perception" in capsys.readouterr().err
