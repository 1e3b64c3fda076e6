"""sq-perception recover on many frames: order, meshes, and what stays whole when it is interrupted."""

import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from recover_runs import BODIES, CAMERA, camera_yaml, recover, run, save_npz, save_png
from table_scenes import VGA, Table

from sq_perception import Recoverer, Superquadric
from sq_perception.commands import main
from sq_perception.commands.console import complain
from sq_perception.commands.recover_run import lines
from sq_perception.fitting.fit import CUT_SHORT
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.mesh import COLOURS
from sq_perception.imaging import raycast
from sq_perception.recordings.bag_file import InputOptions
from sq_perception.recordings.frame_file import FrameError
from sq_perception.recordings.inputs import RecordedInput, in_folder


@pytest.fixture
def validate(repository):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((repository / "sq_perception" / "recordings" / "result.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return lambda document: jsonschema.validate(document, schema)


def body_of(entry):
    return Superquadric(entry["size"], entry["shape"], entry["translation"], entry["rotation"])


def test_a_folder_gives_its_frames_in_natural_order_with_its_camera(tmp_path):
    for k, name in enumerate(["f2.png", "f10.png", "f1.npz", "F3.PNG", "g.png"]):
        (save_npz if name.endswith("npz") else save_png)(tmp_path / name, *([] if name.endswith("npz") else [500 + k]))
    camera_yaml(tmp_path / "camera.yaml", 300.0)
    (tmp_path / "notes.txt").touch()
    order = ["f1.npz", "f2.png", "F3.PNG", "f10.png", "g.png"]
    assert [path.name for path in in_folder(tmp_path)] == order
    recorded = RecordedInput([str(tmp_path)])
    found = list(recorded)
    assert recorded.total == 5
    assert [file for file, _ in found] == [str(tmp_path / name) for name in order]
    assert [frame.camera.fx for _, frame in found] == [200, 300, 300, 300, 300]
    camera_yaml(tmp_path / "camera_info.yaml", 400.0)
    some = InputOptions(every=2, limit=2)
    assert next(iter(RecordedInput([str(tmp_path / ".")], some)))[1].name == "f1.npz"
    assert [frame.camera.fx for _, frame in RecordedInput([str(tmp_path)], some)] == [200, 400]
    given = camera_yaml(tmp_path / "mine.yaml", 500.0)
    assert [frame.camera.fx for _, frame in RecordedInput([str(tmp_path)], InputOptions(given))] == [200] + 4 * [500]


def test_a_rendered_image_is_recovered_with_the_camera_beside_it_unless_the_folder_has_one(tmp_path):
    body = ["0.04", "0.03", "0.06", "0.3", "0.8", "0", "0", "0.6", "0", "0", "0", "1"]
    assert main.main(["render", *body, "--projection", "pinhole", "--output", str(tmp_path / "can.png")]) == 0
    written = yaml.safe_load((tmp_path / "can.yaml").read_text())["camera_matrix"]["data"]
    for named in (tmp_path / "can.png", tmp_path):
        (_, frame), *none = RecordedInput([str(named)])
        assert not none
        assert frame.camera.matrix.ravel().tolist() == written
    (tmp_path / "camera.yaml").write_text((tmp_path / "can.yaml").read_text().replace("525.0", "300.0"))
    assert [frame.camera.fx for _, frame in RecordedInput([str(tmp_path)])] == [300]


def test_a_folder_that_cannot_be_read_hides_none_beside_it(tmp_path, monkeypatch):
    for name in ("a", "b", "c"):
        save_npz(tmp_path / name / "f.npz")
    listed = Path.iterdir

    def iterdir(path):
        if path.name == "b":
            raise PermissionError(13, "Permission denied")
        return listed(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    found = list(RecordedInput([str(tmp_path)]))
    assert [Path(source).relative_to(tmp_path).parts[0] for source, _ in found] == ["a", "b", "c"]
    assert [isinstance(frame, FrameError) for _, frame in found] == [False, True, False]


def test_folders_are_looked_into_to_a_depth_that_is_said_and_depth_images_stand_for_their_siblings(tmp_path, caplog):
    near, *_ = (save_npz(tmp_path / f"{folder}/f.npz") for folder in ("1/2/3/depth", "1/2/3/rgb", "a/b/c/d/e"))
    with caplog.at_level("WARNING"):
        found = RecordedInput([str(tmp_path)])
    assert [file for file, _ in found] == [str(near)]
    assert "for 4 levels, and not farther down" in caplog.text


def test_names_that_are_no_utf_8_are_valid_json_and_are_resumed(tmp_path, capsys):
    name = os.fsdecode(b"caf\xe9.npz")
    save_npz(tmp_path / name)
    lines = tmp_path / "out.jsonl"
    for _ in range(2):
        recover(tmp_path, tmp_path / name, "--jsonl", lines)
    assert "0 frames, 0 objects (0 failed), 1 frame in" in capsys.readouterr().err, "the second time it is done"
    text = lines.read_text(encoding="utf-8")
    assert "\\ud" not in text, "half a surrogate pair, which other programs refuse"
    assert json.loads(text.splitlines()[1])["file"].endswith(r"caf\xe9.npz")


def test_decoders_write_nothing_themselves(tmp_path):
    """Of damaged files, and of what they hold beside pixels: a process of its own, as they write past Python."""
    image = np.full((48, 64), 800, np.uint16)
    whole = cv2.imencode(".png", image)[1].tobytes()
    profile = b"iCCPgarbage"
    chunk = struct.pack(">I", len(profile) - 4) + profile + struct.pack(">I", zlib.crc32(profile))
    damaged = bytearray(whole)
    damaged[-20] ^= 255
    tiff = bytearray(cv2.imencode(".tiff", image)[1].tobytes())
    tiff[-30] ^= 255
    (tmp_path / "profile.png").write_bytes(whole[:33] + chunk + whole[33:])
    (tmp_path / "cut.png").write_bytes(whole[:-30])
    (tmp_path / "damaged.png").write_bytes(damaged)
    (tmp_path / "odd.tiff").write_bytes(tiff)
    command = [sys.executable, "-m", "sq_perception", "recover", tmp_path]
    command += ["--camera-info", "60,60,31.5,23.5", "--method", "symmetry"]
    errors = subprocess.run(command, capture_output=True, text=True).stderr.splitlines()
    assert errors
    assert all(line.startswith("sq-perception: ") for line in errors), errors
    assert sum("not a readable image" in line for line in errors) >= 2


def test_bad_inputs_come_as_errors_in_their_place(tmp_path, capsys):
    """One cannot even be looked at, as in a folder without permission: here its name is too long."""
    empty = tmp_path / "empty"
    empty.mkdir()
    good, bad = save_npz(tmp_path / "good.npz"), tmp_path / "bad.npz"
    bad.write_bytes(b"nothing")
    lone, missing, long = save_png(tmp_path / "lone.png"), tmp_path / "missing", tmp_path / (300 * "a")
    names = [str(path) for path in (empty, bad, good, missing, lone, long)]
    found = [frame for _, frame in RecordedInput(names)]
    assert [isinstance(frame, FrameError) for frame in found] == [True, True, False, True, True, True]
    assert "no frames in it" in str(found[0])
    assert "File name too long" in str(found[-1])
    assert len(recover(tmp_path, *names, code=1)) == 1
    assert "5 frames or sources unreadable" in capsys.readouterr().err
    with pytest.raises(FrameError, match=r"none\.yaml"):
        RecordedInput(names, InputOptions(tmp_path / "none.yaml"))


@pytest.mark.parametrize(
    ("options", "words"),
    [((), "(plumb_bob 0.3 0 0 0 0) is undone"), (("--distortion", "apply"), ""), (("--distortion", "ignore"), "")],
)
def test_what_becomes_of_distortion_is_said_of_the_first_file_unless_it_was_asked_for(tmp_path, options, words, capsys):
    camera_yaml(tmp_path / "camera.yaml", distortion=0.3)
    for k in range(3):
        save_png(tmp_path / f"{k}.png")
    assert len(recover(tmp_path, tmp_path, *options)) == 3
    errors = capsys.readouterr().err
    assert words in errors
    assert "3 frames, " in errors
    assert ("0.png: " in errors and "1.png: " not in errors and "2 more files: " in errors) == bool(words)
    assert errors.count("\n") == (3 if words else 1)


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        *((option, "0", "") for option in ("--every", "--limit", "--time-budget")),
        *(("--min-score", value, ": expected a score from 0 to 1") for value in ("nan", "-inf", "90", "all")),
    ],
)
def test_counts_and_budgets_are_positive_and_a_score_is_from_0_to_1(tmp_path, option, value, words, capsys):
    """Of a frame that was recovered with another score, nothing was left, and no JSON could be written."""
    assert run(save_npz(tmp_path / "a.npz"), f"{option}={value}", "--json", tmp_path / "out.json") == 2
    assert option + words in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["glb", "ply"])
def test_meshes_are_the_bodies(tmp_path, kind):
    names = save_npz(tmp_path / "a.npz"), save_npz(tmp_path / "empty.npz", np.full((120, 160), np.nan, np.float32))
    frames = recover(tmp_path, *names, "--meshes", tmp_path / "new", "--mesh-format", kind)
    assert [path.name for path in (tmp_path / "new").iterdir()] == [f"a.{kind}"]
    path = tmp_path / "new" / f"a.{kind}"
    entries = frames[0]["superquadrics"]
    assert len(entries) == 2
    bodies = [body_of(one) for one in entries]
    turn = np.diag([1.0, -1.0, -1.0]) if kind == "glb" else np.eye(3)
    if kind == "glb":
        scene = trimesh.load_scene(path)
        parts = [part for _, part in sorted((part.metadata["name"], part) for part in scene.dump())]
    else:
        parts = trimesh.load_mesh(path).split()
        parts = sorted(parts, key=lambda part: np.linalg.norm(part.centroid - bodies[0].translation))
    for k, (part, body) in enumerate(zip(parts, bodies, strict=True)):
        np.testing.assert_allclose(abs(part.volume), body.volume(), rtol=0.02)
        np.testing.assert_allclose(part.bounds.mean(axis=0), turn @ body.translation, atol=2e-3)
        colour = np.round(255 * COLOURS[k % len(COLOURS)])
        np.testing.assert_array_equal(np.asarray(part.visual.vertex_colors)[0, :3], colour)


def test_obstacles_are_the_bodies_and_larger_where_they_are_less_known(tmp_path, capsys):
    names = save_npz(tmp_path / "a.npz"), save_npz(tmp_path / "empty.npz", np.full((120, 160), np.nan, np.float32))
    volumes = {}
    for inflate in ("0", "2"):
        folder = tmp_path / inflate
        frames = recover(tmp_path, *names, "--export", "curobo", "--export-folder", folder, "--export-meshes",
                         "--inflate", inflate)  # fmt: skip
        assert [path.name for path in folder.iterdir()] == ["a.yml"]
        world = yaml.safe_load((folder / "a.yml").read_text())
        assert list(world["mesh"]) == ["body_0", "body_1"]
        for one, entry in zip(world["mesh"].values(), frames[0]["superquadrics"], strict=True):
            np.testing.assert_allclose(one["pose"][:3], entry["translation"], atol=1e-6)
        parts = [trimesh.Trimesh(one["vertices"], one["faces"]) for one in world["mesh"].values()]
        volumes[inflate] = [part.volume for part in parts]
    bodies = [body_of(one) for one in frames[0]["superquadrics"]]
    for volume, larger, body in zip(volumes["0"], volumes["2"], bodies, strict=True):
        assert body.volume() < volume < 1.1 * body.volume()
        assert larger > volume
    words = ["--method", "classic", "--export", "mjcf", "--export-folder", str(tmp_path / "classic"), "--inflate", "1"]
    assert main.main(["recover", str(tmp_path / "a.npz"), *words]) == 1
    assert "--export: covariances: expected finite ones" in capsys.readouterr().err


def test_the_schema_describes_what_is_written(tmp_path, validate):
    """Document and lines, a frame with masks and tracks and one of the cube; and every field is described."""
    save_npz(tmp_path / "1.5.npz")
    np.savez(tmp_path / "2.5.npz", depth=np.full((8, 8), np.nan), projection="orthographic")
    lines = tmp_path / "out.jsonl"
    names = tmp_path / "1.5.npz", tmp_path / "2.5.npz"
    first, second = recover(tmp_path, *names, "--track", "--parts", "--jsonl", lines)
    validate(json.loads((tmp_path / "out.json").read_text()))
    head, *frames = map(json.loads, lines.read_text().splitlines())
    validate({**head, "frames": frames})
    assert first["camera"]["K"] == CAMERA.matrix.ravel().tolist()
    assert (first["coordinates"], second["coordinates"]) == ("optical", "cube")
    with pytest.raises(Exception, match="'soon' is not of type 'number'"):
        validate({**head, "frames": [{**first, "ms": "soon"}]})


def test_parts_are_in_every_file(tmp_path, validate):
    """A hammer on a table: beside its body, handle and head in document, table, meshes and page, and in words."""
    table = Table(pitch=1.0, distance=0.7)
    hammer = [table.body(0.0, 0.0, (0.09, 0.014, 0.014), height=0.006), table.body(0.1, 0.0, (0.018, 0.06, 0.02))]
    depth, labels = table.see(hammer, 0.001)
    np.savez(tmp_path / "a.npz", depth=depth, K=VGA.matrix, labels=np.minimum(labels, 1))
    outputs = ("--csv", tmp_path / "out.csv", "--html", tmp_path / "out.html", "--meshes", tmp_path)
    (frame,) = recover(tmp_path, tmp_path / "a.npz", "--parts", *outputs)
    validate(json.loads((tmp_path / "out.json").read_text()))
    (body,) = frame["superquadrics"]
    assert sorted(max(part["size"]) for part in body["parts"]) == pytest.approx([0.06, 0.09], abs=0.012)
    assert sum(part["share"] for part in body["parts"]) > 0.9
    rows = (tmp_path / "out.csv").read_text().splitlines()
    assert [row.rpartition(",")[2] for row in rows] == ["part", "0", "1", "2"]
    assert set(trimesh.load(tmp_path / "a.glb").geometry) == {"body_0_part_1", "body_0_part_2"}
    assert (tmp_path / "out.html").read_text().count('"number": 0') == 2
    assert "    part " in "\n".join(lines([frame], False))


def body_entry(status="converged", message="converged", **changed):
    entry = {
        "size": [0.24, 0.098, 0.107], "sigma_size": [0.0025, 0.0055, 0.0035], "shape": [0.1, 1.0],
        "translation": [0.12, 0.03, 0.84], "score": 0.9, "seen": [1.0, 0.9, None], "pixels": 500, "label": None,
        "track": None, "status": status, "message": message,
    }  # fmt: skip
    return {**entry, **changed}


def test_a_line_a_body_and_a_reason_once():
    bodies = [
        body_entry(),
        body_entry("weak", "half size along y undetermined; hollow", sigma_size=[0.001, None, 0.04]),
        body_entry("weak", "half size along x and z undetermined", label=3, track={"id": 7}),
        body_entry("failed", "5 pixels with a depth are too few for a body"),
        body_entry(message=f"converged; {CUT_SHORT}", sigma_size=[None] * 3),
    ]  # fmt: skip
    frame = {"file": "a.npz", "stamp": None, "ms": 12.3, "message": "", "ms_by_stage": {"fit": 3.0}}
    frames = [{**frame, "coordinates": "optical", "superquadrics": bodies},
              {**frame, "coordinates": "cube", "superquadrics": bodies[:1]}]  # fmt: skip
    assert list(lines(frames, verbose=False)) == [
        "a.npz  12 ms",
        "  0 converged 480 x 196 x 214 mm (+-5 +-11 +-7) at 0.12 0.03 0.84 m",
        "  1 weak 480 x 196 x 214 mm (+-2 +-? +-80) at 0.12 0.03 0.84 m",
        "  2 weak 480 x 196 x 214 mm (+-5 +-11 +-7) at 0.12 0.03 0.84 m  mask 3  id 7",
        "  3 failed at 0.12 0.03 0.84 m",
        "  4 converged (cut short by the time budget) 480 x 196 x 214 mm at 0.12 0.03 0.84 m",
        "a.npz  12 ms",
        "  0 converged 0.480 x 0.196 x 0.214 of the cube (+-0.005 +-0.011 +-0.007) at 0.12 0.03 0.84",
        "2 weak: half size undetermined",
        "1 failed: 5 pixels with a depth are too few for a body",
        "what to do with them: docs/how_sure.md; -v shows more of each body",
    ]
    details = list(lines(frames[:1], verbose=True))
    assert "    exponents 0.10 1.00, score 0.900, seen 100% 90% ?, pixels 500: converged" in details
    assert sum("undetermined" in line for line in details) == 2


def test_csv_and_a_page_are_written_beside_each_other(tmp_path, capsys):
    frame, table, page = save_npz(tmp_path / "a.npz"), tmp_path / "out.csv", tmp_path / "out.html"
    assert run(frame, "--csv", table, "--html", page) == 0
    assert len(table.read_text().splitlines()) == 3
    assert "frames.push" in page.read_text()
    capsys.readouterr()
    assert run(frame, "--csv", "-") == 0
    assert capsys.readouterr().out == table.read_text()
    assert run(frame, "--csv", "-", "--json", "-") == 2
    assert run(tmp_path / "none.npz", "--csv", table, "--html", page) == 1
    assert len(table.read_text().splitlines()) == 3
    assert "frames.push" in page.read_text()


def test_track_puts_ids_into_the_json(tmp_path, capsys):
    """Masks change their labels and bodies their sizes from frame to frame; names that are times are stamps."""
    folder = tmp_path / "frames"
    for k, labels in enumerate(2 * [[0, 1, 2], [0, 2, 1]]):
        grown = Superquadric((1 + 0.02 * (-1) ** k) * BODIES.size, BODIES.shape, BODIES.translation, BODIES.rotation)
        save_npz(folder / f"1305031102.{k}.npz", bodies=grown, labels=labels)
    frames = recover(tmp_path, folder, "--track", "--time-budget", "10")
    assert [frame["stamp"] for frame in frames] == [{"sec": 1305031102, "nanosec": k * 10**8} for k in range(4)]
    assert "no stamp" not in capsys.readouterr().err
    by_id = {}
    for frame in frames:
        for one in frame["superquadrics"]:
            by_id.setdefault(one["track"]["id"], []).append(one)
    assert sorted(by_id) == [1, 2]
    for entries in by_id.values():
        assert [one["track"]["seen"] for one in entries] == [1, 2, 3, 4]
        assert {one["label"] for one in entries} == {1, 2}
        last = entries[-1]["track"]
        assert last["fused"]
        truth = min(BODIES.size, key=lambda size: abs(np.prod(size) / np.prod(last["size"]) - 1))
        np.testing.assert_allclose(np.sort(last["size"]), np.sort(truth), rtol=0.019)


def test_poses_make_one_scene_of_several_cameras(tmp_path, capsys, validate):
    """From four sides: every body once, in the world of the poses, surer than in one frame; bad files are named."""
    middle, world = BODIES.translation.mean(axis=0), np.array([1.0, -2.0, 0.5])
    names, poses = [], []
    for k in range(4):
        turn = quaternions.from_rotation_vector(np.array([0.0, 0.5 * k, 0.0]))
        position = middle - quaternions.to_matrix(turn) @ middle
        back = quaternions.conjugate(turn)
        seen = BODIES.transformed(back, -quaternions.to_matrix(back) @ position)
        names.append(save_npz(tmp_path / f"camera{k}" / "depth.npz", bodies=seen))
        poses.append(f"{names[k]} " + " ".join(map(str, [*(position + world), *turn])))
    file = tmp_path / "poses.txt"
    file.write_text("# name tx ty tz qx qy qz qw\n" + "\n".join(poses))
    frames = recover(tmp_path, *names, "--poses", file)
    document = json.loads((tmp_path / "out.json").read_text())
    validate(document)
    scene = document["scene"]
    assert [(body["id"], body["seen"]) for body in scene] == [(1, 4), (2, 4)]
    for body in scene:
        truth = int(np.argmin(np.linalg.norm(BODIES.translation + world - body["translation"], axis=1)))
        np.testing.assert_allclose(body["translation"], BODIES.translation[truth] + world, atol=0.003)
        np.testing.assert_allclose(np.sort(body["size"]), np.sort(BODIES.size[truth]), rtol=0.05)
        first = next(one["track"] for one in frames[0]["superquadrics"] if one["track"]["id"] == body["id"])
        assert np.prod(body["sigma_size"]) < 0.5 * np.prod(first["sigma_size"])
    file.write_text(poses[0])
    assert len(recover(tmp_path, *names[:2], "--poses", file, code=1)) == 1
    assert "no pose" in capsys.readouterr().err
    file.write_text(f"{poses[0]}\nb 1 2 3 0 0 0")
    assert run(names[0], "--poses", file) == 2
    assert "line 2" in capsys.readouterr().err
    assert main.main(["recover", str(names[0]), "--poses", str(file), "--method", "classic"]) == 2


def test_track_is_asked_for_and_says_where_stamps_are_missing(tmp_path, capsys):
    for name in ("a/f0.npz", "a/f1.npz", "b/f0.npz", "b/f1.npz"):
        save_npz(tmp_path / name)
    plain = recover(tmp_path, tmp_path / "a")
    assert all(one["track"] is None for frame in plain for one in frame["superquadrics"])
    assert plain[0]["stamp"] is None
    capsys.readouterr()
    frames = recover(tmp_path, tmp_path / "a", tmp_path / "b", "--track")
    ids = [sorted(one["track"]["id"] for one in frame["superquadrics"]) for frame in frames]
    assert ids == [[1, 2], [1, 2], [3, 4], [3, 4]]
    assert capsys.readouterr().err.count("taken to be 0.1 s apart") == 1


def test_a_still_scene_is_recovered_anew_in_each_folder(tmp_path):
    rendered, _ = raycast.render(BODIES, CAMERA)
    rng = np.random.default_rng(1)
    for folder in ("a", "b"):
        depth = np.where(np.isfinite(rendered), rendered + rng.normal(0, 1e-3, rendered.shape), np.nan)
        save_npz(tmp_path / folder / "f.npz", depth.astype(np.float32))
    first, second = recover(tmp_path, tmp_path / "a", tmp_path / "b", "--track")
    (alone,) = recover(tmp_path, tmp_path / "b")
    for other, is_same in ((first, False), (alone, True)):
        sizes = ([one["size"] for one in frame["superquadrics"]] for frame in (second, other))
        assert np.allclose(*sizes, rtol=1e-9) == is_same


def test_a_run_warms_up_once_however_many_cameras_it_has(tmp_path, monkeypatch):
    """Each cloud has a camera of its own."""
    warmed = []
    monkeypatch.setattr(Recoverer, "warm_up", lambda _, camera: warmed.append(camera))
    for k, focal in enumerate((200.0, 210.0, 220.0)):
        save_png(tmp_path / f"{k}.png")
        camera_yaml(tmp_path / f"{k}.yaml", focal)
    recover(tmp_path, *(str(tmp_path / f"{k}.png") for k in range(3)))
    assert len(warmed) == 1


def test_bodies_below_the_least_score_are_counted(tmp_path, capsys):
    (all_of_them,) = recover(tmp_path, save_npz(tmp_path / "a.npz"))
    (none,) = recover(tmp_path, tmp_path / "a.npz", "--min-score", "1")
    assert not none["superquadrics"]
    assert none["message"] == f"{len(all_of_them['superquadrics'])} bodies with a lower score left out"


@pytest.mark.parametrize("lowest", [("-1", "-1.", "0"), ("-1e0", "-inf", "-.1e-1")])
def test_a_workspace_may_have_no_end(tmp_path, lowest):
    """JSON knows no infinity; the same command goes on with its lines.  Negative numbers are no options."""
    save_npz(tmp_path / "a.npz")
    box = ["--workspace", *lowest, "1", "1", "inf", "--jsonl", tmp_path / "out.jsonl"]
    for _ in range(2):
        assert len(recover(tmp_path, tmp_path / "a.npz", *box)[0]["superquadrics"]) == 2
    options = json.loads((tmp_path / "out.jsonl").read_text().splitlines()[0])["options"]
    assert options["workspace"] == [-1, None if "-inf" in lowest else -1, float(lowest[2]), 1, 1, None]


def test_a_message_is_one_printable_line(capsys):
    complain("a\x1b[2J\nb")
    assert capsys.readouterr().err == "sq-perception: a?[2J b\n"
